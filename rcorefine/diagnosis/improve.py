"""Add what is missing, one effect after the other, and watch the error fall."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arguments import as_share, as_whole
from ..arithmetic import own_arithmetic
from ..comparison.channels import match_channels, record_for
from ..comparison.compare import compare
from ..exceptions import DataError, DivergenceError, IdentifiabilityWarning
from ..measurement import Measurement
from ..physics.effects import Effect, as_effects
from ..physics.library import effect_library
from ..physics.physical_model import as_physical
from ..progress import Progress
from ..refinement.assembly import check_settings
from ..refinement.refine import refine, refit
from ..refinement.refinement import Refinement
from ..refinement.windows import as_records, check_validation, windows
from ..systems.linear import Array
from .diagnose import investigate
from .excitation import no_motion, record_remarks
from .holds import best_hold
from .ledger import Improvement, Step
from .result import Diagnosis
from .rivals import Race
from .state import fitted_from
from .whitening import Whitener

__all__ = ["improve"]

_FIT, _CHOOSE = 0.6, 0.2  # shares of the record; the rest judges
_BETTER = 4.6  # log-likelihood by which a rival must win to be swapped in
_GAIN = 0.05  # log of the held-out error that each coefficient must earn
_TRIED = 12  # effects of smallest error that are judged on the second part
_REFITTED = 3  # of them, fitted to the end
_ALIKE = 0.2  # log of the error within which the linear parameters decide
_WORSE = 0.02  # log of the held-out error that an effect taken on trust may cost
_EXCERPT, _PIECES = 8000, 4  # samples of a long record on which the ladder climbs
_SHORTEST, _MOST_RECORDS = 1000, 16  # samples of such a piece, records that it is made of
_ROUNDS = 3  # times that a finished ladder is reconsidered
_PAIRS_FROM = 3  # first effects of which pairs are tried where none helps alone


@dataclass(frozen=True, slots=True)
class _Parts:
    """Records to fit on (an excerpt where they are long), to choose on, to judge on, and all but the last."""

    fit: list[Measurement]
    choose: list[Measurement]
    judge: list[Measurement]
    learn: list[Measurement]
    remarks: tuple[str, ...] = ()

    @property
    def whole(self) -> bool:
        """Whether the first part is all of it, and no excerpt."""
        return not self.remarks

    def pooled(self) -> _Parts:
        """Fit on all that does not judge."""
        return replace(self, fit=self.learn)


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
    executor: Any = None,
    progress: bool = False,
) -> Improvement:
    """Diagnose, add the effect, fit all together, test again, until nothing earns its place.

    The record is split in three: effects are fitted on the first part, chosen on the
    second, and the error that is reported comes from the third, which took part in
    nothing. An effect that is no longer needed is dropped; where no effect helps alone,
    pairs are tried.

    Parameters
    ----------
    model : StateSpace, PhysicalModel or Refinement
        Initial model, continuous time.
    data : Measurement or list of Measurement
        Record, or several of the same system.
    validation : Measurement, optional
        Record that judges; by default the last fifth of `data`.
    max_effects : int
        Effects at most.
    candidates : sequence of Effect, optional
        What could be missing, default `effect_library(model)`.
    free, tolerance, offset, noise, horizon
        As in `refine`.
    significance : float
        Level of the gate of `diagnose`.
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
    An effect is accepted where the model with it passes every test, or where it lowers
    the log error of the free run on the second part by at least 5 % per coefficient.
    One that only stands out by its likelihood is taken on trust, and goes again if the
    ladder does not end in a model that passes every test.

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
    candidates = None if candidates is None else as_effects(candidates, "candidates")
    check_settings(
        as_physical(model), free=free, tolerance=tolerance, offset=offset, noise=noise, horizon=horizon
    )
    if validation is not None:
        check_validation(model, validation)
    parts = _split(as_records(data), validation)
    settings = {"tolerance": tolerance, "offset": offset, "noise": noise, "horizon": horizon}
    with own_arithmetic(), warnings.catch_warnings(), Progress(progress, executor) as bar:
        warnings.simplefilter("ignore", IdentifiabilityWarning)  # ties are in the ledger
        ladder = _Ladder(model, parts, free, settings, bar)
        library = effect_library(ladder.start.physical_model) if candidates is None else candidates
        options = {"significance": significance, "progress": bar}
        verdict, message = ladder.climb(library, max_effects, options)
        ladder.settle()
    linear = ladder.start.physical_model.linear
    units = tuple(parts.fit[0].output_units)
    return Improvement(
        tuple(ladder.steps), verdict, message, linear.output_labels, units, tuple(ladder.notes)
    )


