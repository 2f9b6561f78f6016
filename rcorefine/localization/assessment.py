"""Damage map computed from a decision.

It adds confidence intervals, detection limits, and whether the changes explain the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

from ..diagnosis.words import failed_test
from ..engine.structure import Structure
from ..inference.covariance import standard_deviations
from ..inference.f_tests import FTest
from ..inference.outcome import _initial_fit
from ..systems.linear import LinearModel
from .candidates import Candidate
from .damage_map import DamageMap, DamageRow, NuisanceRow
from .damping import RATIO_NAMES
from .decision import Decision
from .estimate import Joint
from .residual import overall

__all__ = ["assessed"]

_OTHER_VALLEY = (
    "Another set of changes, at more places, would explain the record about as well, because there are few "
    "sensors. The result is the set with fewer places."
)
_UNEXPLAINED = (
    "The changes do not explain the record: {test}. An effect is missing in the model, and a reported "
    "change may be caused by it. Run diagnose() to find the effect."
)
_UNTESTED = "The record is too short to test whether the changes explain it."


def assessed(
    joint: Joint,
    candidates: Sequence[Candidate],
    decision: Decision,
    tests: tuple[FTest, ...],
    rule: str,
    significance: float,
    power: float,
    ranking: Any,
    note: str,
) -> DamageMap:
    """The map of a decision."""
    residual = joint.residual
    measured = np.concatenate([r.outputs for r in joint.records], axis=1)
    size = np.linalg.norm(measured - measured.mean(axis=1, keepdims=True), axis=1)
    return DamageMap(
        name=joint.structure.linear_model.name,
        rows=_rows(candidates, decision, significance, power),
        groups=tuple(tuple(candidates[i].label for i in group) for group in decision.groups),
        ranking=ranking,
        nuisances=_nuisances(joint, candidates),
        covariance=decision.joint_covariance,
        linear=_damaged_model(joint),
        damping=rule,
        significance=significance,
        power=power,
        fit=100.0 * (1.0 - np.linalg.norm(residual, axis=1) / np.where(size > 0, size, np.nan)),
        rmse=np.sqrt(np.mean(residual**2, axis=1)),
        initial_fit=_initial_fit(Structure(joint.structure.model), joint.records),
        residual_orders=joint.orders,
        tests=tests,
        n_samples=measured.shape[1],
        duration=sum(r.n_samples * r.dt for r in joint.records),
        success=joint.converged,
        message=_message(joint, decision, tests, significance, note),
    )


def _rows(
    candidates: Sequence[Candidate], decision: Decision, significance: float, power: float
) -> tuple[DamageRow, ...]:
    """Changes with their intervals, and what the record would have shown."""
    left = max(len(candidates) - len(decision.named), 1)
    reach = norm.isf(significance / (2 * left)) + norm.ppf(power)
    rows = []
    for i, c in enumerate(candidates):
        share = 100.0 / c.nominal if c.nominal else np.nan
        limit = float(max(reach * np.hypot(decision.std[i], c.tolerated), c.floor))
        rows.append(
            DamageRow(
                c.name,
                c.kind,
                c.place,
                c.nominal,
                c.unit,
                float(decision.change[i]),
                float(decision.std[i]),
                float(decision.joint[i]),
                float(decision.joint_std[i]),
                float(decision.change[i] * share),
                float(decision.std[i] * abs(share)),
                float(decision.p_value[i]),
                limit,
                float(limit * abs(share)),
                i in decision.named,
                tuple(candidates[j].label for j in decision.rivals.get(i, ())),
            )
        )
    return tuple(rows)


def _damaged_model(joint: Joint) -> LinearModel:
    """The model with the changes that are named."""
    structure = joint.structure
    matrices = structure.matrices(joint.theta.astype(float))
    nw = structure.n_inputs
    return structure.linear_model.with_arrays(
        A=matrices.A, B=matrices.B[:, :nw], C=matrices.C, D=matrices.D[:, :nw],
        state_labels=tuple(structure.state_labels()),
    )  # fmt: skip


def _message(
    joint: Joint, decision: Decision, tests: tuple[FTest, ...], significance: float, note: str
) -> str:
    parts = (
        "Converged." if joint.converged else "Not converged; the values may be inaccurate.",
        _explained(tests, significance),
        _OTHER_VALLEY if decision.other_valley else "",
        note,
    )
    return " ".join(part for part in parts if part)


def _explained(tests: Sequence[FTest], significance: float) -> str:
    """Return a message on failed or missing tests, or an empty string.

    The string is empty where the residual is noise.
    """
    if not tests:
        return _UNTESTED
    if overall(tests) >= significance:
        return ""
    worst = min((test for test in tests if test.dof), key=lambda test: test.p_value)
    return _UNEXPLAINED.format(test=failed_test(worst))


def _nuisances(joint: Joint, candidates: Sequence[Candidate]) -> tuple[NuisanceRow, ...]:
    structure = joint.structure
    taken = {c.column for c in candidates}
    named = np.array([c.column for c in candidates if joint.theta[c.column] != 0], dtype=np.int64)
    active = np.ones(structure.n_parameters, dtype=bool)
    active[[c.column for c in candidates]] = False
    active[named] = True
    columns = joint.columns(active)
    spread = standard_deviations(joint.information().covariance(columns))
    rows = []
    for i, parameter in enumerate(structure.parameters):
        if i in taken:
            continue
        std = float(spread[int(np.flatnonzero(columns == i)[0])])
        value = float(joint.theta[i])
        if parameter.label == RATIO_NAMES[0]:
            rows.append(NuisanceRow("damping relative to the model", 1.0 + value, std, ""))
        elif parameter.label == RATIO_NAMES[1]:
            rows.append(NuisanceRow("share of the damping proportional to stiffness", value, std, ""))
        else:
            rows.append(NuisanceRow(parameter.label, value, std, structure.unit(parameter)))
    return tuple(rows)
