"""Failures in the state space: forces over displacement or velocity.

These forces act at a place, and follow its motion. The motion behind a record is estimated by a forward
and a backward pass that correct the model by its residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from ...engine.smoother import smooth
from ...jit import compiled, put
from ...models.ports import Port
from ...systems.discretization import discretize
from ...systems.linear import Array
from .likelihood import Explanation
from .record import Finding, ModelOnRecord

if TYPE_CHECKING:
    from ..result import Comparison


_MEMORY = 0.9  # of the unknown force, from one sample to the next
_NOISE = 0.02  # sensor noise over the spread of an output, the unit of the force levels that are tried
_FORCE_LEVELS = (0.01, 0.1, 0.5, 2.0, 10.0)
_QUANTILES = (0.3, 0.5, 0.65, 0.8, 0.9)
_LEVELS = (0.5, 0.7, 0.85, 0.95)  # quantiles of a first-order state
_STEPS, _FINE = 6, 8  # per sample, in the loop with the motion and along a known one
_COARSE, _LONG = 2, 30_000  # of both, from so many samples on
_WORTH = 30.0  # twice the log-likelihood from which on a law is tried in the loop
_SEEN = 0.1  # of a response, beside offset and initial state, from which on it can be told from them
_UNLIKE = 0.2  # of the larger of two steps, from which on they count as different

_MEANINGS = {
    "dry": "jumps where the motion reverses, like dry friction",
    "dry by direction": "jumps where the motion reverses, by a different amount in each direction, like "
    "worn guides",
    "odd velocity": "grows more than proportionally to speed, like drag",
    "one side of velocity": "depends on the direction of motion",
    "root": "follows the square root, like an outflow",
    "beyond": "sets in beyond a limit, like a stop or a hardening spring",
    "beyond, one side": "sets in beyond a limit on one side only, like a stop",
    "odd displacement": "grows more than proportionally to displacement, like a hardening spring",
    "even displacement": "is larger on one side, like an asymmetric spring",
    "one side": "differs between the two sides, like a crack or a loose contact",
}
_OF_STORES = {
    "dry": "changes sign with the state and has nearly constant size",
    "dry by direction": "jumps where the state changes sign, by a different amount on each side",
    "odd velocity": "grows more than proportionally to the state, like radiation or a turbulent leak",
    "beyond": "sets in beyond a limit, like an overflow",
}
#: The same where the force does not resist: the model has too much of it.
_ASSISTING = {
    "dry": "jumps where the motion reverses and acts along it, unlike friction",
    "dry by direction": "jumps where the motion reverses and acts along it, unlike friction",
    "odd velocity": "acts along the motion at high speed: the damping grows less than proportionally",
    "root": "has the shape of a square root and adds to the state, like an inflow",
    "beyond": "weakens the restoring force beyond a limit, like a softening spring",
    "beyond, one side": "weakens the restoring force beyond a limit on one side",
    "odd displacement": "weakens the restoring force at large displacement, like a softening spring",
}
_ASSISTING_STORES = {
    "dry": "changes sign with the state, has nearly constant size and adds to the state",
    "dry by direction": "jumps where the state changes sign, and adds to the state",
    "odd velocity": "adds to a large state: the outflow grows less than proportionally",
    "beyond": "reduces the outflow beyond a limit",
}


# ---------------------------------------------------------------------- motion and force
class MotionEstimate(NamedTuple):
    """Motion that the record shows."""

    states: Array  #: (n, N)
    force: Array  #: (N,), unknown force at the place
    likelihood: float  #: log-likelihood per sample of the residual, up to a constant


def estimated_motion(scene: ModelOnRecord, index: int) -> MotionEstimate:
    """Estimate the states of the recorded motion.

    An unknown force at a place explains what the model with its known input leaves (first stage of the paper,
    with a Kalman gain). Its level is the most likely one. A backward pass removes the lag.
    """
    assert scene.places is not None
    A, place, ny = scene.places.A, scene.places.places[index], scene.n_outputs
    n = len(A)
    # augmented state: model and an unknown force as a first-order process
    Phi, G, _ = discretize(A, place.act[:, None], scene.dt, "zoh")
    # a force of unit output, over the record
    unit = np.where(np.arange(scene.n_samples) % 7 < 3, 1.0, -1.0)
    size = float(np.std(scene.forced([(index, unit)])[0])) or np.inf
    F = np.block([[Phi, G / size], [np.zeros((1, n)), np.full((1, 1), _MEMORY)]])
    H = np.hstack([scene.places.C, place.output[:, None] / size]) / scene.scale
    best = MotionEstimate(scene.states, np.zeros(scene.n_samples), -np.inf)
    # force level by maximum likelihood
    for level in _FORCE_LEVELS:
        force = (1 - _MEMORY**2) * level**2
        Q = 1e-12 * force / (n + 1) * np.eye(n + 1)  # no direction without any noise
        Q[n, n] += force
        # Kalman filter and smoother on the residual
        found = smooth(F, H, Q, _NOISE**2 * np.eye(ny), scene.evidence.with_offset.T, reset=scene.reset)
        if np.isfinite(found.power) and found.power > 0:
            # noise and force in proportion: their common size is the likeliest one
            value = -ny * np.log(found.power) - found.log_determinant
            if value > best.likelihood:
                change = found.states if np.isfinite(found.states).all() else found.filtered
                best = MotionEstimate(scene.states + change[:, :n].T, change[:, n] / size, value)
    return best


@dataclass(frozen=True, slots=True, eq=False)
class ResidualForce:
    """Force that a model lacks at a place, along the motion there.

    Attributes
    ----------
    place : str
        Port.
    mechanical : bool
        Whether it has a displacement and a velocity.
    position, velocity, force : ndarray of shape (N,)
        Motion, and resisting force, in the model's units.
    position_unit, velocity_unit, force_unit : str
        Units.
    """

    place: str
    mechanical: bool
    position: Array
    velocity: Array
    force: Array
    position_unit: str
    velocity_unit: str
    force_unit: str


def residual_force(comparison: Comparison, index: int = 0, place: str | None = None) -> ResidualForce | None:
    """Estimate the force that a model lacks at a place.

    Parameters
    ----------
    comparison : Comparison
        Models on a record.
    index : int
        Which of the models.
    place : str, optional
        Port; default the one whose force explains most of the record.

    Returns
    -------
    ResidualForce or None
        None for a model without ports.
    """
    scene = ModelOnRecord(comparison, index)
    if scene.places is None:
        return None
    ports = scene.places.places
    tried = [i for i, port in enumerate(ports) if place in (None, port.name)]
    # the place whose unknown force is most likely
    estimates = [(estimated_motion(scene, i), ports[i]) for i in tried]
    estimate, port = max(estimates, key=lambda pair: pair[0].likelihood)
    d, v = _motion_at(scene, port, estimate.states)
    units = port.position_unit, port.velocity_unit, port.force_unit
    return ResidualForce(port.name, port.kind == "mechanical", d, v, estimate.force, *units)


def _motion_at(scene: ModelOnRecord, port: Port, states: Array) -> tuple[Array, Array]:
    """Return displacement and velocity (N,) at a place."""
    w = scene.data.inputs
    return port.position @ states + port.position_input @ w, port.velocity @ states + port.velocity_input @ w


def _interpolate(scene: ModelOnRecord, signal: Array, factor: int) -> Array:
    """Interpolate a motion to several values per sample.

    A force that jumps does so between samples.
    """
    factor = factor if signal.size < _LONG else _COARSE
    parts = []
    for a, b in pairwise([*scene.starts, signal.size]):
        grid, part = np.arange(b - a), signal[a:b]
        at = np.minimum(np.arange((b - a) * factor) / factor, b - a - 1)
        smooth_enough = b - a >= 4 and np.ptp(part) > 0
        parts.append(CubicSpline(grid, part)(at) if smooth_enough else np.interp(at, grid, part))
    return np.concatenate(parts)


# ---------------------------------------------------------------------- laws
_LINEAR, _DRY, _BEYOND, _ABOVE, _BELOW, _SIZE, _SIGNED_SQUARE, _SQUARE, _CUBE, _ROOT = range(10)


@compiled
def force_along(code, s, size):  # type: ignore[no-untyped-def]
    """Force of a law along a motion s: a displacement or a velocity."""
    if code == _DRY:
        return np.tanh(s / size)
    if code == _BEYOND:
        return np.sign(s) * np.maximum(np.abs(s) - size, 0.0)
    if code == _ABOVE:
        return np.maximum(s - size, 0.0)
    if code == _BELOW:
        return np.minimum(s + size, 0.0)
    if code == _SIZE:
        return np.abs(s)
    if code == _SIGNED_SQUARE:
        return s * np.abs(s)
    if code == _SQUARE:
        return s * s / size
    if code == _CUBE:
        return s * s * s / size**2
    if code == _ROOT:
        return np.sign(s) * np.sqrt(np.abs(s))
    return s * 1.0


class ForceLaw(NamedTuple):
    """Force law with open coefficients, and the region where it is nonzero."""

    name: str
    where: str  #: region in words
    axis: str  #: "d", "v", or "x" of a first-order state
    code: int  #: of `force_along`
    size: float = 1.0  #: by which the motion is divided there, or the kink
    values: dict[str, Any] | None = None  #: the region as numbers
    resists: bool = True  #: whether its force acts against the motion

    @property
    def kinked(self) -> bool:
        """Return whether it sets in at a limit."""
        return self.code in (_BEYOND, _ABOVE, _BELOW)

    @property
    def dof(self) -> int:
        """Return the numbers that it takes, the place of a kink counted."""
        return 2 if self.kinked or self.name == "dry by direction" else 1

    @property
    def meaning(self) -> str:
        """Description of a force of this law."""
        meanings = dict(_MEANINGS) if self.resists else {**_MEANINGS, **_ASSISTING}
        if self.axis == "x":
            meanings |= _OF_STORES if self.resists else _ASSISTING_STORES
        return meanings[self.name]

    def forces(self, s: Array) -> list[Array]:
        """Return the forces of which it is a combination, along a motion."""
        force = force_along(self.code, s, self.size)
        return [np.maximum(force, 0.0), np.minimum(force, 0.0)] if "by direction" in self.name else [force]


def _over_velocity(place: Port, v: Array) -> list[ForceLaw]:
    x, spread = "x" if place.kind == "first_order" else "v", float(v.std())
    near, large, turn = f"near {x} = 0", f"at large |{x}|", {"low": 0.0, "high": 0.0}
    laws = [ForceLaw("linear velocity", "everywhere", x, _LINEAR)]
    if v.min() < -0.05 * spread and v.max() > 0.05 * spread:
        dry = ForceLaw("dry", near, x, _DRY, 0.005 * spread, turn)
        laws += [dry, dry._replace(name="dry by direction")]
    laws.append(ForceLaw("odd velocity", large, x, _SIGNED_SQUARE))
    laws.append(ForceLaw("odd velocity", large, x, _CUBE, spread))
    if x == "x":
        laws.append(ForceLaw("root", "as the root of x", x, _ROOT))
        for g in map(float, np.quantile(v, _LEVELS)):
            where = f"x > {f'{g:.3g} {place.velocity_unit}'.rstrip()}"
            laws.append(ForceLaw("beyond", where, x, _ABOVE, g, {"low": g}))
    elif v.min() < 0 < v.max():
        laws.append(ForceLaw("one side of velocity", "one sign of v", x, _SIZE))
    return laws


def _over_displacement(place: Port, d: Array) -> list[ForceLaw]:
    spread = float(d.std())
    laws = [
        ForceLaw("linear displacement", "everywhere", "d", _LINEAR),
        ForceLaw("odd displacement", "at large |d|", "d", _CUBE, spread),
        ForceLaw("even displacement", "larger for one sign of d", "d", _SQUARE, spread),
    ]
    for g in map(float, np.quantile(np.abs(d), _QUANTILES)):
        text = f"{g:.3g} {place.position_unit}".rstrip()
        laws.append(ForceLaw("beyond", f"|d| > {text}", "d", _BEYOND, g, {"low": g}))
        for side, code, where in ((1, _ABOVE, f"d > {text}"), (-1, _BELOW, f"d < -{text}")):
            laws.append(ForceLaw("beyond, one side", where, "d", code, g, {"low": g, "side": side}))
    return [*laws, ForceLaw("one side", "d > 0 and d < 0 differ", "d", _SIZE, values={"low": 0.0})]


def _laws_at(place: Port, d: Array, v: Array) -> list[tuple[ForceLaw, list[Array]]]:
    """Return laws and forces that vary along the motion at a place."""
    along = [(law, law.forces(v)) for law in (_over_velocity(place, v) if np.ptp(v) > 0 else ())]
    along += [(law, law.forces(d)) for law in (_over_displacement(place, d) if np.ptp(d) > 0 else ())]
    return [pair for pair in along if all(np.isfinite(f).all() and np.ptp(f) > 0 for f in pair[1])]


# ---------------------------------------------------------------------- search
_Laws = list[tuple[ForceLaw, list[Array]]]


def _columns(scene: ModelOnRecord) -> list[tuple[int, Port, _Laws]]:
    """Return the force laws at each place, and what their forces would do.

    The forces follow the motion that the record shows if a force acts at that place.
    """
    if scene.laws is None:
        assert scene.places is not None
        scene.laws = []
        seen: list[Array] = []
        for i, p in enumerate(scene.places.places):
            rows = np.concatenate([p.act, p.position, p.velocity, p.position_input, p.velocity_input])
            if any(np.array_equal(rows, other) for other in seen):
                continue  # the same place by another name
            seen.append(rows)
            d, v = _motion_at(scene, p, estimated_motion(scene, i).states)
            laws = _laws_at(p, _interpolate(scene, d, _FINE), _interpolate(scene, v, _FINE))
            if laws:
                columns = iter(scene.forced([(i, force) for _, forces in laws for force in forces]))
                scene.laws.append((i, p, [(law, [next(columns) for _ in forces]) for law, forces in laws]))
    return scene.laws


def forces_at_places(scene: ModelOnRecord) -> list[Finding]:
    """Laws at each place, and all of them together per place."""
    if scene.places is None:
        return []
    found: list[Finding] = []
    leaders: list[tuple[int, Port, ForceLaw, Explanation, int]] = []
    # each place: best nonlinear laws by likelihood, then linear and general forces
    for index, place, laws in _columns(scene):
        tried = len(laws) * len(scene.places.places)
        judged = _best_curved(scene, laws)
        found += [_finding(place, law, explanation, tried) for law, explanation in judged]
        if judged:
            leaders.append((index, place, *max(judged, key=lambda pair: pair[1].gain), tried))
        found += _whole_forces(scene, place, laws, len(scene.places.places))
    # the two best laws again, in a loop with the motion that they cause
    for index, place, law, explanation, tried in sorted(leaders, key=lambda row: -row[3].gain)[:2]:
        if explanation.gain > _WORTH:
            found.append(_finding(place, *_fit_in_loop(scene, index, law, explanation), tried))
    return found


def _best_curved(scene: ModelOnRecord, laws: _Laws) -> list[tuple[ForceLaw, Explanation]]:
    """Return the nonlinear laws that explain the most, with their fits."""
    curved = [
        (law, columns)
        for law, columns in laws
        if law.code != _LINEAR and (len(columns) == 1 or _directions_differ(scene, *columns))
    ]
    return [
        (curved[k][0]._replace(resists=bool(explanation.values.sum() > 0)), explanation)
        for k, explanation in scene.evidence.best_of([columns for _, columns in curved])
    ]


def _whole_forces(scene: ModelOnRecord, place: Port, laws: _Laws, tried: int) -> list[Finding]:
    """Return what any force at a place explains, and what a linear one does."""
    straight = [column for law, columns in laws for column in columns if law.code == _LINEAR]
    usual = ("dry", "odd velocity", "odd displacement")
    every = straight + [column for law, columns in laws for column in columns if law.name in usual]
    name, state = place.name, "state there"
    at = f"coefficient of {name}"
    if place.kind == "mechanical":
        at, state = f"stiffness and damping at {name}", "motion there"
    force = f"{place.acts_by} at {name} that depends on the {state}"
    change = f"change of the linear coefficients at {name} alone"
    found = []
    for where, measure, kind, what, columns in (
        (f"force at {name}", "hidden force", "force", force, every),
        (at, "linear force", "linear force", change, straight),
    ):
        explanation = scene.evidence.linear(columns)
        share = 100 * scene.evidence.share_of_error(scene.evidence.whole(explanation))
        text = f"A {what} would explain {share:.3g} % of the error."
        values = {"place": name, "kind": kind}
        found.append(Finding("place", where, measure, explanation, len(columns), tried, text, values))
    return found


def _directions_differ(scene: ModelOnRecord, forward: Array, backward: Array) -> bool:
    """Return whether force steps that differ by direction can be identified.

    They must show as more than a constant offset.
    """
    # difference of the two steps beyond a constant offset
    both = forward - backward
    left = scene.evidence.without_nuisance(both)
    if np.linalg.norm(left) < _SEEN * np.linalg.norm(both):
        return False
    steps = scene.evidence.linear([forward, backward]).values
    return bool(min(steps * np.sign(steps.sum())) > 0 and np.ptp(steps) > _UNLIKE * np.abs(steps).max())


def _fit_in_loop(
    scene: ModelOnRecord, index: int, law: ForceLaw, explanation: Explanation
) -> tuple[ForceLaw, Explanation]:
    """The law in the loop: its force follows the motion that it causes itself."""
    assert scene.places is not None
    if (law.dof > 1 and (law.axis == "x" or not law.kinked)) or law.code == _ROOT:
        return law, explanation
    A, C, port = scene.places.A, scene.places.C, scene.places.places[index]
    steps = _STEPS if scene.n_samples < _LONG else _COARSE
    motion = _interpolate(scene, _motion_at(scene, port, scene.states)[law.axis != "d"], _STEPS)
    row = port.position if law.axis == "d" else port.velocity
    # fine steps within the sample; the table gives state, motion and outputs at once
    Phi, G, _ = discretize(A, port.act[:, None], scene.dt / steps, "zoh")
    step = np.hstack([Phi, G])
    table = np.ascontiguousarray(np.vstack([step, row @ step, np.hstack([C, port.output[:, None]])]))

    def shape(point: Array) -> Array:
        out = np.zeros((scene.n_samples, scene.n_outputs))
        factor = float(explanation.values[0] * (1.0 + point[0]))
        size = float(law.size * np.exp(point[1])) if law.kinked else float(law.size)
        loop(table, motion, steps, scene.reset, law.code, factor, size, out)
        return np.asarray(out.T / scene.scale)

    with np.errstate(over="ignore", invalid="ignore"):
        start = np.zeros(1 + law.kinked)
        first = shape(start)
        if not np.isfinite(first).all() or np.abs(first).max() > 1e3:
            return law, explanation
        # fit factor and limit by Gauss-Newton
        found = scene.evidence.descended(shape, start)
    if not np.isfinite(found.gain) or found.gain <= explanation.gain:
        return law, explanation
    law = law._replace(resists=bool(explanation.values[0] * (1.0 + found.values[0]) > 0))
    if law.kinked:
        g = float(law.size * np.exp(found.values[1]))
        where = law.where.replace(f"{law.size:.3g}", f"{g:.3g}")
        law = law._replace(where=where, values={**(law.values or {}), "low": g})
    return law, found


@compiled
def loop(table, motion, steps, reset, code, factor, size, out):  # type: ignore[no-untyped-def]
    """Outputs (N, n_y) that a force adds which follows the motion and itself.

    Rows of the table, by state and force: next state (n), its motion at the place, outputs (n_y); `motion`
    is that without the force, several steps per sample.
    """
    n = table.shape[1] - 1
    state = np.zeros(n + 1)
    added = 0.0
    for k in range(out.shape[0]):
        if reset[k]:
            state = np.zeros(n + 1)
            added = 0.0
        for j in range(steps):
            state[n] = factor * force_along(code, motion[k * steps + j] + added, size)
            after = table @ state
            if j == 0:
                put(out[k], 0, after[n + 1 :])
            put(state, 0, after[:n])
            added = after[n]


def _finding(place: Port, law: ForceLaw, explanation: Explanation, tried: int) -> Finding:
    text = f"The {place.acts_by} that is missing at {place.name} {law.meaning} ({law.where})."
    values = {"place": place.name, "law": law.name, "kind": "state", "axis": law.axis}
    where, values = f"{place.name}, {law.where}", values | (law.values or {})
    return Finding("state", where, "residual force", explanation, law.dof, tried, text, values)
