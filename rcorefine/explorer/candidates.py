"""Candidate effects for a place where a model fails.

The force law of each is fitted to the force that is missing there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..comparison.failure_map.residual_force import ResidualForce
from ..effects.along_motion import unit_forces
from ..effects.effect import Effect
from ..engine.structure import Structure
from ..inference.starts import Motion, shape_starts
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array

__all__ = ["Candidate", "laid_over"]

_EDGE = 50  # part of a record at each end where a force is only half known


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """An effect that could be added.

    Attributes
    ----------
    effect : Effect
        Kind and place.
    coefficients : dict
        Where to begin: from the force, where the law lies over one, else where it is absent or small.
    share : float
        Part of the lacking force that it explains, 0 to 1; NaN where it is no force along the motion.
    curve : ndarray, shape (N,), or None
        Its force along the motion.
    """

    effect: Effect
    coefficients: dict[str, float]
    share: float = np.nan
    curve: Array | None = None


def laid_over(
    effect: Effect, physical: PhysicalModel, motion: Motion, inputs: Array, force: ResidualForce | None
) -> Candidate:
    """Fit the shape and the coefficients of an effect to a force.

    Parameters
    ----------
    effect : Effect
        Law at a place.
    physical : PhysicalModel
        Model.
    motion : Motion
        Estimated motion, which proposes shapes.
    inputs : ndarray, shape (n_w, N)
        Of the record.
    force : ResidualForce or None
        What is to be explained.

    Returns
    -------
    Candidate
    """
    structure = Structure(physical, [effect])
    starts = [
        {q.name: float(value) for q, value in zip(structure.parameters, theta, strict=True)}
        for theta in shape_starts(structure, structure.start(), motion)
    ]
    best = Candidate(effect, _ordered(effect, dict(starts[0])))
    if force is None or force.place != effect.place:
        return best
    levels = [q for q in structure.parameters if q.name not in effect.spec.shaping]
    edge = force.force.size // _EDGE
    inner = slice(edge, force.force.size - edge)
    wanted = force.force[inner] - force.force[inner].mean()
    for start in starts:
        shape = {name: value for name, value in start.items() if name in effect.spec.shaping}
        columns = unit_forces(effect, force.position, force.velocity, [shape], inputs)
        if columns is None or len(columns) != len(levels) or not np.isfinite(columns).all():
            continue
        F = np.array(columns).T
        about = F[inner] - F[inner].mean(axis=0)
        values = np.linalg.lstsq(about, wanted, rcond=1e-10)[0]
        values = np.clip(values, [q.lower for q in levels], [q.upper for q in levels])
        named = _ordered(effect, start | {q.name: float(v) for q, v in zip(levels, values, strict=True)})
        values = np.array([named[q.name] for q in levels])
        left = float(np.sum((wanted - about @ values) ** 2))
        share = 1.0 - left / max(float(np.sum(wanted**2)), 1e-300)
        if not share <= best.share:  # NaN is the first
            best = Candidate(effect, named, share, F @ values)
    return best


def _ordered(effect: Effect, values: dict[str, float]) -> dict[str, float]:
    """Coefficients of which one is never below another, kept so."""
    for larger, smaller in effect.spec.order:
        values[larger] = max(values[larger], values[smaller])
    return values
