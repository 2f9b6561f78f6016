"""Results as one machine-readable object, for ``--json``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..comparison.adequacy import failures_of
from ..comparison.failure_map.search import FailureMap
from ..comparison.result import Comparison
from ..data.measurement import Measurement
from ..diagnosis.checks.row import CheckRow
from ..diagnosis.result import Diagnosis
from ..diagnosis.stepwise.improvement import Improvement
from ..effects.effect import Effect
from ..inference.refinement import Refinement
from ..views.pages.origin import fingerprint

__all__ = ["comparison_object", "diagnosis_object", "improvement_object", "json_text", "record_object"]


def json_text(content: dict[str, Any]) -> str:
    """Strict JSON: what is not finite becomes null.

    Parameters
    ----------
    content : dict
        Numbers, arrays, text and sequences.

    Returns
    -------
    str

    Examples
    --------
    >>> json_text({"fit": np.array([1.0, np.nan])})
    '{"fit": [1.0, null]}'
    """
    return json.dumps(_plain(content), allow_nan=False, ensure_ascii=True)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value if value is None or isinstance(value, str) else str(value)


def record_object(data: Measurement) -> dict[str, Any]:
    """Name, size and fingerprint of a record."""
    return {
        "name": data.name,
        "samples": data.n_samples,
        "dt": data.dt,
        "hold": data.hold,
        "inputs": data.input_labels,
        "outputs": data.output_labels,
        "sha256_inputs": fingerprint(data.inputs),
        "sha256_outputs": fingerprint(data.outputs),
    }


def comparison_object(result: Comparison) -> dict[str, Any]:
    """``models``: name, ``outputs`` (name, unit, fit, rmse, bias), ``failures`` (rows)."""
    data = result.data
    models = []
    for index, name in enumerate(result.names):
        residual = data.outputs - result.runs[index]
        one = result.select(index)
        models.append(
            {
                "name": name,
                "outputs": [
                    {"name": label, "unit": unit, "fit": fit, "rmse": rmse, "bias": bias}
                    for label, unit, fit, rmse, bias in zip(
                        data.output_labels,
                        data.output_units,
                        one.fit,
                        one.rmse,
                        residual.mean(axis=1),
                        strict=True,
                    )
                ],
                "failures": _failures(failures_of(result, index)),
            }
        )
    return {"models": models}


def _failures(found: FailureMap) -> list[dict[str, Any]]:
    fields = ("role", "dimension", "where", "measure", "statistic", "p_value", "share", "sentence")
    return [{key: getattr(row, key) for key in fields} for row in found]


def _effect(effect: Effect | None) -> dict[str, Any] | None:
    return None if effect is None else {"kind": effect.kind, "place": effect.place}


def _tests(tests: Any) -> list[dict[str, Any]]:
    return [{"name": t.name, "statistic": t.statistic, "dof": t.dof, "p_value": t.p_value} for t in tests]


def diagnosis_object(found: Diagnosis) -> dict[str, Any]:
    """``verdict``, ``ranking``, ``ambiguous``, ``parameters``, tests and notes."""
    return {
        "verdict": found.verdict,
        "ranking": [
            {
                "effect": _effect(row.effect),
                "coefficients": row.coefficients,
                "std": row.std,
                "fit_before": row.fit_before,
                "fit_after": row.fit_after,
                "p_value": row.p_value,
                "probability": row.probability,
            }
            for row in found.ranking
        ],
        "none_of_these": found.none_of_these,
        "places": found.places,
        "ambiguous": [_effect(effect) for effect in found.ambiguous],
        "parameters": _parameters(found.parameters),
        "tests": _tests(found.tests),
        "winner_tests": _tests(found.winner_tests),
        "detectable": [
            {
                "effect": _effect(d.effect),
                "coefficient": d.coefficient,
                "smallest": d.smallest,
                "unit": d.unit,
            }
            for d in found.detectable
        ],
        "significance": found.significance,
        "notes": found.notes,
        "checks": _checks(found.checks),
    }


def improvement_object(ladder: Improvement) -> dict[str, Any]:
    """``verdict``, ``message``, ``steps``, and of the last model ``parameters`` and ``system``."""
    return {
        "verdict": ladder.verdict,
        "message": ladder.message,
        "steps": [
            {
                "action": step.action,
                "effect": _effect(step.effect),
                "coefficients": step.coefficients,
                "std": step.std,
                "train_rmse": step.train_rmse,
                "choice_rmse": step.choice_rmse,
                "validation_rmse": step.validation_rmse,
                "rivals": [_effect(effect) for effect in step.rivals],
            }
            for step in ladder.steps
        ],
        "checks": _checks(ladder.checks),
        **_model(ladder.refinement),
    }


def _checks(rows: Sequence[CheckRow]) -> list[dict[str, str]]:
    return [{name: getattr(row, name) for name in CheckRow.__slots__} for row in rows]


def _parameters(rows: Any) -> list[dict[str, Any]]:
    keys = ("name", "kind", "place", "role", "initial", "value", "coefficient", "std", "unit")
    return [{key: getattr(row, key) for key in keys} for row in rows]


def _model(refinement: Refinement) -> dict[str, Any]:
    system = refinement.system
    return {
        "parameters": _parameters(refinement.parameters),
        "hold": refinement.hold,
        "system": {
            **{key: np.asarray(getattr(system, key)) for key in "ABCD"},
            "inputs": system.input_labels,
            "outputs": system.output_labels,
            "states": system.state_labels,
        },
    }
