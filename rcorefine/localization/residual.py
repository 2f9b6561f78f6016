"""Residual tests of an estimate of changes.

The tests of `diagnose` decide whether the changes explain the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from ..diagnosis.residual_tests import TestedResidual, run_tests
from ..effects.effect import Effect
from ..engine.structure import Structure
from ..inference.f_tests import FTest
from ..inference.fitted import FittedModel
from ..inference.sensitivities import candidate_columns
from ..inference.starts import Motion
from ..models.library import effect_library
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array
from .damping import RatioStructure
from .estimate import Joint

__all__ = ["overall", "residual_tests"]

_SHORTEST = 200  # samples of a record that can be tested


@dataclass(frozen=True, slots=True)
class _Held:
    """Attributes of a refinement that `FittedModel` needs."""

    physical_model: PhysicalModel
    effects: tuple[Effect, ...]
    constants: dict[int, float]
    roles: tuple[str, ...]
    substeps: int


def residual_tests(joint: Joint) -> tuple[FTest, ...]:
    """Test the residual at the estimate.

    All candidates and nuisance parameters are projected out.

    Parameters
    ----------
    joint : Joint
        Estimate at its end.

    Returns
    -------
    tuple of FTest
        As `Diagnosis.tests`; empty where a record is too short to test.
    """
    if min(record.n_samples for record in joint.records) < _SHORTEST:
        return ()
    physical, effects, theta = _plain(joint.structure, joint.theta)
    structure = Structure(physical, effects, constants=joint.structure.constants)
    old, role = joint.problem, ("effect",) * len(effects)
    mean, sd = old.prior_mean[: theta.size], old.prior_sd[: theta.size]
    problem = old.like(structure, prior_mean=mean, prior_sd=sd, hold_brief=True)
    held = _Held(physical, effects, dict(structure.constants), role, old.substeps)
    starts = joint.problem.unpack(joint.point)[1]
    fitted = FittedModel(cast(Any, held), problem, problem.pack(theta, starts), 0.0)
    motions = [Motion(structure, theta, record) for record in joint.records]
    motions[0].companions = motions[1:]
    taken = {(effect.kind, effect.place) for effect in effects}
    library = [e for e in effect_library(physical) if (e.kind, e.place) not in taken]
    return tuple(
        run_tests(TestedResidual(fitted), candidate_columns(fitted, library, motions[0], (0.0,)), motions)
    )


def _plain(structure: Structure, theta: Array) -> tuple[PhysicalModel, tuple[Effect, ...], Array]:
    """Return the model, effects and coefficients without the damping rule.

    The state matrix holds the damping that the rule gave.
    """
    if not isinstance(structure, RatioStructure):
        return structure.model, tuple(structure.effects), theta
    changes = [structure.effects[q.effect].spec.is_element for q in structure.parameters]
    masses = [structure.effects[q.effect].spec.inertial for q in structure.parameters]
    changes = [change and not mass for change, mass in zip(changes, masses, strict=True)]
    model = structure.model
    A = structure.matrices(np.where(masses, 0.0, theta)).A.real
    C, D = model.output_state + model.output_rate @ A, model.linear.D
    ruled = replace(model, linear=model.linear.with_arrays(A=A, B=model.linear.B, C=C, D=D))
    count = structure.ratio_columns[0]
    return ruled, tuple(structure.effects[:-1]), np.where(changes, 0.0, theta)[:count]


def overall(tests: Sequence[FTest]) -> float:
    """Smallest p-value, corrected for the number of tests."""
    valid = [test.p_value for test in tests if test.dof]
    return min(1.0, min(valid, default=1.0) * len(valid))
