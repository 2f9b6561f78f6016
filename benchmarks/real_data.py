"""Measured records through the whole loop: `improve` from the physical start, hold and effects left to it.

    python benchmarks/real_data.py --data FOLDER [--only NAME ...] [--pictures FOLDER]

Prints, per record, the linear start, each step, the last model, its number of parameters and the best
figure in print. FOLDER holds the records; one that is not there is skipped, and named.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import control as ct
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy.io import loadmat

import rcorefine as rco


@dataclass
class Case:
    """A record, its physical start, and what is known of it."""

    model: ct.StateSpace
    data: rco.Measurement | list[rco.Measurement]
    validation: rco.Measurement
    figure: Callable[[rco.Refinement], str]
    printed: str
    candidates: list[rco.Effect] | None = None
    max_effects: int = 4


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def tanks(folder: Path) -> Case:
    """Cascaded tanks: overflow, square-root outflow, cap of the sensor at 10 V."""
    rows = np.genfromtxt(folder / "dataBenchmark.csv", delimiter=",", names=True, usecols=range(4))
    train, test = (
        rco.Measurement(rows[u], rows[y], dt=4.0, input_labels="pump", output_labels="level2", name="tanks")
        for u, y in (("uEst", "yEst"), ("uVal", "yVal"))
    )
    k = 0.02
    model = ct.ss(
        [[-k, 0], [k, -k]], [[0.05], [0]], [[0, 1]], 0,
        inputs="pump", outputs="level2", states=["level1", "level2"], name="tanks",
    )  # fmt: skip

    def figure(refined: rco.Refinement) -> str:
        return f"{rco.compare(refined, test).rmse[0]:.3f} V on the second record"

    return Case(model, train, test, figure, "linear 0.588, best grey box 0.191 V", max_effects=5)


def motor(folder: Path) -> Case:
    """Geared motor on an H-bridge: dead zone, delay."""
    data = rco.Measurement.from_csv(
        folder / "dcmotor.csv", "voltage", "rpm", time="time", input_units="V", output_units="rpm"
    )
    model = ct.ss(
        [[-1 / 0.28]], [[35 / 0.28]], [[1.0]], [[0.0]],
        inputs=["voltage"], outputs=["rpm"], states=["speed"], name="motor",
    )  # fmt: skip
    # every third step of 3 s judges: the record drives one way first, the other way later
    steps = [data.segment(3.0 * k, 3.0 * (k + 1)) for k in range(int(data.timepts[-1] // 3.0))]
    learnt = [data.segment(3.0 * k, 3.0 * (k + 2)) for k in range(0, len(steps) - 1, 3)]
    judged = [part for k, part in enumerate(steps) if k % 3 == 2]
    level = np.concatenate([part.outputs[0] for part in judged])
    spread = float(np.linalg.norm(level - level.mean()))

    def figure(refined: rco.Refinement) -> str:
        errors = [rco.simulate(refined, part).outputs[0] - part.outputs[0] for part in judged]
        return f"NRMSE {float(np.linalg.norm(np.concatenate(errors))) / spread:.4f} held out"

    return Case(
        model, learnt, judged[-1], figure, "linear 0.253, dead zone 0.055, signed bias 0.034 (in sample)"
    )


def silverbox(folder: Path) -> Case:
    """Duffing circuit from linear parameters 20 % off, the hold left to the tool."""
    file = loadmat(folder / "SNLS80mV.mat")
    u, y = file["V1"].ravel(), file["V2"].ravel()
    start, stop = 40650, 127400
    cut = start + int(0.75 * (stop - start))
    off = 1.2
    model = ct.ss(
        [[0, 1], [-1.84e5 * off, -41.8 * off]], [[0], [1.94e5 * off]], [[1, 0]], 0,
        inputs="V1", outputs="V2", states=["x", "v"], name="silverbox",
    )  # fmt: skip

    def part(first: int, last: int) -> rco.Measurement:
        return rco.Measurement(
            u[first:last],
            y[first:last],
            dt=1 / 610.35,
            input_labels="V1",
            output_labels="V2",
            name="silverbox",
        )

    def figure(refined: rco.Refinement) -> str:
        found = []
        for data in (part(cut, stop), part(100, 40575)):
            errors = []
            for hold in ("zoh", "foh", "bandlimited"):
                held = data.with_hold(hold)
                errors.append(1e3 * _rms((rco.simulate(refined, held).outputs - held.outputs)[0, 50:]))
            found.append(min(errors))
        return f"multisine {found[0]:.3f}, arrow {found[1]:.3f} mV"

    return Case(model, part(start, cut), part(cut, stop), figure, "0.30-0.36 / 0.26 mV")


def emps(folder: Path) -> Case:
    """Positioning drive, an integrator with dry friction; windows of 1 s, and the whole record."""
    file = loadmat(folder / "DATA_EMPS.mat")
    force = float(file["gtau"].ravel()[0]) * file["vir"].ravel()
    n = force.size // 5 * 5
    data = rco.Measurement(
        force[:n].reshape(-1, 5).mean(axis=1), file["qm"].ravel()[:n:5], dt=5e-3,
        input_labels="force", output_labels="q", name="EMPS",
    )  # fmt: skip
    cut = int(0.6 * data.n_samples)
    train, test = (
        rco.Measurement(
            data.inputs[:, part], data.outputs[:, part], dt=data.dt, input_labels="force", output_labels="q"
        )
        for part in (slice(0, cut), slice(cut, None))
    )
    mass, viscous = 95.11, 203.5
    model = ct.ss(
        [[0, 1], [0, -viscous / mass]], [[0], [1 / mass]], [[1, 0]], 0,
        inputs="force", outputs="q", states=["q", "v"], name="EMPS",
    )  # fmt: skip

    def figure(refined: rco.Refinement) -> str:
        position = test.outputs[0]
        speed = np.gradient(position, test.dt)
        length = round(1.0 / test.dt)
        errors = []
        for first in range(0, test.n_samples - length + 1, length):
            window = rco.Measurement(
                test.inputs[:, first : first + length], test.outputs[:, first : first + length], dt=test.dt,
                input_labels="force", output_labels="q",
            )  # fmt: skip
            state = np.zeros(refined.initial_states.shape[1])  # inner states of effects start at rest
            state[:2] = position[first], speed[first]
            run = rco.simulate(refined, window, state)
            errors.append(run.outputs - window.outputs)
        whole = rco.simulate(refined, data)
        return (
            f"{1e3 * _rms(np.concatenate(errors, axis=1)):.2f} mm in windows of 1 s from the measured state, "
            f"{1e3 * _rms(whole.outputs - data.outputs):.2f} mm over the whole record"
        )

    return Case(model, train, test, figure, "2.64 mm over the whole record")


def _held_out(model: ct.StateSpace, data: rco.Measurement, printed: str, unit: str) -> Case:
    """The last fifth of a record judges."""
    train, test = data.split(0.8)

    def figure(refined: rco.Refinement) -> str:
        found = rco.compare(refined, test)
        return " / ".join(f"{value:.4g}" for value in found.rmse) + f" {unit} held out"

    return Case(model, train, test, figure, printed)


def flexlink(folder: Path) -> Case:
    """Rotary flexible link in closed loop: Coulomb friction of the servo, by its authors."""
    rows = np.genfromtxt(folder / "flexlink.csv", delimiter=",", names=True)
    turns = np.vstack([rows["theta_deg"], rows["alpha_deg"]])
    data = rco.Measurement(
        rows["voltage_V"], turns, dt=2e-3, input_labels="voltage", output_labels=["theta", "alpha"],
        output_units=["deg", "deg"], name="flexlink",
    )  # fmt: skip
    J, B, K, link = 0.00208, 0.025, 1.3, 0.065 * 0.419**2 / 3
    gain = 0.9 * 70 * 0.69 * 0.00768 / 2.6
    loss, deg = B + gain * 70 * 0.00768, 180 / np.pi
    A = np.array([
        [0, 0, 1, 0], [0, 0, 0, 1], [0, K / J, -loss / J, 0], [0, -K / J - K / link, loss / J, 0],
    ])  # fmt: skip
    model = ct.ss(
        A, [[0], [0], [gain / J], [-gain / J]], [[deg, 0, 0, 0], [0, deg, 0, 0]], 0, inputs="voltage",
        outputs=["theta", "alpha"], states=["theta", "alpha", "dtheta", "dalpha"], name="flexlink",
    )  # fmt: skip
    return _held_out(model, data, "Coulomb friction at the servo", "deg")


def tclab(folder: Path) -> Case:
    """Heater and sensor of a temperature laboratory: little is missing."""
    warm, power = np.loadtxt(folder / "tclab_step.csv", delimiter=",", skiprows=1)[:, [4, 6]].T
    data = rco.Measurement(
        power, warm - warm[0], dt=1.0, input_labels="heater", output_labels="sensor",
        output_units="K", name="tclab",
    )  # fmt: skip
    heat, sense, room, between = 5.0, 1.0, 0.05, 0.05  # J/K, J/K, W/K, W/K
    model = ct.ss(
        [[-(room + between) / heat, between / heat], [between / sense, -between / sense]],
        [[0.04 / heat], [0]], [[0, 1]], 0, inputs="heater", outputs="sensor",
        states=["heater_T", "sensor_T"], name="tclab",
    )  # fmt: skip
    return _held_out(model, data, "linear with two nodes 0.23 K", "K")


def undcmotor(folder: Path) -> Case:
    """Motor kit: a dead zone of 0.30 V and a saturating gain; the input has two levels (0.35, 0.44 V)."""
    rows = np.genfromtxt(folder / "undcmotor_prbs.csv", delimiter=",", names=True)
    data = rco.Measurement(
        rows["u"],
        rows["y"],
        dt=0.02,
        input_labels="u",
        output_labels="y",
        output_units="deg/s",
        name="undcmotor",
    )
    model = ct.ss(
        [[-10.0]], [[1530.0]], [[1]], 0, inputs="u", outputs="y", states=["speed"], name="undcmotor"
    )
    return _held_out(model, data, "static curve measured apart", "deg/s")


def roll(folder: Path) -> Case:
    """Ship model released in roll: damping that grows with the amplitude."""
    t, phi = np.loadtxt(folder / "rolldecay.csv", delimiter=",", skiprows=1).T
    data = rco.Measurement.free_decay(phi, timepts=t, output_labels="phi", output_units="rad", name="roll")
    w, ratio = 2 * np.pi / 2.54, 0.007
    model = ct.ss(
        [[0, 1], [-(w**2), -2 * ratio * w]], [[0], [1]], [[1, 0]], 0, inputs="moment", outputs="phi",
        states=["phi", "rate"], name="roll",
    )  # fmt: skip
    return _held_out(model, data.decimate(5), "quadratic damping", "rad")


CASES: dict[str, tuple[str, Callable[[Path], Case]]] = {
    "tanks": ("dataBenchmark.csv", tanks),
    "motor": ("dcmotor.csv", motor),
    "silverbox": ("SNLS80mV.mat", silverbox),
    "emps": ("DATA_EMPS.mat", emps),
    "flexlink": ("flexlink.csv", flexlink),
    "tclab": ("tclab_step.csv", tclab),
    "undcmotor": ("undcmotor_prbs.csv", undcmotor),
    "roll": ("rolldecay.csv", roll),
}


def main() -> int:
    """Run the ladders."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the records")
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--pictures", type=Path, help="folder for a staircase per record")
    options = parser.parse_args()
    mpl.use("Agg")
    for name in options.only:
        file, make = CASES[name]
        if not (options.data / file).is_file():
            sys.stdout.write(f"skipped {name}: {file} is not in {options.data}\n\n")
            continue
        case = make(options.data)
        began = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # short parts of a record excite little: the ledger shows it
            ladder = rco.improve(
                case.model, case.data, validation=case.validation, free="linear",
                candidates=case.candidates, max_effects=case.max_effects,
            )  # fmt: skip
            seconds = time.process_time() - began
            sys.stdout.write(f"{name}\n{ladder}\n")
            for step in ladder.steps:
                label = "start" if step.effect is None else f"{step.action} {step.effect.label}"
                rivals = f" (tied with {', '.join(e.label for e in step.rivals)})" if step.rivals else ""
                sys.stdout.write(
                    f"  {label}: {case.figure(step.refinement)}, {len(step.refinement.parameters)} "
                    f"parameters{rivals}\n"
                )
        sys.stdout.write(f"  in print: {case.printed}; {seconds:.0f} s of processor time\n\n")
        sys.stdout.flush()
        if options.pictures:
            ladder.plot().figure.savefig(options.pictures / f"{name}.png", dpi=120)
            plt.close("all")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
