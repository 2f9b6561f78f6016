"""Where to start: shapes of laws from the motion, and scans of far-off coefficients."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from scipy.signal import find_peaks, welch

from ..data.measurement import Measurement
from ..effects.kernel import NEEDS_WIDTH
from ..engine.engine import Engine
from ..engine.observer import observer_gain
from ..engine.structure import Structure
from ..systems.linear import Array
from .problem import Problem

__all__ = ["Motion", "estimated_motion", "far_starts", "law_widths", "shape_starts"]

_SIGN_WIDTH = 0.005  # of the rms velocity
_ROOT_WIDTH = 1e-3  # of the rms level
_AT_REST = 0.01  # of the largest rms velocity among several records
_MOST_STARTS = 24
_SHAPED = (
    "asymmetric_friction",
    "clearance",
    "hidden_mode",
    "hysteresis",
    "stribeck_friction",
    "threshold_flow",
)  # laws at ports whose start needs the motion there


class Motion:
    """Displacement and velocity at the ports, estimated by an observer of the model."""

    def __init__(self, structure: Structure, theta: Array, data: Measurement, ratio: float = 1.0) -> None:
        engine = Engine(structure, data)
        gain = observer_gain(structure, theta, data, ratio)
        run = engine.run(theta, sensitivity=False, gain=gain, histories=True, check=False)
        self.data = data
        self.states = np.nan_to_num(run.states)
        self.residual = data.outputs - np.nan_to_num(run.outputs)
        self.companions: list[Motion] = []  # the same system in other records
        self._structure = structure

    def port(self, name: str) -> tuple[Array, Array]:
        """Displacement and velocity, each of shape (N,), at one port."""
        port = self._structure.model.port(name)
        x = self.states[: port.act.size]
        d = port.position @ x + port.position_input @ self.data.inputs
        v = port.velocity @ x + port.velocity_input @ self.data.inputs
        return d, v


def estimated_motion(structure: Structure, theta: Array, data: Measurement) -> Motion:
    """Motion at the ports as the record and the model together see it.

    Parameters
    ----------
    structure : Structure
        Model, as far as it is known.
    theta : ndarray, shape (p,)
        Coefficients.
    data : Measurement
        Record.

    Returns
    -------
    Motion
    """
    return Motion(structure, theta, data)


def law_widths(structure: Structure, motion: Motion) -> dict[int, float]:
    """Smoothing width of each law that has one: a small share of the motion there.

    Parameters
    ----------
    structure : Structure
        Model with the effects.
    motion : Motion
        Estimated motion at the ports; of several records the quietest counts.

    Returns
    -------
    dict
        ``{index of the effect: width}``.
    """
    widths: dict[int, float] = {}
    motions = [motion, *motion.companions]
    for index in structure.port_effects:
        effect = structure.effects[index]
        if effect.kind in NEEDS_WIDTH:
            given = (effect.fixed or {}).get("width")
            share = _ROOT_WIDTH if effect.kind == "sqrt_flow" else _SIGN_WIDTH
            speeds = np.array([np.sqrt(np.mean(m.port(effect.place)[1] ** 2)) for m in motions])
            # sharp enough for the quietest record that moves at all
            rms = float(speeds[speeds >= _AT_REST * speeds.max()].min())
            widths[index] = float(given) if given is not None else share * rms or 1.0
    return widths


def shape_starts(structure: Structure, theta: Array, motion: Motion) -> list[Array]:
    """Starting points for the coefficients that shape a law (gaps, delays, limits, ...).

    Parameters
    ----------
    structure : Structure
        Model with the effects.
    theta : ndarray, shape (p,)
        Default start; user's own starts are kept.
    motion : Motion
        Estimated motion at the ports.

    Returns
    -------
    list of ndarray
        Points to try, the default first where nothing needs a shape.
    """
    joint: list[list[list[tuple[int, float]]]] = []
    for index, effect in enumerate(structure.effects):
        given = effect.start or {}
        wanted = {
            name: structure.position(index, name)
            for name in effect.coefficients
            if structure.position(index, name) >= 0 and name not in given
        }
        options = _options(structure, index, motion)
        rows = []
        for option in options:
            row = [(wanted[name], value) for name, value in option.items() if name in wanted]
            if row and row not in rows:
                rows.append(row)
        if rows:
            joint.append(rows)
    starts = []
    for combination in itertools.islice(itertools.product(*joint), _MOST_STARTS):
        point = theta.copy()
        for column, value in itertools.chain.from_iterable(combination):
            point[column] = value
        starts.append(point)
    return starts or [theta.copy()]


def _options(structure: Structure, index: int, motion: Motion) -> Sequence[dict[str, float]]:
    effect, data = structure.effects[index], motion.data
    kind = effect.kind
    if kind.startswith("input_"):
        w = data.inputs[structure.linear_model.input_labels.index(effect.place)]
        if kind == "input_deadzone":
            levels = np.quantile(np.abs(w[w != 0]), [0.05, 0.2, 0.4, 0.6]) if (w != 0).any() else [0.1]
            return [{"threshold": float(q)} for q in levels]
        if kind == "input_saturation":
            return [{"limit": float(q)} for q in np.quantile(np.abs(w), [0.97, 0.85, 0.6])]
        if kind == "input_delay":
            return [{"delay": q * data.dt} for q in (0.5, 2.5, 6.0)]
        if kind == "input_lag":
            return [{"time_constant": q * data.dt} for q in (1.0, 5.0, 25.0)]
        return []
    if kind.startswith("output_"):
        y = data.outputs[structure.linear_model.output_labels.index(effect.place)]
        if kind == "output_saturation":
            top = float(np.abs(y).max())
            return [{"limit": q * top} for q in (0.995, 0.9)]
        if kind == "output_rectification":
            return [{"fraction": q} for q in (0.9, 0.2)]
        if kind == "output_delay":
            return [{"delay": q * data.dt} for q in (0.5, 2.5, 6.0)]
        if kind == "output_lag":
            return [{"time_constant": q * data.dt} for q in (1.0, 5.0, 25.0)]
        return []
    if kind in (
        "clearance",
        "asymmetric_friction",
        "stribeck_friction",
        "hysteresis",
        "threshold_flow",
        "hidden_mode",
    ):
        d, v = motion.port(effect.place)
        rms_d, rms_v = float(np.sqrt(np.mean(d**2))), float(np.sqrt(np.mean(v**2)))
        if kind == "clearance":
            return [{"gap": float(q)} for q in np.quantile(np.abs(d), [0.4, 0.7, 0.9, 0.1])]
        inertia = structure.inertia(effect.place)
        pull = inertia * float(np.std(np.gradient(v, data.dt))) if np.isfinite(inertia) else 1.0
        if kind == "asymmetric_friction":
            # equal levels too: from zero, a push one way and a brake the other can look as good
            return [{"force_plus": q * pull, "force_minus": q * pull} for q in (0.0, 0.05, 0.2)]
        if kind == "stribeck_friction":
            # a level to begin with: at zero force the fading speed has no gradient
            return [
                {"velocity": q * rms_v, "coulomb_force": share * pull, "static_force": 2 * share * pull}
                for share in (0.05, 0.2)
                for q in (0.3, 0.1, 1.0)
            ]
        if kind == "hysteresis":
            return [{"displacement": q * rms_d} for q in (0.3, 0.05, 1.0)]
        if kind == "threshold_flow":
            return [{"threshold": float(q)} for q in np.quantile(v, [0.7, 0.9, 0.5])]
        return _mode_options(structure, index, motion)
    return []


def _mode_options(structure: Structure, index: int, motion: Motion) -> list[dict[str, float]]:
    """An attached mode, seeded at the peaks of the residual."""
    data = motion.data
    residual = motion.residual - motion.residual.mean(axis=1, keepdims=True)
    segment = min(1024, data.n_samples)
    frequency, power = welch(residual, fs=1.0 / data.dt, nperseg=segment)
    level = np.log(power.mean(axis=0) + 1e-300)[1:]
    peaks, info = find_peaks(level, prominence=0.5)
    order = np.argsort(info["prominences"])[::-1][:3]
    places = list(frequency[1:][peaks[order]]) or [0.05 / data.dt]
    act = structure.model.port(structure.effects[index].place).act
    inverse = float(np.abs(act).max()) or 1.0
    options = []
    for f in places:
        mass = 0.03 / inverse
        omega = 2 * np.pi * f
        options.append({"mass": mass, "damping": 0.06 * mass * omega, "stiffness": mass * omega**2})
    return options


def far_starts(problem: Problem, structure: Structure, theta: Array) -> list[Array]:
    """Coefficients far from the model's, found by scanning each over decades.

    A parameter that is wrong by orders of magnitude can have no gradient at all (an
    inductance so small that the current settles within a sample).

    Parameters
    ----------
    problem : Problem
        Short problem in which to judge.
    structure : Structure
        Model with the effects.
    theta : ndarray, shape (p,)
        Where to scan from.

    Returns
    -------
    list of ndarray
        The best point of a coordinate-wise scan, empty where nothing can be scanned.
    """
    nominal = {(q.kind, q.place): abs(q.value) for q in structure.model.parameters}
    columns = []
    for i, parameter in enumerate(structure.parameters):
        effect = structure.effects[parameter.effect]
        size = nominal.get((effect.kind, effect.place), 0.0)
        if effect.kind == "mass":
            size = structure.inertia(effect.place)
        if effect.kind in ("stiffness", "damping", "mass") and 0 < size < np.inf:
            columns.append((i, size))
    if not columns:
        return []
    factors = np.logspace(-5, 5, 21)
    points = []
    for base in (theta, structure.start()):
        point = base.copy()
        best = _free_run_cost(problem, point)
        for _ in range(3):
            before = best
            for i, size in columns:
                for value in size * (factors - 1.0):
                    trial = point.copy()
                    trial[i] = max(value, structure.parameters[i].lower)
                    cost = _free_run_cost(problem, trial)
                    if cost < best:
                        best, point = cost, trial
            if best > 0.99 * before:
                break
        points.append(point)
    return points


def _free_run_cost(problem: Problem, theta: Array) -> float:
    total = 0.0
    for engine in problem.engines:
        run = engine.run(theta, sensitivity=False, check=False)
        if run.blew_up >= 0 or not np.isfinite(run.outputs).all():
            return np.inf
        total += float(np.sum((problem.weights[:, None] * (run.outputs - engine.data.outputs)) ** 2))
    return total
