"""Failures in the state space: forces over displacement or velocity.

These forces act at a place, and follow its motion.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline

from ...jit import compiled, put
from ...models.ports import Port
from ...systems.discretization import discretize
from ...systems.linear import Array
from .force_laws import ForceLaw, laws_at
from .likelihood import Explanation
from .motion import estimated_motion
from .record import Finding, ModelOnRecord

__all__ = ["forces_at_places"]

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
