"""The shadow on measured records: the sets that lead, and the figure that is in print.

python records.py FOLDER [NAME ...]
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import control as ct
from flow import case_of, words
from real_data import CASES, Case
from search import Search, as_fitted
from verdict import verdict

import rcorefine as rco
from rcorefine.arithmetic import own_arithmetic


def kit(folder):
    """DC motor kit of a laboratory: dead zone, saturating gain."""
    data = rco.Measurement.from_csv(folder / "undcmotor_prbs.csv", "u", "y", dt=0.02)
    model = ct.ss(
        [[-1 / 0.2]], [[200 / 0.2]], [[1.0]], [[0.0]], inputs=["u"], outputs=["y"], states=["speed"]
    )
    first, last = data.split(0.7)
    figure = lambda refined: f"NRMSE {1 - rco.compare(refined, last).fit[0] / 100:.4f}"  # noqa: E731
    return Case(model, first, last, figure, "static curve")


def heater(folder):
    """Temperature laboratory: heater, sensor."""
    data = rco.Measurement.from_csv(folder / "tclab_step.csv", "Q1", "T1", dt=1.0)
    data = rco.Measurement(data.inputs, data.outputs - data.outputs[:, :1], dt=1.0)
    model = ct.ss(
        [[-(0.005 + 0.05) / 5.0 - 0.01, 0.01], [0.05, -0.05]], [[0.04 / 5.0], [0]], [[0, 1.0]], 0,
        inputs=["Q1"], outputs=["T1"], states=["TH", "TS"],
    )  # fmt: skip
    first, last = data.split(0.6)
    figure = lambda refined: f"{rco.compare(refined, last).rmse[0]:.3f} K"  # noqa: E731
    return Case(model, first, last, figure, "linear 0.23 K")


MORE = {"kit": ("undcmotor_prbs.csv", kit), "tclab": ("tclab_step.csv", heater)}

if __name__ == "__main__":
    folder = Path(sys.argv[1])
    for name in sys.argv[2:] or [*CASES, *MORE]:
        case = {**CASES, **MORE}[name][1](folder)
        start = time.process_time()
        with warnings.catch_warnings(), own_arithmetic():
            warnings.simplefilter("ignore")
            search = Search(case_of(case.model, case.data)).run()
            found = verdict(search)
            cpu = time.process_time() - start
            told = [e.label for e in found.effects]
            print(name, found.word, told, f"P {found.probability:.3f}, CPU {cpu:.0f} s; {case.printed}")
            for value, trial in search.table()[:6]:
                sure = [round(float(x), 1) for x in trial.surest()]
                try:
                    figure = case.figure(as_fitted(trial).refinement)
                except Exception as error:  # a model that runs away on other data
                    figure = type(error).__name__
                told = f"{value - search.posterior(search.best):10.1f} {words(search, trial)} {sure}"
                print(told, trial.noise.names, figure)
        sys.stdout.flush()