class _Ladder:
    """The state of the climb: the present model and the steps that led to it."""

    def __init__(
        self, model: Any, parts: _Parts, free: Any, settings: dict[str, Any], progress: Progress
    ) -> None:
        self.model, self.parts, self.free, self.settings = model, parts, free, settings
        self.horizon: float | None = settings["horizon"]
        self.progress = progress
        with progress.step("model as it is"):
            self.start = refine(model, parts.fit, free=free, **settings)
        self.current = self.start
        self.effects: list[Effect] = []
        self._trust: list[bool] = []
        self._by_error = False
        self.notes: list[str] = [*parts.remarks, *record_remarks(parts.fit)]
        still = no_motion(parts.fit)
        if still:
            raise DataError(still)
        self.current = self._held(self.start)
        self.steps = [self._step(None, "start", self.current, "", ())]

    # --------------------------------------------------------------------- climbing
    def climb(self, library: list[Effect], most: int, options: dict[str, Any]) -> tuple[str, str]:
        """Add; drop and swap until all hold; what was added on trust goes unless the model is adequate."""
        verdict, message = self._forward(library, most, options)
        if verdict == "adequate" and self.effects and self.parts.whole:
            # what remains is noise: the likelihood decides from here on, and needs no second part
            self.parts = self.parts.pooled()
            self.current = self._refit(self.current)
            verdict, message = self._forward(library, most, options)
        for _ in range(_ROUNDS if len(self.effects) > 1 else 0):
            by_error = self._by_error and verdict != "adequate"
            dropped = self._drop(library, by_error)
            swapped = not by_error and self._swap(library, options)
            if by_error or not (dropped or swapped):
                break
            size = len(self.steps)
            verdict, message = self._forward(library, most, options)
            if not swapped and len(self.steps) == size:
                break
        if verdict != "adequate":
            self._return_trust()
        if len(self.effects) > most:
            self._shorten(most)
            verdict = self._investigate(self.current, self._rest(library), options)[0].verdict
            message = f"Stopped at max_effects = {most}; the residual still speaks."
        return verdict, message

    def _rest(self, library: list[Effect]) -> list[Effect]:
        return [e for e in library if not any(_same(e, held) for held in self.current.effects)]

    def _forward(self, library: list[Effect], most: int, options: dict[str, Any]) -> tuple[str, str]:
        while True:
            rest = self._rest(library)
            if not rest:
                return "unexplained", "No candidate is left."
            self.progress.round(ahead=max(most - len(self.effects), 0))
            found, race = self._investigate(self.current, rest, options)
            if found.verdict == "adequate":
                return "adequate", "Every test passes: nothing is missing that this record could show."
            # one more where that passes every test: an early one may then turn out to be needless
            if len(self.effects) >= most + (found.verdict != "unexplained" and most > 1):
                return found.verdict, f"Stopped at max_effects = {most}; the residual still speaks."
            chosen = self._earned(found, race, len(rest))
            if chosen is not None:
                effect, refinement, earned, ties = chosen
                self._add([effect], "add", found, refinement, earned, ties)
                continue
            pair = self._pair(race, rest, options)
            if pair is None:
                return (
                    found.verdict,
                    "No effect, and no pair of them, lowers the held-out error enough to earn a place.",
                )
            both, refinement = pair
            self._add(both, "pair", found, refinement, True)

    def _investigate(
        self, model: Refinement, library: list[Effect], options: dict[str, Any]
    ) -> tuple[Diagnosis, Race | None]:
        settings = {"free": self.free, **self.settings}
        return investigate(
            model,
            self.parts.fit,
            asked=library,
            validation=None,
            settings=settings,
            thorough=False,
            **options,
        )

    def _earned(
        self, found: Diagnosis, race: Race | None, choices: int
    ) -> tuple[Effect, Refinement, bool, tuple[Effect, ...]] | None:
        """The effect to add, the model with it, whether it earned its place for good, its ties.

        The most probable where the tests pass with it; else the one whose plain error on the
        second part falls most per coefficient; else, on trust, the most probable if its
        likelihood stands out.
        """
        if not found.ranking or race is None:
            return None
        top = found.ranking[0]
        if found.verdict in ("effect", "ambiguous"):
            return top.effect, self._refit(top.refinement), True, found.ambiguous
        before = _log_error(self.current, self.parts.choose, self.horizon)

        def share(effect: Effect, refinement: Refinement) -> float:
            size = max(len(_coefficients(effect, refinement)), 1)
            return (before - _log_error(refinement, self.parts.choose, self.horizon)) / size

        for effect, refinement, ties in self._by_pooled_error(race):
            if share(effect, refinement) < _GAIN:
                continue
            settled = self._refit(refinement)
            if share(effect, settled) >= _GAIN:
                self._by_error = True
                return effect, settled, True, ties
        if 2 * self._gain(top.refinement, self.current) > self._price(choices) * len(top.coefficients):
            settled = self._refit(top.refinement)
            if share(top.effect, settled) > -_WORSE:
                return top.effect, settled, False, found.ambiguous
        return None

    def _by_pooled_error(self, race: Race) -> list[tuple[Effect, Refinement, tuple[Effect, ...]]]:
        """The rivals that lower the error on both first parts most per coefficient, each with its ties.

        Where the errors hardly differ, the one behind which the linear parameters stay at the
        model's own numbers goes first: the others bend them to imitate it.
        """
        before = self._pooled(self.current)
        rows = []
        for effect, refinement in race.in_free_run(_TRIED):
            size = max(len(_coefficients(effect, refinement)), 1)
            rows.append(((before - self._pooled(refinement)) / size, effect, refinement))
        rows = sorted((row for row in rows if row[0] > _GAIN), key=lambda row: -row[0])[: 2 * _REFITTED]
        if not rows:
            return []
        alike = [row for row in rows if row[0] > rows[0][0] - _ALIKE]
        home = min(alike, key=lambda row: _far_from_home(row[2]))
        if _far_from_home(home[2]) < 0.5 * _far_from_home(rows[0][2]):
            rows.remove(home)
            rows.insert(0, home)
        return [
            (effect, refinement, tuple(other[1] for other in alike if other[1] is not effect))
            for _, effect, refinement in rows[:_REFITTED]
        ]

    def _pooled(self, refinement: Refinement) -> float:
        return _log_error(refinement, [*self.parts.fit, *self.parts.choose], self.horizon)

    def _refit(self, refinement: Refinement) -> Refinement:
        return refit(refinement, self.parts.fit, **self.settings)

    def _without(self, effect: Effect) -> Refinement:
        return refit(self.current, self.parts.fit, without=effect, elsewhere=False, **self.settings)

    def _price(self, choices: int) -> float:
        """Twice the log-likelihood that one coefficient must earn: BIC plus the choice among many."""
        samples = sum(record.n_samples for record in self.parts.fit)
        return float(np.log(samples) + 2 * np.log(max(choices, 1)))

    def _gain(self, one: Refinement, two: Refinement) -> float:
        """Log-likelihood of one model over another, under the whitening of the closer one.

        Each under its own whitening would not do: a filter of sixteen coefficients hides a
        missing effect.
        """
        both = []
        for refinement in (one, two):
            segments, _ = windows(refinement.physical_model, self.parts.fit, self.settings["horizon"])
            tolerance = self.settings["tolerance"]
            both.append(fitted_from(refinement, segments, tolerance=tolerance, noise=1.0).residuals())
        closer = min(both, key=lambda blocks: sum(float(np.sum(r**2)) for r in blocks))
        whitener = Whitener.fit(closer)
        first, second = (whitener.apply(blocks) for blocks in both)
        return 0.5 * float(second @ second - first @ first)

    def _add(
        self,
        effects: Sequence[Effect],
        action: str,
        found: Diagnosis,
        refinement: Refinement,
        earned: bool,
        ties: tuple[Effect, ...] = (),
    ) -> None:
        # a wrong hold looks like a missing effect, and a missing effect like a wrong hold: twice is enough
        self.current = refinement if self.effects else self._held(refinement)
        self.effects += list(effects)
        self._trust += [earned] * len(effects)
        rivals = tuple(e for e in ties if not any(_same(e, own) for own in effects))
        for effect in effects:
            self.steps.append(self._step(effect, action, self.current, found.verdict, rivals))

    def _return_trust(self) -> None:
        """Take back the last steps as long as they were taken on trust."""
        while self._trust and not self._trust[-1] and self.steps[-1].action == "add":
            self._trust.pop()
            self.effects.pop()
            self.steps.pop()
            self.current = self.steps[-1].refinement

    def _swap(self, library: list[Effect], options: dict[str, Any]) -> bool:
        """Put another effect in the place of an older one where that explains the record better."""
        swapped = False
        for position, effect in enumerate(list(self.effects)):
            if self.steps[-1].action == "add" and effect is self.effects[-1]:
                break  # it has just won against all others
            without = self._without(effect)
            rest = [e for e in library if not any(_same(e, held) for held in without.effects)]
            found, _ = self._investigate(without, rest, options)
            if not found.ranking or _same(found.ranking[0].effect, effect):
                continue
            row = found.ranking[0]
            if self._gain(row.refinement, self.current) > _BETTER:
                self.effects[position] = row.effect
                self.current = self._refit(row.refinement)
                self.steps.append(self._step(row.effect, "swap", self.current, found.verdict, (effect,)))
                swapped = True
        return swapped

    def _drop(self, library: list[Effect], by_error: bool) -> bool:
        """Backward step: effects whose absence costs less than their price go, the cheapest first."""
        dropped = False
        while len(self.effects) > 1:
            doubtful = [i for i in range(len(self.effects)) if by_error or not self._sure(i, len(library))]
            costs = {i: self._cost(self.effects[i], len(library), by_error) for i in doubtful}
            cheapest = min(costs, key=lambda i: costs[i][0], default=-1)
            if cheapest < 0 or costs[cheapest][0] >= 0:
                break
            self._remove(cheapest, costs[cheapest][1])
            dropped = True
        return dropped

    def _sure(self, index: int, choices: int) -> bool:
        """Whether an effect is so many standard deviations from nothing that it need not be tried without."""
        effect = self.effects[index]
        (value, *more), (std, *_) = (
            _coefficients(effect, self.current, w).values() for w in ("coefficient", "std")
        )
        return not more and 0 < std < np.inf and (value / std) ** 2 > 4 * self._price(choices)

    def _cost(self, effect: Effect, choices: int, by_error: bool) -> tuple[float, Refinement]:
        """What the absence of an effect costs beyond its price, and the model without it."""
        without = self._without(effect)
        size = len(effect.coefficients)
        if by_error:
            both = [*self.parts.fit, *self.parts.choose]
            lost = max(
                _log_error(without, p, self.horizon) - _log_error(self.current, p, self.horizon)
                for p in (self.parts.choose, both)
            )
            return lost - _GAIN * size, without
        return 2 * self._gain(self.current, without) - self._price(choices) * size, without

    def _remove(self, index: int, without: Refinement) -> None:
        effect = self.effects.pop(index)
        self._trust.pop(index)
        self.current = without
        self.steps.append(self._step(effect, "drop", without, "", ()))

    def _shorten(self, most: int) -> None:
        """Drop what costs least until no more than `most` effects are left."""
        while len(self.effects) > most:
            costs = [self._cost(effect, 1, False) for effect in self.effects]
            cheapest = min(range(len(costs)), key=lambda i: costs[i][0])
            self._remove(cheapest, costs[cheapest][1])

    def _held(self, refinement: Refinement) -> Refinement:
        """The model under the hold that suits it, and keeps from then on."""
        with self.progress.step("holds"):
            hold, sentence = best_hold(refinement, self.parts.fit, self.settings)
        if not sentence:
            return refinement
        self.notes.append(sentence)
        return self._refit(refinement.with_hold(hold))

    def settle(self) -> None:
        """Fit each model once more, on all that was not kept to judge; of a long record only the last."""
        first = 0 if self.parts.whole else len(self.steps) - 1
        for i, step in enumerate(self.steps):
            other = _other_name(step)
            if step.effect is not None and other is not None:
                self.steps[i] = replace(step, rivals=(*step.rivals, other))
                self.notes.append(
                    f"{step.effect.label} with the constant offset is {other.label} by another name: "
                    "the record cannot tell them apart."
                )
        for i in self.progress.over(range(first, len(self.steps)), "last fits"):
            step = self.steps[i]
            refinement = refit(step.refinement, self.parts.learn, elsewhere=False, **self.settings)
            if not np.isfinite(_log_error(refinement, self.parts.choose, self.horizon)):
                continue
            self.steps[i] = self._step(step.effect, step.action, refinement, step.verdict, step.rivals)

    def _pair(
        self, race: Race | None, rest: list[Effect], options: dict[str, Any]
    ) -> tuple[list[Effect], Refinement] | None:
        """Two effects that help only together: every second one behind each of the best first ones."""
        if race is None:
            return None
        before = _log_error(self.current, self.parts.choose, self.horizon)
        best, gained = None, _GAIN
        for one, first in race.in_free_run(_PAIRS_FROM):
            others = [effect for effect in rest if not _same(effect, one)]
            _, second = self._investigate(first, others, options) if others else (None, None)
            for two, both in second.in_free_run(_TRIED) if second is not None else []:
                size = len(_coefficients(one, both)) + len(_coefficients(two, both))
                share = (before - _log_error(both, self.parts.choose, self.horizon)) / max(size, 1)
                if share > gained:
                    best, gained = ([one, two], both), share
        if best is None:
            return None
        effects, both = best
        return effects, self._refit(both)

    # ---------------------------------------------------------------------- ledger
    def _step(
        self,
        effect: Effect | None,
        action: str,
        refinement: Refinement,
        verdict: str,
        rivals: tuple[Effect, ...],
    ) -> Step:
        return Step(
            effect=effect,
            action=action,
            train_rmse=refinement.rmse.copy(),
            choice_rmse=_rmse(refinement, self.parts.choose, self.horizon),
            validation_rmse=_rmse(refinement, self.parts.judge, self.horizon),
            coefficients={} if effect is None else _coefficients(effect, refinement),
            std={} if effect is None else _coefficients(effect, refinement, "std"),
            verdict=verdict,
            rivals=rivals,
            refinement=refinement,
        )


