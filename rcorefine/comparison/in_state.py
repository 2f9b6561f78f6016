"""Failures in the state space: forces at a place that follow its displacement or velocity."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..systems.linear import Array
from .evidence import Explanation
from .motion import estimated_states
from .places import Place
from .scene import Finding, Scene

__all__ = ["forces_at_places", "port_motion"]

_QUANTILES = (0.3, 0.5, 0.65, 0.8, 0.9)


def port_motion(scene: Scene) -> list[tuple[Array, Array]]:
    """Displacement and velocity (N,) at each place, as the record shows them if a force acts there."""
    assert scene.places is not None
    w, motions = scene.data.inputs, []
    for i, p in enumerate(scene.places.places):
        x = estimated_states(scene, [i])
        motions.append((p.position @ x + p.position_input @ w, p.velocity @ x + p.velocity_input @ w))
    return motions


def forces_at_places(scene: Scene, motions: Sequence[tuple[Array, Array]]) -> list[Finding]:
    """Laws at each place, and all of them together per place."""
    assert scene.places is not None
    found: list[Finding] = []
    for index, (place, (d, v)) in enumerate(zip(scene.places.places, motions, strict=True)):
        laws = _laws(place, d, v)
        if not laws:
            continue
        columns = scene.forced([(index, force) for law in laws for force in law["forces"]])
        cuts = np.cumsum([len(law["forces"]) for law in laws])[:-1]
        groups = [columns[a:b] for a, b in zip([0, *cuts], [*cuts, len(columns)], strict=True)]
        curved = [k for k, law in enumerate(laws) if not law["linear"]]
        for k, one in scene.evidence.best_of([groups[k] for k in curved]):
            found.append(_finding(place, laws[curved[k]], one, len(laws) * len(motions)))
        straight = [c for k, law in enumerate(laws) if law["linear"] for c in groups[k]]
        together = straight + [
            c
            for k, law in enumerate(laws)
            if law["name"] in ("dry", "odd velocity", "odd displacement")
            for c in groups[k]
        ]
        whole = scene.evidence.linear(together)
        found.append(
            Finding(
                "place", f"force at {place.name}", "hidden force", whole, len(together), len(motions),
                f"A force at {place.name} that follows the motion there would explain "
                f"{100 * scene.evidence.share(whole.fit):.3g} % of the error.",
                {"place": place.name, "kind": "force"},
            )  # fmt: skip
        )
        linear = scene.evidence.linear(straight)
        law_text = "stiffness and damping at" if place.kind == "mechanical" else "coefficient of"
        found.append(
            Finding(
                "place", f"{law_text} {place.name}", "linear force", linear, len(straight), len(motions),
                f"A change of the linear law at {place.name} alone would explain "
                f"{100 * scene.evidence.share(linear.fit):.3g} % of the error.",
                {"place": place.name, "kind": "linear force"},
            )  # fmt: skip
        )
    return found


def _laws(place: Place, d: Array, v: Array) -> list[dict[str, Any]]:
    """Forces over displacement and velocity, with the region in which each departs from zero."""
    laws: list[dict[str, Any]] = []

    def law(name: str, where: str, forces: list[Array], dof: int, linear: bool = False, **values: Any) -> None:
        if all(np.all(np.isfinite(f)) and np.ptp(f) > 0 for f in forces):
            laws.append(
                {"name": name, "where": where, "forces": forces, "dof": dof, "linear": linear, "values": values}
            )

    first = place.kind == "first_order"
    letter, unit = ("x", place.velocity_unit) if first else ("v", place.velocity_unit)
    if np.ptp(v) > 0:
        spread = float(v.std())
        law("linear velocity", "everywhere", [v], 1, linear=True)
        width = 0.02 * spread
        if v.min() < -0.05 * spread and v.max() > 0.05 * spread:
            law("dry", f"near {letter} = 0", [np.tanh(v / width)], 1, low=0.0, high=0.0, axis=letter)
            law(
                "dry by direction", f"near {letter} = 0",
                [np.maximum(np.tanh(v / width), 0.0), np.minimum(np.tanh(v / width), 0.0)], 2,
                low=0.0, high=0.0, axis=letter,
            )  # fmt: skip
        law("odd velocity", f"at large |{letter}|", [v * np.abs(v)], 1, axis=letter)
        law("odd velocity", f"at large |{letter}|", [v**3 / spread**2], 1, axis=letter)
        if not first and v.min() < 0 < v.max():
            law("one side of velocity", f"one sign of {letter}", [np.abs(v)], 1, axis=letter)
        if first:
            law("root", f"as the root of {letter}", [np.sign(v) * np.sqrt(np.abs(v))], 1, axis=letter)
            for q in (0.5, 0.7, 0.85, 0.95):
                g = float(np.quantile(v, q))
                law("beyond", f"{letter} > {g:.3g}{_spaced(unit)}", [np.maximum(v - g, 0.0)], 2, low=g, axis=letter)
    if np.ptp(d) > 0:
        unit = place.position_unit
        middle, spread = 0.0, float(d.std())
        law("linear displacement", "everywhere", [d], 1, linear=True)
        law("odd displacement", "at large |d|", [d**3 / max(spread**2, 1e-300)], 1, axis="d")
        law("even displacement", "d of one sign more", [d * d / max(spread, 1e-300)], 1, axis="d")
        for q in _QUANTILES:
            g = float(np.quantile(np.abs(d - middle), q))
            text = f"{g:.3g}{_spaced(unit)}"
            law(
                "beyond", f"|d| > {text}", [np.sign(d) * np.maximum(np.abs(d) - g, 0.0)], 2, low=g, axis="d",
            )  # fmt: skip
            law("beyond, one side", f"d > {text}", [np.maximum(d - g, 0.0)], 2, low=g, axis="d", side=1)
            law("beyond, one side", f"d < -{text}", [np.minimum(d + g, 0.0)], 2, low=g, axis="d", side=-1)
        law("one side", "d > 0 apart from d < 0", [np.abs(d)], 1, low=0.0, axis="d")
    return laws


def _spaced(unit: str) -> str:
    return f" {unit}" if unit else ""


_MEANINGS = {
    "dry": "jumps where the motion turns, as dry friction does",
    "dry by direction": "jumps where the motion turns, by different steps, as worn guides do",
    "odd velocity": "grows more than in proportion to speed, as drag does",
    "one side of velocity": "differs with the direction of motion",
    "root": "follows the square root, as an outflow does",
    "beyond": "sets in beyond that, as a stop or a hardening spring does",
    "beyond, one side": "sets in beyond that on one side only, as a stop does",
    "odd displacement": "grows more than in proportion to displacement, as a hardening spring does",
    "even displacement": "grows to one side, as an asymmetric spring does",
    "one side": "differs between the two sides, as a crack or a loose contact does",
}


def _finding(place: Place, law: dict[str, Any], one: Explanation, tried: int) -> Finding:
    return Finding(
        "state",
        f"{place.name}, {law['where']}",
        "residual force",
        one,
        law["dof"],
        tried,
        f"The force that the model lacks at {place.name} {_MEANINGS[law['name']]} ({law['where']}).",
        {"place": place.name, "law": law["name"], "kind": "state", **law["values"]},
    )
