"""Measured records: a wrong linear model, refined, judged on held-out data.

The motor's linear model is refined while the record streams by (`RCORefiner`); the motor, the Silverbox and
EMPS then get the effects that their authors name, in batch (`refine`).

    python benchmarks/real_refinements.py --data FOLDER

FOLDER holds the records (README.md there says which); a record that is not there is skipped, and named.
Each record is a function that returns rows of a table; add one to `RECORDS` to add a record.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import control as ct
import numpy as np
from scipy.io import loadmat
from scipy.optimize import least_squares
from scipy.signal import lfilter

import rcorefine as rco
from rcorefine.views.tables import TextTable, number

TRAINING = 0.7


@dataclass(frozen=True)
class Outcome:
    """What one record showed: a table, its explanation, and whether the demands were met."""

    title: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]
    demands: tuple[tuple[str, bool], ...]

    @property
    def passed(self) -> bool:
        return all(met for _, met in self.demands)

    def __str__(self) -> str:
        table = TextTable(self.headers, self.rows, title=self.title, notes=self.notes).text()
        verdicts = [f"{'met    ' if met else 'NOT MET'}  {demand}" for demand, met in self.demands]
        return "\n".join([table, *verdicts])


def motor_model(gain: float, tau: float, name: str) -> ct.StateSpace:
    """First-order motor, tau dw/dt + w = K u, voltage in V to speed in rpm."""
    return ct.ss(
        [[-1.0 / tau]], [[gain / tau]], [[1.0]], [[0.0]],
        inputs=["voltage"], outputs=["rpm"], states=["speed"], name=name,
    )  # fmt: skip


def best_linear_motor(train: rco.Measurement) -> tuple[float, float]:
    """Gain in rpm/V and time constant in s with the least output error on a record.

    The initial speed is a third parameter; no offset (the model that is refined has none either).
    """
    u, y = train.inputs[0], train.outputs[0]

    def residual(parameters: np.ndarray) -> np.ndarray:
        gain, log_tau, start = parameters
        pole = np.exp(-train.dt / np.exp(log_tau))
        forced = lfilter([0.0, gain * (1.0 - pole)], [1.0, -pole], u)
        return forced + start * pole ** np.arange(u.size) - y

    # several starts: the error of a dead zone is not convex in tau
    fits = [
        least_squares(residual, [30.0, np.log(tau), 0.0], x_scale=[10.0, 0.5, 10.0])
        for tau in (0.05, 0.2, 0.8)
    ]
    best = min(fits, key=lambda fit: fit.cost)
    return float(best.x[0]), float(np.exp(best.x[1]))


def motor(folder: Path) -> Outcome:
    """Geared 12 V motor on an H-bridge, 10 ms; a dead zone is what a linear model cannot have."""
    data = rco.Measurement.from_csv(
        folder / "dcmotor.csv", "voltage", "rpm", time="time", input_units="V", output_units="rpm"
    )
    train, test = data.split(TRAINING)
    start = motor_model(35.0, 0.1, "start")
    began = time.perf_counter()
    refiner = rco.RCORefiner(start, dt=data.dt).run(train)
    seconds = time.perf_counter() - began
    refined = refiner.system.copy(name="refined")
    best = motor_model(*best_linear_motor(train), name="best linear")

    hindsight = motor_model(*best_linear_motor(test), name="hindsight")

    models = [start, refined, best, hindsight]
    on_train, on_test = (rco.compare(models, part) for part in (train, test))
    whole = rco.compare(start, data)
    rows = []
    for index, model in enumerate(models):
        pole = float(np.real(model.poles()[0]))
        rows.append(
            (
                model.name,
                number(float(np.real(model.dcgain())), 4),
                number(-1.0 / pole, 3) if pole else "-",
                f"{on_train.nrmse[index, 0]:.3f}",
                f"{on_test.nrmse[index, 0]:.3f}",
                f"{on_test.fit[index, 0]:.1f}",
                number(float(on_test.rmse[index, 0]), 3),
            )
        )
    before, after, linear = (float(value) for value in on_test.nrmse[:3, 0])
    return Outcome(
        title=(
            f"dcmotor.csv: {data.n_samples} samples, {1e3 * data.dt:g} ms; learnt on the first "
            f"{TRAINING:.0%}, judged on the rest"
        ),
        headers=("model", "K [rpm/V]", "tau [s]", "train", "held out", "fit [%]", "RMSE [rpm]"),
        rows=tuple(rows),
        notes=(
            "train, held out: NRMSE = |y - yh| / |y - mean(y)| of the free run, initial speed estimated "
            "on each part; fit = 100 (1 - NRMSE) and RMSE on the held-out part.",
            f"start: K = 35 rpm/V, tau = 0.1 s, NRMSE {whole.nrmse[0]:.2f} on the whole record. refined: "
            f"RCORefiner with its defaults (form {refiner.form!r}), one pass, "
            f"{1e6 * seconds / train.n_samples:.0f} us per sample, "
            "compilation included. best linear: scipy.optimize.least_squares on K, tau, initial speed; "
            "no offset. hindsight: the same, fitted to the held-out part itself, a bound for any such model.",
            "What is seen: least squares over the whole record smears the dead zone, where the motor rests "
            "for 36 s; the refiner begins anew when it turns, and ends at the model of the turning motor.",
        ),
        demands=(
            ("refined is better than the start on held-out data", after < before),
            ("refined is within 25 % of the best linear fit on held-out data", after <= 1.25 * linear),
        ),
    )


def refined(
    model: ct.StateSpace, train: rco.Measurement, kinds: Sequence[str], place: str, **options: object
) -> tuple[rco.Refinement, float]:
    """Refinement with effects and free linear parameters, and the seconds that it took."""
    began = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # short parts of a record excite little: the table shows it
        result = rco.refine(
            model, train, [rco.Effect(kind, place) for kind in kinds], free="linear", **options
        )
    return result, time.perf_counter() - began


def best_offset_fit(train: rco.Measurement, test: rco.Measurement) -> float:
    """Held-out NRMSE of the best linear motor, offset and initial speed included, by scipy alone."""

    def response(p: np.ndarray, data: rco.Measurement) -> np.ndarray:
        pole = np.exp(-data.dt / np.exp(p[1]))
        forced = lfilter([0.0, p[0] * (1.0 - pole)], [1.0, -pole], data.inputs[0] + p[3])
        return forced + p[2] * pole ** np.arange(data.n_samples)

    fits = [
        least_squares(
            lambda p: response(p, train) - train.outputs[0],
            [20.0, np.log(tau), 0.0, 0.0],
            x_scale=[10.0, 0.5, 10.0, 0.3],
        )
        for tau in (0.05, 0.3, 1.0, 3.0)
    ]
    best = min(fits, key=lambda fit: fit.cost).x
    start = least_squares(
        lambda v: response(np.array([*best[:2], v[0], best[3]]), test) - test.outputs[0], [0.0]
    )
    y = test.outputs[0]
    error = response(np.array([*best[:2], start.x[0], best[3]]), test) - y
    return float(np.linalg.norm(error) / np.linalg.norm(y - y.mean()))


def motor_effects(folder: Path) -> Outcome:
    """Dead zone and delay of the motor; two ways to hold data out."""
    data = rco.Measurement.from_csv(
        folder / "dcmotor.csv", "voltage", "rpm", time="time", input_units="V", output_units="rpm"
    )
    start = motor_model(35.0, 0.1, "start")
    train, test = data.split(TRAINING)
    # both polarities in both parts: every third step of 3 s is held out, the others are records of one fit
    steps = [data.segment(3.0 * k, 3.0 * (k + 1)) for k in range(int(data.timepts[-1] // 3.0))]
    learnt = [part for k, part in enumerate(steps) if k % 3 != 2]
    judged = [part for k, part in enumerate(steps) if k % 3 == 2]
    level = np.concatenate([part.outputs[0] for part in judged])
    rungs = (
        ("linear", ()),
        ("+ dead zone", ("input_deadzone",)),
        ("+ delay", ("input_deadzone", "input_delay")),
    )
    rows, later, spread = [], [], []
    for name, kinds in rungs:
        result, seconds = refined(start, train, kinds, "voltage")
        held_out = float(rco.compare(result, test).nrmse[0])
        mixed, _ = refined(start, learnt, kinds, "voltage")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            errors = [rco.simulate(mixed, part).outputs[0] - part.outputs[0] for part in judged]
        share = float(np.linalg.norm(np.concatenate(errors)) / np.linalg.norm(level - level.mean()))
        later.append(held_out)
        spread.append(share)
        by_kind = {row.kind: row for row in result.parameters}
        gain = float(np.real(result.system.dcgain()))
        cells = [f"{gain:.2f}"]
        for kind in ("input_deadzone", "input_delay"):
            row = by_kind.get(kind)
            cells.append("-" if row is None else f"{row.value:.3g}")
        rows.append(
            (
                name,
                *cells,
                f"{1 - result.fit[0] / 100:.3f}",
                f"{held_out:.4f}",
                f"{share:.4f}",
                f"{seconds:.1f}",
            )
        )
    best = best_offset_fit(train, test)
    bound, _ = refined(start, test, ("input_deadzone",), "voltage")
    return Outcome(
        title="dcmotor.csv: linear parameters and offset free, effects added",
        headers=(
            "model",
            "K [rpm/V]",
            "zone [V]",
            "delay [s]",
            "train",
            "held out",
            "mixed",
            "time [s]",
        ),
        rows=tuple(rows),
        notes=(
            f"train, held out: NRMSE on the first {TRAINING:.0%} and on the rest, initial speed "
            "estimated. mixed: every third step of 3 s held out, so that both polarities are in both parts, "
            "each with an initial speed of its own (which is kinder). time: of one refine.",
            f"Best linear fit by scipy.optimize.least_squares, offset included: held out {best:.4f}. The "
            f"motor moves in the positive sense only in the first {TRAINING:.0%}, in the rest mostly in the "
            "negative one, in which it is a little stronger; the model with the dead zone fitted to the "
            f"held-out part itself reaches {1 - bound.fit[0] / 100:.4f}.",
        ),
        demands=(
            ("linear refit within 2 % of the best linear fit, held out", abs(later[0] / best - 1) < 0.02),
            ("with the dead zone below 0.08, held out in time (negative sense never seen)", later[1] < 0.08),
            ("with the dead zone below 0.08, mixed", spread[1] < 0.08),
            ("with the delay not worse, held out in time", later[2] <= later[1] * 1.001),
            ("with the delay not worse, mixed", spread[2] <= spread[1] * 1.001),
        ),
    )


def silverbox(folder: Path) -> Outcome:
    """Duffing circuit: linear parameters start 30 % off, then a cubic spring; two holds."""
    file = loadmat(folder / "SNLS80mV.mat")
    u, y = file["V1"].ravel(), file["V2"].ravel()
    start, stop = 40650, 127400
    cut = start + int(0.75 * (stop - start))
    wrong = 1.3
    model = ct.ss(
        [[0, 1], [-1.84e5 * wrong, -41.8 * wrong]], [[0], [1.94e5 * wrong]], [[1, 0]], 0,
        inputs="V1", outputs="V2", states=["x", "v"], name="silverbox",
    )  # fmt: skip

    def part(first: int, last: int, hold: str) -> rco.Measurement:
        return rco.Measurement(u[first:last], y[first:last], dt=1 / 610.35, hold=hold, name="silverbox")

    rows, errors = [], {}
    for hold in ("foh", "bandlimited"):
        for kinds in ((), ("cubic_stiffness",)):
            result, seconds = refined(model, part(start, cut, hold), kinds, "x")
            found = []
            for first, last in ((cut, stop), (100, 40575)):
                data = part(first, last, hold)
                found.append(
                    1e3
                    * float(
                        np.sqrt(np.mean((rco.simulate(result, data).outputs - data.outputs)[0, 50:] ** 2))
                    )
                )
            errors[hold, len(kinds)] = found
            A = np.asarray(result.system.A)
            cubic = "-"
            if kinds:
                row = result.parameters[0]
                cubic = f"{row.value * abs(float(np.asarray(result.physical_model.port('x').act)[1])):.4g}"
            rows.append(
                (hold, "+ cubic" if kinds else "linear", f"{-A[1, 0]:.5g}", f"{-A[1, 1]:.4g}", cubic,
                 f"{found[0]:.3f}", f"{found[1]:.3f}", f"{seconds:.1f}")
            )  # fmt: skip
    return Outcome(
        title="SNLS80mV.mat (Silverbox): learnt on 75 % of the multisine, linear parameters from 30 % off",
        headers=(
            "hold",
            "model",
            "k [1/s2]",
            "c [1/s]",
            "cubic",
            "multisine",
            "arrow",
            "time [s]",
        ),
        rows=tuple(rows),
        notes=(
            "multisine, arrow: RMSE in mV of the free run on the last quarter of the multisine and on the "
            "sweep (never seen, larger amplitudes), without the first 50 samples; cubic in 1/(V2 s2), "
            "time in s. Best in print: 0.30-0.36.",
        ),
        demands=(
            ("first-order hold: multisine <= 0.95 mV", errors["foh", 1][0] <= 0.95),
            ("first-order hold: arrow <= 1.0 mV", errors["foh", 1][1] <= 1.0),
            ("band-limited: multisine <= 0.40 mV", errors["bandlimited", 1][0] <= 0.40),
            ("band-limited: arrow <= 0.50 mV", errors["bandlimited", 1][1] <= 0.50),
        ),
    )


def window_error(result: rco.Refinement, data: rco.Measurement, seconds: float) -> float:
    """RMSE in mm of free runs that start at the measured position and its difference quotient."""
    position = data.outputs[0]
    speed = np.gradient(position, data.dt)
    length = round(seconds / data.dt)
    errors = []
    for first in range(0, data.n_samples - length + 1, length):
        last = min(first + length, data.n_samples)
        window = rco.Measurement(data.inputs[:, first:last], data.outputs[:, first:last], dt=data.dt)
        run = rco.simulate(result, window, np.array([position[first], speed[first]]))
        errors.append(run.outputs - window.outputs)
    return 1e3 * float(np.sqrt(np.mean(np.concatenate(errors, axis=1) ** 2)))


def emps(folder: Path) -> Outcome:
    """Electro-mechanical positioning: an integrator with dry friction, judged in windows of 1 s."""
    file = loadmat(folder / "DATA_EMPS.mat")
    force = float(file["gtau"].ravel()[0]) * file["vir"].ravel()
    n = force.size // 5 * 5
    data = rco.Measurement(
        force[:n].reshape(-1, 5).mean(axis=1), file["qm"].ravel()[:n:5], dt=5e-3, name="EMPS"
    )
    cut = int(0.6 * data.n_samples)
    train, test = (
        rco.Measurement(data.inputs[:, part], data.outputs[:, part], dt=data.dt)
        for part in (slice(0, cut), slice(cut, None))
    )
    mass, viscous = 95.11, 203.5
    model = ct.ss(
        [[0, 1], [0, -viscous / mass]], [[0], [1 / mass]], [[1, 0]], 0,
        inputs="force", outputs="q", states=["q", "v"], name="EMPS",
    )  # fmt: skip
    rungs = (
        ("linear", ()),
        ("+ Coulomb", ("coulomb_friction",)),
        ("+ asymmetric", ("asymmetric_friction", "asymmetric_damping")),
    )
    rows, errors, masses = [], [], []
    for name, kinds in rungs:
        result, seconds = refined(model, train, kinds, "q")
        gain = result.parameter("input_gain").value
        masses.append(mass / gain)
        errors.append(window_error(result, test, 1.0))
        estimated = 1e3 * float(rco.compare(result, test, horizon=1.0).rmse[0])
        short, _ = refined(model, train, kinds, "q", horizon=1.0)
        friction = "/".join(
            f"{row.value / gain:.1f}" for row in result.parameters if row.kind.endswith("friction")
        )
        rows.append(
            (name, f"{masses[-1]:.1f}", friction or "-", f"{errors[-1]:.2f}", f"{estimated:.2f}",
             f"{window_error(short, test, 1.0):.2f}", f"{seconds:.1f}")
        )  # fmt: skip
    return Outcome(
        title="DATA_EMPS.mat: input averaged to 200 Hz; learnt on the first 60 %, judged on the rest",
        headers=("model", "mass [kg]", "friction [N]", "1 s", "1 s est.", "short", "time [s]"),
        rows=tuple(rows),
        notes=(
            "1 s: RMSE in mm of free runs of 1 s from the measured position and its difference quotient.",
            "1 s est.: compare(horizon=1.0), each window from the initial state that fits it best; kinder.",
            "short: as 1 s, but fitted with horizon=1.0 instead of the default windows.",
            "mass: 95.11 kg over the estimated gain of the force (published: 95.1 kg, friction 20.4 N).",
        ),
        demands=(
            ("with Coulomb friction <= 1.8 mm", errors[1] <= 1.8),
            ("with asymmetric friction and damping <= 0.7 mm", errors[2] <= 0.7),
            ("mass 88-98 kg with friction", all(88 <= value <= 98 for value in masses[1:])),
        ),
    )


# Name, file that must be there, and the function.
RECORDS: tuple[tuple[str, str, Callable[[Path], Outcome]], ...] = (
    ("motor", "dcmotor.csv", motor),
    ("motor-effects", "dcmotor.csv", motor_effects),
    ("silverbox", "SNLS80mV.mat", silverbox),
    ("emps", "DATA_EMPS.mat", emps),
)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the records")
    parser.add_argument("--only", choices=[name for name, _, _ in RECORDS], help="one record")
    options = parser.parse_args(arguments)
    if not options.data.is_dir():
        sys.stderr.write(f"{options.data} is not a folder\n")
        return 2
    failed = False
    for name, file, run in RECORDS:
        if options.only not in (None, name):
            continue
        if not (options.data / file).is_file():
            sys.stdout.write(f"skipped {name}: {file} is not in {options.data}\n\n")
            continue
        outcome = run(options.data)
        failed |= not outcome.passed
        sys.stdout.write(f"{outcome}\n\n")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