def _same(one: Effect, two: Effect) -> bool:
    return one.kind == two.kind and one.place == two.place


def _other_name(step: Step) -> Effect | None:
    """Asymmetric friction for Coulomb friction where a constant offset acts at the same place."""
    effect, held = step.effect, step.refinement
    if effect is None or effect.kind != "coulomb_friction" or step.action == "drop":
        return None
    linear = held.physical_model.linear
    act = held.physical_model.port(effect.place).act
    for offset, role in zip(held.effects, held.roles, strict=True):
        if role != "offset":
            continue
        if offset.kind == "input_offset":
            push = np.asarray(linear.B)[:, linear.input_labels.index(offset.place)]
        elif offset.kind == "constant_force":
            push = held.physical_model.port(offset.place).act
        else:
            continue
        if abs(push @ act) > (1 - 1e-9) * np.linalg.norm(push) * np.linalg.norm(act):
            other = Effect("asymmetric_friction", effect.place)
            return None if any(_same(other, e) for e in (*held.effects, *step.rivals)) else other
    return None


def _far_from_home(refinement: Refinement) -> float:
    """Relative distance of the linear parameters from the model's own numbers."""
    moved = [
        abs(row.value - row.initial) / abs(row.initial)
        for row in refinement.parameters
        if row.role == "linear" and row.initial
    ]
    return float(np.sqrt(np.mean(np.square(moved)))) if moved else 0.0


