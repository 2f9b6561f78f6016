"""Failures in the state space: forces over displacement or velocity.

These forces act at a place, and follow its motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from ...jit import compiled, put
from ...models.ports import Port
from ...systems.discretization import discretize
from ...systems.linear import Array
from .likelihood import Explanation
from .motion import estimated_motion
from .record import Finding, ModelOnRecord

__all__ = ["ForceLaw", "forces_at_places", "laws_at"]

_QUANTILES = (0.3, 0.5, 0.65, 0.8, 0.9)
_LEVELS = (0.5, 0.7, 0.85, 0.95)  # quantiles of a first-order state

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


@dataclass(frozen=True, slots=True, eq=False)
class ForceLaw:
    """Force law with open coefficients, and the region where it is nonzero.

    Attributes
    ----------
    name : str
        Law.
    where : str
        Region in words.
    dof : int
        Numbers that it takes, the place of a kink counted.
    n_forces : int
        Forces of which it is a combination.
    linear : bool
        Whether the model could hold it.
    code : int
        Its number in the loop with the motion; -1 where it is not run in it.
    size : float
        Size by which displacement or velocity is divided there, or the kink.
    values : dict
        The region as numbers.
    """

    name: str
    where: str
    dof: int = 1
    n_forces: int = 1
    linear: bool = False
    code: int = -1
    size: float = 1.0
    values: dict[str, Any] = field(default_factory=dict)

    @property
    def meaning(self) -> str:
        """Description of a force of this law."""
        of_store = self.values.get("axis") == "x"
        return _OF_STORES.get(self.name, _MEANINGS[self.name]) if of_store else _MEANINGS[self.name]


def laws_at(place: Port, d: Array, v: Array) -> list[tuple[ForceLaw, list[Array]]]:
    """Laws at a place and their forces along a motion, those that vary on it.

    Parameters
    ----------
    place : Port
        Where.
    d, v : ndarray of shape (N,)
        Displacement and velocity there.
    """
    proposed = [*(_over_velocity(place, v) if np.ptp(v) > 0 else ())]
    proposed += _over_displacement(place, d) if np.ptp(d) > 0 else ()
    return [
        (law, forces)
        for law, forces in proposed
        if all(np.all(np.isfinite(f)) and np.ptp(f) > 0 for f in forces)
    ]


def _over_velocity(place: Port, v: Array) -> Iterator[tuple[ForceLaw, list[Array]]]:
    first = place.kind == "first_order"
    letter = "x" if first else "v"
    axis, large, spread = {"axis": letter}, f"at large |{letter}|", float(v.std())
    yield ForceLaw("linear velocity", "everywhere", linear=True), [v]
    if v.min() < -0.05 * spread and v.max() > 0.05 * spread:
        width, turn = 0.005 * spread, {"low": 0.0, "high": 0.0, **axis}
        step, near = np.tanh(v / width), f"near {letter} = 0"
        yield ForceLaw("dry", near, code=0, size=width, values=turn), [step]
        sides = [np.maximum(step, 0.0), np.minimum(step, 0.0)]
        yield ForceLaw("dry by direction", near, 2, 2, values=turn), sides
    yield ForceLaw("odd velocity", large, code=3, values=axis), [v * np.abs(v)]
    yield ForceLaw("odd velocity", large, code=4, size=spread, values=axis), [v**3 / spread**2]
    if first:
        yield ForceLaw("root", f"as the root of {letter}", values=axis), [np.sign(v) * np.sqrt(np.abs(v))]
        for g in map(float, np.quantile(v, _LEVELS)):
            where = f"{letter} > {_sized(g, place.velocity_unit)}"
            yield ForceLaw("beyond", where, 2, values={"low": g, **axis}), [np.maximum(v - g, 0.0)]
    elif v.min() < 0 < v.max():
        yield ForceLaw("one side of velocity", f"one sign of {letter}", code=9, values=axis), [np.abs(v)]


def _over_displacement(place: Port, d: Array) -> Iterator[tuple[ForceLaw, list[Array]]]:
    axis, spread = {"axis": "d"}, float(d.std())
    yield ForceLaw("linear displacement", "everywhere", linear=True), [d]
    odd = ForceLaw("odd displacement", "at large |d|", code=2, size=spread, values=axis)
    yield odd, [d**3 / spread**2]
    even = ForceLaw("even displacement", "larger for one sign of d", code=6, size=spread, values=axis)
    yield even, [d * d / spread]
    for g in map(float, np.quantile(np.abs(d), _QUANTILES)):
        text, edge = _sized(g, place.position_unit), {"low": g, **axis}
        both = ForceLaw("beyond", f"|d| > {text}", 2, code=1, size=g, values=edge)
        yield both, [np.sign(d) * np.maximum(np.abs(d) - g, 0.0)]
        above = ForceLaw("beyond, one side", f"d > {text}", 2, code=7, size=g, values={**edge, "side": 1})
        yield above, [np.maximum(d - g, 0.0)]
        below = ForceLaw("beyond, one side", f"d < -{text}", 2, code=8, size=g, values={**edge, "side": -1})
        yield below, [np.minimum(d + g, 0.0)]
    yield ForceLaw("one side", "d > 0 and d < 0 differ", code=5, values={"low": 0.0, **axis}), [np.abs(d)]


def _sized(number: float, unit: str) -> str:
    return f"{number:.3g} {unit}".rstrip()


_STEPS = 6
_WORTH = 30.0  # twice the log-likelihood from which on a law is tried in the loop
_FINE = 8
_SEEN = 0.1  # of a response, beside offset and initial state, from which on it can be told from them
_UNLIKE = 0.2  # of the larger of two steps, from which on they count as different


def _columns(scene: ModelOnRecord) -> list[tuple[int, Port, list[ForceLaw], list[Array]]]:
    """Return the force laws at each place, along the motion there.

    The motion is the one that the record shows if a force acts at that place.
    """
    if scene.laws is None:
        assert scene.places is not None
        scene.laws = []
        w = scene.data.inputs
        seen: list[Array] = []
        for i, p in enumerate(scene.places.places):
            rows = np.concatenate([p.act, p.position, p.velocity, p.position_input, p.velocity_input])
            if any(np.array_equal(rows, other) for other in seen):
                continue  # the same place by another name
            seen.append(rows)
            x = estimated_motion(scene, [i]).states
            d, v = p.position @ x + p.position_input @ w, p.velocity @ x + p.velocity_input @ w
            found = laws_at(p, *_between(scene, d, v))
            if found:
                columns = scene.forced([(i, force) for _, forces in found for force in forces])
                scene.laws.append((i, p, [law for law, _ in found], columns))
    return scene.laws


def forces_at_places(scene: ModelOnRecord) -> list[Finding]:
    """Laws at each place, and all of them together per place."""
    assert scene.places is not None
    found: list[Finding] = []
    count = len(scene.places.places)
    leaders: list[tuple[float, int, Port, ForceLaw, Explanation, int]] = []
    for index, place, laws, columns in _columns(scene):
        cuts = np.cumsum([law.n_forces for law in laws])[:-1]
        groups = [columns[a:b] for a, b in zip([0, *cuts], [*cuts, len(columns)], strict=True)]
        curved = [k for k, law in enumerate(laws) if not law.linear]
        curved = [k for k in curved if laws[k].name != "dry by direction" or _apart(scene, *groups[k])]
        judged = scene.evidence.best_of([groups[k] for k in curved])
        found += [_finding(place, laws[curved[k]], one, len(laws) * count) for k, one in judged]
        if judged:
            k, one = max(judged, key=lambda pair: pair[1].gain)
            leaders.append((one.gain, index, place, laws[curved[k]], one, len(laws) * count))
        straight = [c for k, law in enumerate(laws) if law.linear for c in groups[k]]
        together = straight + [
            c
            for k, law in enumerate(laws)
            if law.name in ("dry", "odd velocity", "odd displacement")
            for c in groups[k]
        ]
        whole = scene.evidence.linear(together)
        followed = "motion" if place.kind == "mechanical" else "state"
        found.append(
            Finding(
                "place",
                f"force at {place.name}",
                "hidden force",
                whole,
                len(together),
                count,
                f"A {place.acts_by} at {place.name} that depends on the {followed} there would explain "
                f"{100 * scene.evidence.share_of_error(scene.evidence.whole(whole)):.3g} % of the error.",
                {"place": place.name, "kind": "force"},
            )
        )
        linear = scene.evidence.linear(straight)
        law_text = "stiffness and damping at" if place.kind == "mechanical" else "coefficient of"
        found.append(
            Finding(
                "place",
                f"{law_text} {place.name}",
                "linear force",
                linear,
                len(straight),
                count,
                f"A change of the linear coefficients at {place.name} alone would explain "
                f"{100 * scene.evidence.share_of_error(scene.evidence.whole(linear)):.3g} % of the error.",
                {"place": place.name, "kind": "linear force"},
            )
        )
    for gain, index, place, law, one, tried in sorted(leaders, key=lambda row: -row[0])[:2]:
        if gain > _WORTH:
            found.append(_finding(place, *_settled(scene, index, law, one), tried))
    return found


def _apart(scene: ModelOnRecord, forward: Array, backward: Array) -> bool:
    """Return whether force steps that differ by direction can be identified.

    They must show as more than a constant offset.
    """
    both = forward - backward
    left = scene.evidence.without_nuisance(both)
    if np.linalg.norm(left) < _SEEN * np.linalg.norm(both):
        return False
    steps = scene.evidence.linear([forward, backward]).values
    return bool(min(steps * np.sign(steps.sum())) > 0 and np.ptp(steps) > _UNLIKE * np.abs(steps).max())


def _settled(
    scene: ModelOnRecord, index: int, law: ForceLaw, one: Explanation
) -> tuple[ForceLaw, Explanation]:
    """The law in the loop: its force follows the motion that it causes itself."""
    if law.code < 0 or scene.places is None:
        return law, one
    places, w = scene.places, scene.data.inputs
    place = places.places[index]
    d = place.position @ scene.states + place.position_input @ w
    v = place.velocity @ scene.states + place.velocity_input @ w
    steps = _STEPS if d.size < 30_000 else 2
    fine_d, fine_v = _between(scene, d, v, steps)
    Phi, G, _ = discretize(places.A, place.act[:, None], scene.dt / steps, "zoh")
    searched = law.code in (1, 7, 8)

    def shape(point: Array) -> Array:
        out = np.zeros((scene.n_samples, scene.n_outputs))
        loop(
            np.ascontiguousarray(Phi),
            G[:, 0].copy(),
            np.ascontiguousarray(places.C),
            place.output.copy(),
            place.position.copy(),
            place.velocity.copy(),
            fine_d,
            fine_v,
            steps,
            scene.reset,
            law.code,
            float(one.values[0] * (1.0 + point[0])),
            float(law.size * np.exp(point[1])) if searched else float(law.size),
            out,
        )
        return np.asarray(out.T / scene.scale)

    with np.errstate(over="ignore", invalid="ignore"):
        first = shape(np.zeros(1 + searched))
        if not np.isfinite(first).all() or np.abs(first).max() > 1e3:
            return law, one
        found = scene.evidence.descended(shape, np.zeros(1 + searched))
    if not np.isfinite(found.gain) or found.gain <= one.gain:
        return law, one
    if searched:
        g = float(law.size * np.exp(found.values[1]))
        where = law.where.replace(f"{law.size:.3g}", f"{g:.3g}")
        law = replace(law, where=where, values={**law.values, "low": g})
    return law, found


@compiled
def loop(  # type: ignore[no-untyped-def]
    Phi,  # (n, n)  of a substep
    G,  # (n,)
    C,  # (n_y, n)
    through,  # (n_y,)
    row_d,  # (n,)
    row_v,  # (n,)
    d0,  # (N steps,)  motion without the force
    v0,  # (N steps,)
    steps,
    reset,
    code,
    factor,
    size,
    out,  # (N, n_y)
):
    x = np.zeros(Phi.shape[0])
    for k in range(out.shape[0]):
        if reset[k]:
            x = np.zeros(Phi.shape[0])
        for j in range(steps):
            d = d0[k * steps + j] + row_d @ x
            v = v0[k * steps + j] + row_v @ x
            if code == 0:
                f = np.tanh(v / size)
            elif code == 1:
                f = np.sign(d) * max(abs(d) - size, 0.0)
            elif code == 2:
                f = d**3 / size**2
            elif code == 3:
                f = v * abs(v)
            elif code == 4:
                f = v**3 / size**2
            elif code == 5:
                f = abs(d)
            elif code == 6:
                f = d * d / size
            elif code == 7:
                f = max(d - size, 0.0)
            elif code == 8:
                f = min(d + size, 0.0)
            else:
                f = abs(v)
            if j == 0:
                put(out[k], 0, C @ x + through * (factor * f))
            x = Phi @ x + G * (factor * f)


def _between(scene: ModelOnRecord, d: Array, v: Array, factor: int = 0) -> tuple[Array, Array]:
    """Interpolate the motion to several values per sample.

    A force that jumps does so between samples.
    """
    n, factor = d.size, factor or (_FINE if d.size < 30_000 else 2)
    grid = np.arange(n, dtype=float)
    fine = np.arange(n * factor) / factor
    edges = [*scene.starts, n]
    found = []
    for signal in (d, v):
        parts = []
        for a, b in pairwise(edges):
            at = np.clip(fine[a * factor : b * factor], a, b - 1)
            if b - a < 4 or not np.ptp(signal[a:b]):
                parts.append(np.interp(at, grid[a:b], signal[a:b]))
            else:
                parts.append(CubicSpline(grid[a:b], signal[a:b])(at))
        found.append(np.concatenate(parts))
    return found[0], found[1]


def _finding(place: Port, law: ForceLaw, one: Explanation, tried: int) -> Finding:
    return Finding(
        "state",
        f"{place.name}, {law.where}",
        "residual force",
        one,
        law.dof,
        tried,
        f"The {place.acts_by} that is missing at {place.name} {law.meaning} ({law.where}).",
        {"place": place.name, "law": law.name, "kind": "state", **law.values},
    )
