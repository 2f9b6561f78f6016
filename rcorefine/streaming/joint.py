"""Joint filter for state and coefficients as the static stage.

Stage 1 runs beside it. The settings of a refiner choose this estimator or the paper's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_flag, as_list, as_whole
from ..effects.effect import Effect
from ..exceptions import ModelError, RCOError
from ..inference.covariance import standard_deviations
from ..models.operating_point import check_stream_hold
from ..models.physical_model import PhysicalModel
from ..systems.conversion import nearest_continuous
from ..systems.linear import Array, LinearModel
from ..systems.response import frequency_response
from .coefficients.effects import make_effects_setup
from .coefficients.entries import FORMS, all_entries, correction, named_entries, no_entries, nonzero_entries
from .coefficients.setup import CoefficientFilter, CoefficientSetup, FilterSettings, checked_settings
from .filter_bank import FilterBank
from .history import CoefficientHistory, Summary, joined, pole_samples, poles_of
from .paper import PaperStages, correction_path
from .persistence import check_like
from .samples import Block, Sampled, whole_block
from .scales import Plant, Scales, markov_parameters

_PENDING = 32  # single samples that wait for one another (race, stage 1) until a result is asked for


class JointStages:
    """Coefficients by one filter or several, with the paper's stage 1.

    Several filters are compared on the same samples.

    Parameters
    ----------
    static : CoefficientFilter or FilterBank
        The static stage.
    first : PaperStages or None
        Stage 1, None where it does not run.
    model : LinearModel
        Initial model.
    keep : bool
        Whether to keep the course of every sample.
    silent : str
        Why stage 1 does not run, "" where that was asked for.
    """

    def __init__(
        self,
        static: CoefficientFilter | FilterBank,
        first: PaperStages | None,
        model: LinearModel,
        keep: bool,
        silent: str,
    ) -> None:
        self._static, self.first, self.model, self.keep, self._silent = static, first, model, keep, silent
        self._bank = isinstance(static, FilterBank)
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        # single samples that stage 1 has not seen; a bank has not learned them either
        self._waiting: list[Block] = []
        self._static.reset()
        if self.first is not None:
            self.first.reset()
        self.stopped = self._silent

    # -- samples in ----------------------------------------------------------------------------------

    @property
    def static(self) -> CoefficientFilter | FilterBank:
        """The static stage, all samples learned."""
        self._flush()
        return self._static

    @property
    def filter(self) -> CoefficientFilter:
        """Filter of the coefficients that the refined model has."""
        return self.static.filter

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return self._static.n_samples + self._bank * len(self._waiting)

    @property
    def n_learned(self) -> int:
        """Samples learned from: 0 while the first are held back."""
        return self.n_samples if self.filter.memory.rounds else 0

    def take(self, block: Block, *, keep_sound: bool = False) -> None:
        """Learn from a block: all of it or nothing."""
        beside, single = self._runs_stage_one, len(block.inputs) == 1
        if single and len(self._waiting) >= _PENDING:
            self._flush()
        # of single samples the many forms of a bank and stage 1 learn later, one filter learns at once; a gap
        # needs a prediction for stage 1
        if single and (self._bank or ((block.whole or not beside) and self._static.filter.one(block))):
            if self._bank or beside:
                self._waiting.append(block)
        else:
            self._flush()
            self._learn(block)

    @property
    def _runs_stage_one(self) -> bool:
        """Return whether stage 1 runs."""
        return self.first is not None and not self.stopped

    def _flush(self) -> None:
        """Learn from the single samples that wait."""
        if self._waiting:
            block = Block.joined(self._waiting)
            if self._bank:
                self._learn(block)
            else:
                self._run_stage_one(block, block.outputs)
            self._waiting = []

    def _learn(self, block: Block) -> None:
        beside = self._runs_stage_one
        # both stages or none: an error in one undoes the other
        with self._static.all_or_nothing():
            expected = self._static.take(block, predict=beside and not block.whole)
            if beside:
                self._run_stage_one(block, expected)

    def _run_stage_one(self, block: Block, predicted: Array) -> None:
        """Run stage 1 on the same samples.

        In a gap it receives the prediction of the static stage.
        """
        assert self.first is not None
        outputs = block.outputs
        # a missing output: the prediction of the filter, or zero before there is one
        if not block.whole:
            outputs = np.where(block.use > 0, outputs, np.where(np.isfinite(predicted), predicted, 0.0))
        try:
            self.first.take(whole_block(block.inputs, outputs), keep_sound=True)
        # stage 1 may stop; the static stage goes on without it
        except RCOError as error:
            self.stopped = f"Stage 1 stopped: {error}"

    def finish(self) -> None:
        """Learn from what is still held back, however short."""
        self.static.finish()

    # -- results -------------------------------------------------------------------------------------

    def system(self, name: str) -> LinearModel:
        """Refined model, continuous where the initial one is."""
        model = self.static.system(name)
        # d2c of a form that was estimated in discrete time
        if self.model.is_continuous and not model.is_continuous:
            return nearest_continuous(model)
        return model

    @property
    def scales(self) -> Scales | None:
        """Sizes that stage 1 divides signals by."""
        self._flush()
        return None if self.first is None else self.first.scales

    def dynamic_theta(self) -> Array:
        """Coefficients of stage 1."""
        self._flush()
        return np.zeros((0, 0)) if self.first is None else self.first.dynamic_theta()

    def static_theta(self) -> Array:
        """Static coefficients, shape (1, p)."""
        return self.filter.theta[None]

    def standard_deviations(self) -> Array:
        """Standard deviations of the static coefficients, shape (1, p)."""
        return self.filter.standard_deviations[None]

    def deviation(self) -> Callable[[Array], Array] | None:
        """Return the standard deviation of the refined frequency response.

        It is a function of frequency, or None if it is not known.
        """
        part = self.filter
        around = variants(part)
        if not around:
            return None
        return partial(response_deviation, part.system(""), around)

    def history(self) -> CoefficientHistory:
        """Course of both stages."""
        part = self.filter
        setup, lay = part.setup, part.setup.layout
        # measured outputs as far as the history was kept
        y = joined([y for _, y in part.records], (lay.ny,))
        total = y.shape[1]
        first = None if self.first is None else self.first.history()

        def beside(values: Array | None, rows: int) -> Array:
            values = np.zeros((rows, 0)) if values is None else values[:, :total]
            # NaN after the sample at which stage 1 stopped
            return np.pad(values, ((0, 0), (0, total - values.shape[1])), constant_values=np.nan)

        # coefficients and the poles of the model with them
        theta = joined([r.theta for r, _ in part.records], (lay.p,))
        timepts = np.arange(total, dtype=np.float64) * setup.settings.dt
        at = pole_samples(total)
        systems = [setup.system(theta[:, k], part.memory.widths, "") for k in at]
        return CoefficientHistory(
            timepts=timepts,
            coefficients=theta,
            poles=poles_of(systems, setup.settings.dt),
            pole_timepts=timepts[at],
            z1=beside(None if first is None else first.z1, lay.ny),
            z2=joined([r.predicted for r, _ in part.records], (lay.ny,)) - y,
            x_D=beside(None if first is None else first.x, self.model.n_states),
            x=joined([r.x for r, _ in part.records], (lay.n,)),
            y=y,
            names=tuple(f"discrete {name}" for name in setup.labels) if setup.translates else setup.labels,
            output_labels=self.model.output_labels,
        )

    def summary(self) -> Summary:
        """Cells and sentences of `str`."""
        found = self.static.summary(self.model.name)
        if self.stopped:
            found.notes.append(self.stopped.split(";")[0] + "; the static stage does not need it.")
        return found

    def state(self) -> dict[str, Any]:
        """All that is remembered, for a file."""
        static = self.static.state()  # all samples learned
        first = None if self.first is None else self.first.state()
        return {"static": static, "first": first, "stopped": self.stopped}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        check_like(state["stopped"], "", "stopped")
        self._waiting = []
        self._static.restore(state["static"])
        self.stopped = state["stopped"]
        if self.first is not None:
            self.first.restore(state["first"])


# Of a standard deviation: to first order, for directions that no sensor sees (a change of
# coordinates) have deviations that are large, and would bend the response.
_SHARE = 1e-4


def variants(part: CoefficientFilter) -> list[LinearModel]:
    """Return models that deviate slightly from the estimate.

    There is one along each independent direction of the coefficients.
    """
    setup, memory = part.setup, part.memory
    theta, covariance = part.own
    if memory.rounds == 0 or not covariance.size:
        return []
    # correlation first: coefficients of unlike size would hide one another
    size = standard_deviations(covariance)
    scale = np.where(size > 0, size, 1.0)
    # principal directions of the correlation matrix: independent of each other
    values, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    # one standard deviation along each, in units of the coefficients
    steps = (directions * np.sqrt(np.maximum(values, 0.0))).T * scale
    return [setup.system(theta + _SHARE * step, memory.widths, "variant") for step in steps if step.any()]


def response_deviation(center: LinearModel, around: Sequence[LinearModel], omega: Array) -> Array:
    """Return the standard deviation of the frequency response.

    The shape is (n_y, n_w, K). It is NaN beyond the Nyquist frequency of the model.

    Parameters
    ----------
    center : LinearModel
        Estimated model.
    around : sequence of LinearModel
        What `variants` gives.
    omega : ndarray of shape (K,)
        Frequencies in rad/s.
    """
    # a discrete model has no response beyond the Nyquist frequency
    seen = np.ones(omega.size, dtype=bool)
    if not center.is_continuous and center.dt is not None and center.dt is not True:
        seen = omega <= np.pi / float(center.dt)
    total = np.full((center.n_outputs, center.n_inputs, omega.size), np.nan)
    # finite difference along each independent direction; variances add
    reference = frequency_response(center, omega[seen])
    total[:, :, seen] = 0.0
    for model in around:
        total[:, :, seen] += np.abs(frequency_response(model, omega[seen]) - reference) ** 2
    return np.asarray(np.sqrt(total) / _SHARE)


_STATIC = ("static_window", "static_markov", "static_learning_rate", "static_average")
_PAPERS = ("window", "markov", *_STATIC)
_FILTERS: dict[str, Any] = {
    "noise": None,
    "hold": "zoh",
    "disturbance": None,
    "forgetting": 1.0,
    "substeps": None,
}
_MOST = 150  # coefficients of a form that takes part in a race unasked


def assembled(given: dict[str, Any], sampled: Sampled) -> PaperStages | JointStages:
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
    # entries or effects by name, or a form of the correction
    listed = _named_items(static, given["effects"])
    if given["substeps"] is not None:
        given["substeps"] = as_whole(given["substeps"], "substeps", least=1, error=ModelError)
    step = 1.0 if sampled.step is None else sampled.step
    filters = (given[name] for name in ("hold", "noise", "disturbance", "forgetting"))
    settings = checked_settings(sampled.initial.n_outputs, step, *filters)
    # settings of the paper select the paper's equations, for both stages
    papers = [name for name in _PAPERS if given[name] is not None]
    if listed is None and static == "auto" and papers:
        return _paper(given, sampled, keep, papers[0])
    # otherwise a joint Kalman filter: settings of the paper's static stage do not apply
    if wrong := [name for name in papers if name in _STATIC]:
        raise ct.ControlArgument(
            f"{wrong[0]} is a setting of the paper's static stage; leave it out, or static= and effects="
        )
    chosen: CoefficientFilter | FilterBank
    # named coefficients: one filter; a form: filters side by side, with the initial model
    if listed is not None:
        chosen = CoefficientFilter(_named_setup(given, sampled, listed, settings), keep)
    else:
        _check_linear(given, "substeps is a setting of nonlinear effects; give effects=[...]")
        forms = _forms(static, given, sampled, settings)
        chosen = FilterBank(forms, no_entries(sampled.initial, settings), keep)
    # stage 1 of the paper beside it, with a short window
    first, silent = _stage_one(given, sampled, keep)
    return JointStages(chosen, first, sampled.initial, keep, silent)


def _check_linear(given: dict[str, Any], message: str) -> None:
    """Refuse what entries and forms have no use for.

    These are substeps, and another hold than a physical model was found with.
    """
    if given["substeps"] is not None:
        raise ct.ControlArgument(message)
    physical = getattr(given["model"], "physical_model", given["model"])
    if isinstance(physical, PhysicalModel):
        check_stream_hold(physical, given["hold"])


def _named_items(static: Any, effects: Any) -> list[Any] | None:
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


def _paper(given: dict[str, Any], sampled: Sampled, keep: bool, asked: str) -> PaperStages:
    unused = [name for name, default in _FILTERS.items() if not np.array_equal(given[name], default)]
    if unused:
        raise ct.ControlArgument(
            f"{unused[0]} is a setting of the joint filter, {asked} one of the paper's equations; "
            "name effects=[...] or static=..., or leave one of the two out"
        )
    return PaperStages(sampled, given, keep)


def _stage_one(given: dict[str, Any], sampled: Sampled, keep: bool) -> tuple[PaperStages | None, str]:
    """Stage 1 beside the filter, or why there is none."""
    if not given["use_estimated_states"]:
        return None, ""
    # Markov parameters: does each input act on an output within n samples?
    m = sampled.discrete
    shown = markov_parameters(Plant(m.A, m.B, m.B, m.C, m.D, m.D), m.n_states + 1).any(axis=(0, 1))
    given_path = given["correction_input"] is not None or given["correction_feedthrough"] is not None
    if not given_path and not shown.all():
        return None, "Stage 1 does not run: an input affects no output, so it cannot correct any."
    return PaperStages(sampled, given, keep, beside=True), ""


def _named_setup(
    given: dict[str, Any], sampled: Sampled, items: Sequence[Any], settings: FilterSettings
) -> CoefficientSetup:
    """Coefficients that the user names: entries or effects."""
    if items and all(isinstance(item, str) for item in items) and given["effects"] is None:
        _check_linear(given, "substeps is a setting of nonlinear effects; entries have none")
        return named_entries(sampled.initial, items, settings)
    assert sampled.step is not None or not sampled.initial.is_continuous
    return make_effects_setup(given["model"], items, settings, given["substeps"])


def _forms(
    static: str, given: dict[str, Any], sampled: Sampled, settings: FilterSettings
) -> dict[str, CoefficientSetup]:
    """Return the correction forms that take part, the most physical first."""
    model, every = sampled.initial, static == "auto"
    found: dict[str, CoefficientSetup] = {}
    # most physical first: entries of the model, its inputs, all entries of the discrete model
    if static in ("auto", "nonzero"):
        found["nonzero"] = nonzero_entries(model, settings)
    path = correction_path(model, given)
    if static in ("auto", "input"):
        found["input"] = correction(model, *path, settings)
    if static in ("auto", "discrete"):
        if settings.hold == "zoh" or not model.is_continuous:
            found["discrete"] = all_entries(model, sampled.discrete, settings)
        elif not every:
            raise ModelError("static='discrete' needs a held input; leave hold out, or take static='nonzero'")
    # a form with too many coefficients takes part on request only
    if every:
        found = {name: setup for name, setup in found.items() if len(setup.labels) <= _MOST}
    return {name: setup for name, setup in found.items() if setup.labels}
