"""Choice of the estimator behind a refiner, from the given arguments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_flag, as_list, as_whole
from ..effects.effect import Effect
from ..exceptions import ModelError
from ..models.operating_point import check_stream_hold
from ..models.physical_model import PhysicalModel
from .checks import as_size
from .coefficients.effects import make_effects_setup
from .coefficients.estimator import CoefficientFilter
from .coefficients.forms import FORMS, all_entries, correction, named_entries, no_entries, nonzero_entries
from .coefficients.setup import FilterSettings, Setup, checked_settings
from .estimator import Estimator
from .filter_bank import FilterBank
from .joint import JointStages
from .rcmr.memory import Settings
from .rcmr.paper import PaperStages
from .rcmr.setup import Sampled, as_settings, correction_path, make_setup

__all__ = ["assembled"]

_STATIC = ("static_order", "static_window", "static_markov", "static_learning_rate", "static_average")
_PAPERS = ("window", "markov", *_STATIC)
_FILTERS = {"noise": None, "hold": "zoh", "disturbance": None, "forgetting": 1.0, "substeps": None}
_DEFAULTS = {"window": 800, "markov": 20, "learning_rate": 1e5, "static_order": 0}
_BESIDE = {**_DEFAULTS, "window": 100}  # stage 1 where it only runs beside: a short window costs less
_INERT = Settings(order=0, window=1, markov=1, learning_rate=1e25)  # the static stage is the filter's
_MOST = 150  # coefficients of a form that takes part in a race unasked


def assembled(given: dict[str, Any], sampled: Sampled) -> Estimator:
    """Estimator for these settings of `RCORefiner`.

    Parameters
    ----------
    given : dict
        Arguments of the refiner by name, None where they were left out.
    sampled : Sampled
        Initial model.
    """
    static = given["static"]
    keep = as_flag(given["history"], "history")
    as_flag(given["use_estimated_states"], "use_estimated_states")
    papers = [name for name in _PAPERS if given[name] is not None]
    listed = _named(static, given["effects"])
    if given["substeps"] is not None:
        as_whole(given["substeps"], "substeps", least=1, error=ModelError)
    n_outputs = sampled.initial.n_outputs
    checked_settings(n_outputs, 1.0, *(given[n] for n in ("hold", "noise", "disturbance", "forgetting")))
    if listed is None and static == "auto" and papers:
        unused = [
            name
            for name, default in _FILTERS.items()
            if (given[name] is not None if default is None else given[name] != default)
        ]
        if unused:
            raise ct.ControlArgument(
                f"{unused[0]} is a setting of the joint filter, {papers[0]} one of the paper's equations; "
                "name effects=[...] or static=..., or leave one of the two out"
            )
        return _paper(given, sampled, keep)
    wrong = [name for name in _STATIC if given[name] is not None]
    if wrong:
        raise ct.ControlArgument(
            f"{wrong[0]} is a setting of the paper's static stage; leave it out, or static= and effects="
        )
    chosen: CoefficientFilter | FilterBank
    if listed is not None:
        chosen = CoefficientFilter(_listed(given, sampled, listed), keep)
    else:
        if given["substeps"] is not None:
            raise ct.ControlArgument("substeps is a setting of nonlinear effects; give effects=[...]")
        settings = _filter_settings(given, sampled)
        chosen = FilterBank(
            _forms(static, given, sampled, settings), no_entries(sampled.initial, settings), keep
        )
    first, silent = _stage_one(given, sampled, keep)
    return JointStages(chosen, first, sampled.initial, keep, silent)


def _named(static: Any, effects: Any) -> list[Any] | None:
    """Entries or effects that the user names, None where it is a form."""
    if effects is not None and not (isinstance(static, str) and static == "auto"):
        raise ct.ControlArgument("effects= and static= name the same thing; give one of them")
    listed = effects if effects is not None else (None if isinstance(static, str) else static)
    if isinstance(listed, Effect):
        return [listed]
    if listed is not None:
        return as_list(listed, "static" if effects is None else "effects", "entries or effects")
    if static not in ("auto", *FORMS):
        raise ct.ControlArgument(
            f"static must be 'auto', {', '.join(map(repr, FORMS))}, or a list of entries such as "
            f"'A[1,0]' or of effects, not {static!r}"
        )
    return None


def _paper(given: dict[str, Any], sampled: Sampled, keep: bool) -> PaperStages:
    numbers = {name: _DEFAULTS.get(name) if given[name] is None else given[name] for name in _NUMBERS}
    settings = as_settings(**numbers)
    average = given["static_average"]
    if average is None:
        average = 2 * settings[1].window if given["window"] or given["static_window"] else _AVERAGE
    average = as_size(average, "static_average", 1, "samples to average over")
    setup = make_setup(
        sampled, settings, given["correction_input"], given["correction_feedthrough"],
        given["use_estimated_states"], average, given["scale"],
    )  # fmt: skip
    return PaperStages(setup, keep)


def _stage_one(given: dict[str, Any], sampled: Sampled, keep: bool) -> tuple[PaperStages | None, str]:
    """Stage 1 beside the filter, or why there is none."""
    if not given["use_estimated_states"]:
        return None, ""
    numbers = {name: _BESIDE.get(name) if given[name] is None else given[name] for name in _NUMBERS}
    settings = as_settings(**numbers)[0], _INERT
    path = given["correction_input"], given["correction_feedthrough"]
    model = sampled.discrete
    shown, power = np.abs(model.D).max(axis=0, initial=0.0), model.B
    for _ in range(model.n_states):
        shown = np.maximum(shown, np.abs(model.C @ power).max(axis=0, initial=0.0))
        power = model.A @ power
    if all(part is None for part in path) and not (shown > 0).all():
        return None, "Stage 1 does not run: an input affects no output, so it cannot correct any."
    return PaperStages(make_setup(sampled, settings, *path, True, 1, given["scale"]), keep), ""


def _filter_settings(given: dict[str, Any], sampled: Sampled) -> FilterSettings:
    step = 1.0 if sampled.step is None else sampled.step
    physical = getattr(given["model"], "physical_model", given["model"])
    if isinstance(physical, PhysicalModel):
        check_stream_hold(physical, given["hold"])
    return checked_settings(
        sampled.initial.n_outputs,
        step,
        given["hold"],
        given["noise"],
        given["disturbance"],
        given["forgetting"],
    )


def _listed(given: dict[str, Any], sampled: Sampled, items: Sequence[Any]) -> Setup:
    """Coefficients that the user names: entries or effects."""
    if items and all(isinstance(item, str) for item in items) and given["effects"] is None:
        if given["substeps"] is not None:
            raise ct.ControlArgument("substeps is a setting of nonlinear effects; entries have none")
        return named_entries(sampled.initial, items, _filter_settings(given, sampled))
    assert sampled.step is not None or not sampled.initial.is_continuous
    return make_effects_setup(
        given["model"], items, 1.0 if sampled.step is None else sampled.step,
        **{name: given[name] for name in _FILTERS},
    )  # fmt: skip


def _forms(
    static: str, given: dict[str, Any], sampled: Sampled, settings: FilterSettings
) -> dict[str, Setup]:
    """Return the correction forms that take part, the most physical first."""
    model, every = sampled.initial, static == "auto"
    found: dict[str, Setup] = {}
    if static in ("auto", "nonzero"):
        found["nonzero"] = nonzero_entries(model, settings)
    path = correction_path(model, given["correction_input"], given["correction_feedthrough"])
    if static in ("auto", "input"):
        found["input"] = correction(model, *path, settings)
    if static in ("auto", "discrete"):
        if settings.hold == "zoh" or not model.is_continuous:
            found["discrete"] = all_entries(model, sampled.discrete, settings)
        elif not every:
            raise ModelError("static='discrete' needs a held input; leave hold out, or take static='nonzero'")
    if every:
        found = {name: one for name, one in found.items() if len(one.labels) <= _MOST}
    return {name: one for name, one in found.items() if one.labels}


_NUMBERS = (
    "order", "window", "markov", "learning_rate", "static_order", "static_window", "static_markov",
    "static_learning_rate",
)  # fmt: skip
_AVERAGE = 800  # samples that static coefficients are averaged over where no window is given