def _coefficients(effect: Effect, refinement: Refinement, what: str = "coefficient") -> dict[str, float]:
    """Coefficients of an effect in a model, or their standard deviations; none where it was dropped."""
    own = [row for row in refinement.parameters if row.kind == effect.kind and row.place == effect.place]
    names = [n for n in effect.coefficients if n not in effect.fixed]
    return {n: float(getattr(row, what)) for n, row in zip(names, own, strict=True)} if own else {}


def _split(records: list[Measurement], validation: Measurement | None) -> _Parts:
    """Fit, choose, judge: in the order of time, each record for itself."""
    fit, choose, judge, learn = [], [], [], []
    for record in records:
        if record.n_samples < 100:
            raise DataError(f"a record of {record.n_samples} samples is too short to be split in three")
        if validation is None:
            both, last = record.split(_FIT + _CHOOSE)
            judge.append(last)
        else:
            both = record
        first, second = both.split(_FIT / (_FIT + _CHOOSE))
        fit.append(first)
        choose.append(second)
        learn.append(both)
    climbed, whole = _excerpt(fit), sum(record.n_samples for record in fit)
    remarks: tuple[str, ...] = ()
    if climbed is not fit:
        remarks = (
            f"The record is long: effects were sought on {len(climbed)} pieces spread over it "
            f"({sum(record.n_samples for record in climbed)} of {whole} samples); the last model was fitted "
            "once more on all that does not judge.",
        )
    return _Parts(climbed, choose, [validation] if validation is not None else judge, learn, remarks)


