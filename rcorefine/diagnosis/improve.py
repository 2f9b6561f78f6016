"""Stepwise improvement of a model by the effects that it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_whole
from ..data.measurement import Measurement
from ..data.records import as_data
from ..effects.effect import Effect
from ..exceptions import (
    DataError,
    IdentifiabilityWarning,
    ModelError,
    own_arithmetic,
    unheard,
)
from ..inference.refinement import Refinement
from ..models.controller import Controller
from ..progress import Progress
from ..refinement.refine import refine
from .case import not_held, split_in_parts
from .diagnose import Investigation, investigate, parameters_off
from .held_out import HeldOutPath, case_of_part, exchanged, loose, mean_log
from .hypothesis import Trial
from .noise import in_percent
from .open_law import open_force
from .result import Improvement, asked_effects
from .search import Search

_ALONG = 1.0 - 1e-9  # cosine of two force vectors that are one
_JUDGED, _SETTLED = 30, 10  # sets compared by the error on the second part; most sets refitted of them


def improve(
    model: Any,
    data: Measurement | Sequence[Measurement],
    *,
    validation: Measurement | None = None,
    max_effects: int = 4,
    candidates: Sequence[Effect] | None = None,
    free: str | Sequence[Any] = (),
    tolerance: float = 0.0,
    offset: bool = True,
    noise: float | Sequence[float] | None = None,
    horizon: float | None = None,
    significance: float = 0.01,
    matters: float | None = None,
    effort: float = 1.0,
    controller: Controller | ct.StateSpace | None = None,
    executor: Any = None,
    progress: bool | None = None,
) -> Improvement:
    """Find the set of effects that a model lacks, step by step.

    The set is that of `diagnose` of the same records, with the same word. The function shows the path to it:
    each step adds an effect, and its error is measured on held-out data, to which no coefficient is fitted.

    The record is split into three parts in time: three fifths of the samples, and at least 36, then a fifth,
    and a fifth of held-out data. Five records or more are divided as wholes: of five in turn, three belong to
    the first part, one to the second and one to the third.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement or list of Measurement
        Record, or several records of the same system. Or a `FrequencyResponse`, or a list of them. Of each
        five successive frequencies, three belong to the first part, one to the second and one to the third.
        Errors of frequency responses are relative to their noise.
    validation : Measurement or FrequencyResponse, optional
        Validation data; by default a fifth of `data`. With it, `data` is split into two parts only.
    max_effects : int
        Maximum number of effects.
    candidates : sequence of Effect, optional
        Candidate effects, default `effect_library(model)` and the faults of a whole record.
    free, tolerance, offset, noise, horizon
        As in `refine`.
    significance : float
        Significance level of the residual tests, as in `diagnose`.
    matters : float, optional
        Share of the spread of an output, default .01 (``rcorefine.matters``). An error of the model below it,
        or below the rounding step of the sensor, does not matter even if a test finds it.
    effort : float
        Number of refits of each search, in units of 120, as in `diagnose`.
    controller : Controller, StateSpace or TransferFunction, optional
        As in `refine`: the controller that was active during the measurement.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Executor that refits candidates in parallel.
    progress : bool, optional
        Whether to show steps and remaining time on standard error. By default in a terminal and in a
        notebook.

    Returns
    -------
    Improvement
        Steps, improved model, and pictures.

    Raises
    ------
    DataError
        If the record is too short to split, or if it shows no motion.

    Notes
    -----
    Choice: the set that `diagnose` names. Without `validation`, it was chosen on the whole record; the
    coefficients of each step are fitted without the held-out fifth.

    If `diagnose` names none, the verdict is "unexplained". The last step is then its best set, if this leaves
    less than `matters`. Otherwise sets are compared on the first part under white noise. The set with the
    least error on the first two parts is chosen (mean of the logarithms). It must decrease this error by more
    than 5 % per coefficient. Last steps are removed while the error on the third part exceeds that of the
    start, or while the data do not determine an effect. A last step may be the unknown force at a place,
    tabulated (`Diagnosis.law`). It needs a 5 % smaller error on the second part.

    Steps: the first step is the effect without which the other effects give the largest error. If parameters
    of the model are wrong, they are re-estimated together with the effects.

    For a model that integrates, the free runs of all parts have one length, that of `compare` on the whole
    record.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> true = rco.mass_spring_damper([1.0], [0.4], [80.0], sensors="displacement")
    >>> rng = np.random.default_rng(0)
    >>> force = 10 * rng.standard_normal(3000)
    >>> y = rco.simulate(true, rco.Measurement(force, np.zeros(3000), dt=0.02), "zero").outputs[0]
    >>> data = rco.Measurement(force, y + 0.03 * y.std() * rng.standard_normal(3000), dt=0.02)
    >>> laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping", "cubic_stiffness")]
    >>> found = rco.improve(model, data, candidates=laws)
    >>> [step.effect.kind for step in found.steps[1:]], found.verdict
    (['stiffness'], 'adequate')
    """
    max_effects = as_whole(max_effects, "max_effects")
    given = as_data(data, horizon=horizon, noise=noise, controller=controller)
    split_in_parts(given, validation)  # a record that is too short is told before the search
    with own_arithmetic(), unheard(IdentifiabilityWarning), Progress(progress, executor) as bar:
        asked = investigate(
            model, data, candidates=candidates, validation=validation, free=free, tolerance=tolerance,
            offset=offset, noise=noise, horizon=horizon, significance=significance, matters=matters,
            effort=effort, controller=controller, steps=bar, most=max_effects,
        )  # fmt: skip
        return _Improver(asked, max_effects).improvement()


class _Improver:
    """Path from the initial model to the set of a diagnosis.

    Parameters
    ----------
    asked : Investigation
        Diagnosis of the records, with its case.
    most : int
        Maximum number of effects.
    """

    def __init__(self, asked: Investigation, most: int) -> None:
        self.found, self.case, self.model, self.most = asked.found, asked.case, asked.model, most
        # held-out parts and one horizon for all of them
        self.path = HeldOutPath(split_in_parts(self.case.records, asked.validation), self.case)

    def improvement(self) -> Improvement:
        """Go to the set of the diagnosis, or by the error where it names none."""
        found, path = self.found, self.path
        if found.verdict == "ambiguous" and not found.ranking:  # nothing moves
            raise DataError(" ".join(found.notes))
        # the path ends at the set of the diagnosis, or where the held-out error is least
        if not self.most:
            path.follow(self.case.base, None, self.case.base, (), "", {})
            message, notes = "Stopped at max_effects = 0; the residual is not noise.", list[str]()
        elif found.verdict == "unexplained" and not np.isfinite(found.adequate_to):
            message, notes = self._by_error()
        else:
            message, notes = self._named()
        word = "unexplained" if found.verdict == "unexplained" or not self.most else "adequate"
        labels, units = found.base.physical_model.linear.output_labels, self.case.ordered[0].error_units
        notes = [*found.notes, *path.parts.remarks, *notes, *path.said]
        left = path.errors_on(path.parts.judge, path.last)
        return Improvement(
            tuple(path.steps), word, message, labels, units, tuple(notes), found.checks, left, found
        )  # fmt: skip

    def _named(self) -> tuple[str, list[str]]:
        """Follow the path to the model of the diagnosis; return message and notes."""
        found, start, path = self.found, self.case.base, self.path
        # from the model as it is over re-estimated parameters to the effects
        effects, last, beside = tuple[Effect, ...](), found.floated or found.base, found.floated
        if found.best is not None and found.floated is None:
            effects, last = found.best.effects, found.best.refinement
            beside = found.base if "linear" in found.base.roles and "linear" not in start.roles else None
        if not effects and found.floated is None:  # with what the record as a whole needs, such as its hold
            start = found.base
        ties = exchanged(found.effects, (row.effects for row in found.ranking[1:] if row.alike))
        path.follow(start, beside, last, effects, found.verdict, ties)
        # error on data that no fit has used
        worse = mean_log(path.steps[-1].validation_rmse) > mean_log(path.steps[0].validation_rmse)
        notes = ["The error on the held-out data did not decrease."] if worse else []
        notes += filter(None, [self._with_other_name(i) for i in range(len(path.steps))])
        if found.verdict == "unexplained":
            return self._close(), notes
        if np.isfinite(found.adequate_to):
            return f"The model is adequate to {in_percent(found.adequate_to)}.", notes
        nothing = "" if len(path.steps) > 1 else ": this record shows no missing effect"
        return f"No residual test is significant{nothing}.", notes

    def _with_other_name(self, i: int) -> str:
        """Tie a step with the effect that it equals together with an offset.

        Returns a sentence, or an empty string: also if no offset acts at the same place.
        """
        step = self.path.steps[i]
        effect, held = step.effect, step.refinement
        if effect is None or not effect.spec.with_offset:
            return ""
        model, other = held.physical_model, Effect(effect.spec.with_offset, effect.place)
        act = model.port(effect.place).act
        # offset and effect along the same force vector
        for offset, role in zip(held.effects, held.roles, strict=True):
            if role != "offset":
                continue
            port = next((p for p in model.ports if p.name == offset.place), None)
            push = offset.spec.push(model.linear, offset.place, None if port is None else port.act)
            if push is None or not abs(push @ act) > _ALONG * np.linalg.norm(push) * np.linalg.norm(act):
                continue
            if not not_held([other], held.effects):
                return ""
            self.path.steps[i] = replace(step, rivals=(*not_held(step.rivals, [other]), other))
            return (
                f"{effect.label} with the constant offset is {other.label} by another name: the data cannot "
                "distinguish them."
            )
        return ""

    # ------------------------------------------------------------------ no set is named
    def _by_error(self) -> tuple[str, list[str]]:
        """Go to the set of least error; return message and notes."""
        # no set is named: search on the first part, with white noise
        path, case = self.path, self.case
        _, part = case_of_part(case, self.model, path.parts.fit, path.settings)
        search = Search(part, self.most, colored=False).run()
        # add to the set of least error while it improves
        chosen = self._of_least_error(search)
        for _ in range(self.most):
            before = chosen
            search.climbed(before)
            chosen = self._of_least_error(search)
            if chosen is before:
                break
        beside = search.base(chosen.hypothesis.nuisances).refinement if chosen.hypothesis.nuisances else None
        last, effects = _with_spread(chosen), chosen.effects
        # steps that do not reduce the held-out error are taken back
        path.follow(case.base, beside, last, effects, "unexplained", {})
        path.cut()
        back = path.back()
        # last resort: a table for the force that remains
        table = "" if path.is_close else self._with_table(search)
        ending = self._ending(back, len(effects) >= self.most, table)
        return ending, [search.not_afforded] if search.not_afforded else []

    def _of_least_error(self, search: Search) -> Trial:
        """Return the set of least error with effects that the data determine.

        The empty set if no other decreases the error enough for its coefficients.
        """
        # sets whose effects the data determine, up to 30 by evidence
        tried = [
            t
            for t in search.ranked()
            if not t.hypothesis.ratio
            and search.determined(t)
            and (not t.hypothesis.floated or parameters_off(t, self.case.levels))
        ][:_JUDGED]
        # their error on fit and choice parts; refit the best ten
        costs = {t: self._cost(t) for t in tried}
        least = self._cost(search.trials[0])
        for trial in sorted(tried, key=costs.__getitem__)[:_SETTLED]:
            if not costs[trial] < least:
                break
            if not loose(self.path.settled(_with_spread(trial)), trial.effects):
                return trial
        return search.trials[0]

    def _cost(self, trial: Trial) -> float:
        """Return the mean log error on two parts, with a price per coefficient."""
        model, price = trial.model.refinement, self.case.levels.earned * trial.n_coefficients
        return 0.5 * (mean_log(model.rmse) + self.path.log_error(model)) + price

    def _with_table(self, search: Search) -> str:
        """Add the remaining force, tabulated, as a last step; return a sentence.

        Empty if there is no such force, if an effect already acts at its place, or if the table cannot be
        fitted. Also if it decreases the error on the second part by less than 5 % (`Levels.earned`).
        """
        # one step left, and a free force that no effect of the set explains
        path, last = self.path, self.path.last
        if not self.case.in_time or sum(step.effect is not None for step in path.steps) >= self.most:
            return ""
        with self.case.progress.step("free forces"):
            free, _ = open_force(search)
        law = None if free is None else free.law
        if law is None or law.effect.place in [effect.place for effect in asked_effects(last)]:
            return ""
        # fit a table at that place; keep it if the held-out error falls
        try:
            with_table = refine(last, path.parts.learn, [law.effect], **path.settings)
        except (DataError, ModelError):
            return ""
        if path.log_error(last) - path.log_error(with_table) < self.case.levels.earned:
            return ""
        path.add(law.effect, "add", with_table, "unexplained")
        gone = path.back()
        return "" if gone else f" The force at {law.effect.place} is unknown: a table holds it."

    def _ending(self, back: Sequence[str], full: bool, table: str) -> str:
        """Return the reason why the improvement ended."""
        if self.path.is_close:
            return self._close()
        if back:
            return (
                f"Removed: {', '.join(back)}. The held-out error was larger than at the start, or the data "
                "do not determine them. The residual is not noise."
            )
        if full:
            return f"Stopped at max_effects = {self.most}; the residual is not noise.{table}"
        return f"No other set of effects reduces the held-out error enough.{table}"

    def _close(self) -> str:
        """Return the end if the error of the model is too small to matter."""
        path, parts = self.path, self.path.parts
        last = path.last
        most = max(one.model for part in (parts.learn, parts.judge) for one in path.errors_on(part, last))
        least = "" if most > path.matters else f", less than what matters ({in_percent(path.matters)})"
        return (
            f"The residual is not noise, but the error of the model is at most {in_percent(most)} of the "
            f"motion{least}. It may serve in a simulation, although its effects may only imitate what is "
            "missing."
        )


def _with_spread(chosen: Trial) -> Refinement:
    """Return the model of a trial with the most probable parameter priors."""
    # spread of the parameters with the largest evidence
    model = chosen.model.refinement
    spread = max(chosen.log_evidence, key=lambda s: chosen.log_evidence[s])
    if not chosen.hypothesis.floated or not spread:
        return model
    factor = spread / chosen.hypothesis.spread
    effects = tuple(
        e.replace(prior={n: factor * sd for n, sd in e.prior.items()}) if role == "linear" and e.prior else e
        for e, role in zip(model.effects, model.roles, strict=True)
    )
    return replace(model, effects=effects)
