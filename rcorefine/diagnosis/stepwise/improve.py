"""Add what is missing, one effect after the other, and watch the error fall."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import control as ct
import numpy as np

from ...arguments import as_share, as_whole
from ...arithmetic import own_arithmetic
from ...data.measurement import Measurement
from ...effects.effect import Effect
from ...effects.several import as_effects
from ...effects.tabulated import Table
from ...exceptions import IdentifiabilityWarning, unheard
from ...inference.assembly import check_settings
from ...inference.windows import as_data, check_validation
from ...models.conversion import as_physical, under_control
from ...models.operating_point import ordered_record
from ...progress import Progress
from ..case import candidates_of, not_held, seen_in_responses
from ..checks.check import looks
from .backward import drop_last, drop_needless, drop_undetermined, return_trust, shorten, swap_better
from .forward import climb, tabulate
from .improvement import Improvement, Step
from .parts import common_horizon, split_in_parts
from .selection import StepwiseSelection

__all__ = ["improve"]

_ROUNDS = 3  # times that a finished ladder is reconsidered


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
    controller: ct.StateSpace | None = None,
    executor: Any = None,
    progress: bool = False,
) -> Improvement:
    """Diagnose, add the effect, fit all together, test again, until nothing earns its place.

    The record is split in three: effects are fitted on the first part (three fifths of the
    samples, and at least 200), chosen on the second, and the error that is reported comes from
    the third, which took part in nothing. An effect that is no longer needed is dropped; where no
    effect helps alone, pairs are tried.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement or list of Measurement
        Record, or several of the same system. Or a `FrequencyResponse`, or a list of them: of five
        frequencies in turn three are fitted, one chooses, one judges, and errors are over the noise.
    validation : Measurement or FrequencyResponse, optional
        Record that judges; by default the last fifth of `data`.
    max_effects : int
        Effects at most.
    candidates : sequence of Effect, optional
        What could be missing, default `effect_library(model)`.
    free, tolerance, offset, noise, horizon
        As in `refine`.
    significance : float
        Level of the gate of `diagnose`.
    controller : StateSpace or TransferFunction, optional
        As in `refine`: the controller under which the record was taken.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Refits candidates in parallel.
    progress : bool
        Whether to show steps and remaining time on standard error.

    Returns
    -------
    Improvement
        The steps, the last model, the picture.

    Raises
    ------
    DataError
        If the record is too short to split.

    Notes
    -----
    An effect is accepted where the model with it, and with no rival, passes every test, or where
    it lowers the log error of the free run on the second part by at least 5 % per coefficient.
    One that stands out by its likelihood alone, or among rivals, is taken on trust if it costs no
    more than 2 % there: where the ladder does not end in a model that passes every test, it goes
    again unless it has earned its place on the second part by then. No effect stays that the record
    does not determine: its size, and each coefficient that shapes it, must be more than 3 standard
    deviations from zero (``rcorefine.moved``), and friction and losses must be positive. `diagnose`
    names effects by the same rule. No set of effects is tried twice. Steps after which the
    third part is worse off than at the start are taken back. Where nothing that was tried explains
    the record, its last rung is the force that is left, as a table (`Diagnosis.law`), if that lowers
    the error on the second part. Where no law passes, and the model's own numbers, each with a prior
    of 5 % (``control.config.defaults["rcorefine.off"]``), lower that error by 5 % more than the best
    law does, they float from then on, and laws are sought beside them.

    Where the model integrates, one horizon holds for all parts: that of `compare` on the whole record. At
    the end the result is compared with ``refine(model, data, free="linear")``. Where the linear fit of the
    first part explains the second better, by a log-likelihood of 4.6, the search begins anew from it.

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
    >>> ladder = rco.improve(model, data, candidates=laws)
    >>> [step.effect.kind for step in ladder.steps[1:]], ladder.verdict
    (['stiffness'], 'adequate')
    """
    max_effects = as_whole(max_effects, "max_effects")
    significance = as_share(significance, "significance")
    records = as_data(data, horizon=horizon, noise=noise, controller=controller)
    model = under_control(model, controller, data)
    physical = as_physical(model)
    check_settings(physical, free=free, tolerance=tolerance, offset=offset, noise=noise, horizon=horizon)
    library = candidates_of(physical) if candidates is None else as_effects(candidates, "candidates")
    if validation is not None:
        check_validation(model, validation)
    parts = split_in_parts(records, validation)
    ordered = [ordered_record(physical, record) for record in records]
    horizon, cut = common_horizon(physical, ordered, horizon)
    settings = {"tolerance": tolerance, "offset": offset, "noise": noise, "horizon": horizon}
    # ties are in the ledger
    with own_arithmetic(), unheard(IdentifiabilityWarning), Progress(progress, executor) as bar:
        ladder = StepwiseSelection(
            model, parts, free=free, settings=settings, significance=significance, progress=bar
        )
        # by now the channels of every record are known to be there
        odd = looks(model, records, horizon) if ladder.in_time else ()
        if not ladder.in_time:
            library = seen_in_responses(physical, library, ordered, candidates is not None)
        _climb(ladder, library, max_effects)
        if max_effects and ladder.take_linear_fit():
            _climb(ladder, library, max_effects)
        if ladder.in_time and len(ladder.effects) < max_effects and ladder.verdict(library) == "unexplained":
            tabulate(ladder, library)
        back = _end(ladder)
        verdict = ladder.verdict(library)
        tables = [effect.place for effect in ladder.effects if isinstance(effect.law, Table)]
        said = (f" The law at {place} is open: its force is a table." for place in tables)
        message = _ending(ladder, verdict, library, max_effects, back) + "".join(said)
    steps, names = _with_other_names(ladder.steps)
    outputs = physical.linear.output_labels
    units = tuple(parts.fit[0].output_units) if ladder.in_time else ("std",) * len(outputs)
    notes = (*ladder.notes(), *cut, *names)
    return Improvement(tuple(steps), verdict, message, outputs, units, notes, odd)


def _climb(ladder: StepwiseSelection, library: list[Effect], most: int) -> None:
    """Add; drop and swap until all hold; what was added on trust goes unless the model is adequate."""
    verdict = climb(ladder, library, most)
    if verdict == "adequate" and ladder.parts.whole:
        # what remains is noise: the likelihood decides from here on, and needs no second part
        ladder.pool()
        verdict = climb(ladder, library, most)
    for _ in range(_ROUNDS):
        by_error = ladder.by_error and verdict != "adequate"
        changed = any([drop_needless(ladder, len(library), by_error), drop_undetermined(ladder)])
        if by_error or not (swap_better(ladder, library) or changed):
            break
        verdict = climb(ladder, library, most)
    if ladder.on_trust and ladder.verdict(library) != "adequate":
        return_trust(ladder)
    shorten(ladder, most)
    drop_last(ladder, len(library))


def _end(ladder: StepwiseSelection) -> list[str]:
    """Fit once more, leave out what the records do not determine, and go back as far as the judge demands."""
    ladder.settle()
    while drop_undetermined(ladder):
        ladder.settle(last=True)
    back: list[str] = []
    while ladder.is_worse_than_start():
        back.insert(0, ladder.steps[-1].name)
        ladder.take_back()
        ladder.settle(last=True)
    return back


def _ending(
    ladder: StepwiseSelection, verdict: str, library: list[Effect], most: int, back: list[str]
) -> str:
    """Why the ladder ends where it ends."""
    if back and verdict == "adequate":
        return f"Every test passes. Taken back, since the part that judges was worse off: {', '.join(back)}."
    if verdict == "adequate":
        return "Every test passes: nothing is missing that this record could show."
    if back:
        return (
            f"Taken back: {', '.join(back)}. On the part that took part in nothing the model was worse with "
            "that than at the start. The residual still speaks."
        )
    if len(ladder.effects) >= most:
        return f"Stopped at max_effects = {most}; the residual still speaks."
    if not ladder.rest(library):
        return "No candidate is left; the residual still speaks."
    return "No effect, and no pair of them, lowers the held-out error enough to earn a place."


def _with_other_names(steps: Sequence[Step]) -> tuple[list[Step], list[str]]:
    """The steps, each effect tied with the one that it is by another name, and a sentence for each.

    Parameters
    ----------
    steps : sequence of Step
        Of a ladder.

    Returns
    -------
    steps : list of Step
    sentences : list of str
    """
    named, sentences = [], []
    for step in steps:
        other = _other_name(step)
        if step.effect is not None and other is not None:
            sentences.append(
                f"{step.effect.label} with the constant offset is {other.label} by another name: "
                "the record cannot tell them apart."
            )
        named.append(step if other is None else replace(step, rivals=(*step.rivals, other)))
    return named, sentences


def _other_name(step: Step) -> Effect | None:
    """The law that this one is by another name, where a constant offset acts at the same place."""
    effect, held = step.effect, step.refinement
    if effect is None or not effect.spec.with_offset or step.action == "drop":
        return None
    linear = held.physical_model.linear
    act = held.physical_model.port(effect.place).act
    for offset, role in zip(held.effects, held.roles, strict=True):
        if role != "offset":
            continue
        port = next((p for p in held.physical_model.ports if p.name == offset.place), None)
        push = offset.spec.push(linear, offset.place, None if port is None else port.act)
        if push is not None and abs(push @ act) > (1 - 1e-9) * np.linalg.norm(push) * np.linalg.norm(act):
            other = Effect(effect.spec.with_offset, effect.place)
            return next(iter(not_held([other], [*held.effects, *step.rivals])), None)
    return None