def _excerpt(records: list[Measurement]) -> list[Measurement]:
    """Pieces spread over records that are too long to climb on."""
    if sum(record.n_samples for record in records) <= _EXCERPT:
        return records
    spread = np.unique(np.linspace(0, len(records) - 1, min(len(records), _MOST_RECORDS)).astype(int))
    each = _EXCERPT // spread.size
    pieces = []
    for record in (records[int(i)] for i in spread):
        count = min(_PIECES, max(1, each // _SHORTEST))
        length = each // count
        if record.n_samples <= each:
            pieces.append(record)
            continue
        for start in np.linspace(0, record.n_samples - length, count).astype(int):
            pieces.append(record._part(slice(int(start), int(start) + length)))
    return pieces


def _errors(refinement: Refinement, records: Sequence[Measurement], horizon: float | None) -> Array:
    """Free-run residual on all records, (n_y, N), in the windows that `compare` chooses."""
    linear = refinement.physical_model.linear
    found = []
    for record in records:
        ordered = record_for(record, match_channels(linear, record))
        try:
            residual = compare(refinement, ordered, horizon=horizon).residual
        except DivergenceError:
            return np.full((linear.n_outputs, 1), np.inf)
        found.append(np.atleast_2d(residual))
    return np.concatenate(found, axis=1)


def _rmse(refinement: Refinement, records: Sequence[Measurement], horizon: float | None) -> Array:
    return np.asarray(np.sqrt(np.mean(_errors(refinement, records, horizon) ** 2, axis=1)))


def _log_error(refinement: Refinement, records: Sequence[Measurement], horizon: float | None) -> float:
    """Mean over the outputs of the log error."""
    return float(np.mean(np.log(_rmse(refinement, records, horizon) + 1e-300)))
