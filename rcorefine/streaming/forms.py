"""Forms of the refined model on one stream, with the paper's stage 1.

Each form is judged by what it predicts, never by what it was fitted to: its model is frozen, then simulated
over the stretch that follows (Dawid's prequential principle, J. Royal Statistical Soc. A 147 (1984) 278).
The initial model is judged with them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..engine.linear import recursion
from ..exceptions import DivergenceError, RCOError
from ..inference.covariance import standard_deviations
from ..systems.conversion import growth, nearest_continuous, stabilized, to_discrete
from ..systems.linear import Array, LinearModel
from ..systems.response import frequency_response
from .families import MILESTONES, Family
from .filter import BlockCourse, BlockFilter, FilterState
from .history import PARAMETERS, CoefficientHistory, Summary, joined, pole_samples, poles_of, rates
from .paper import PaperStages
from .persistence import check_course, check_like, check_range, storable
from .samples import Block, Complex

INITIAL = "initial"
_WILD = "!"  # after the name of a form: its model as it is, however fast it grows
_FIRST, _LONGEST = 32, 2048  # samples of the first stretch, and of the longest
_ALIKE = 1.02  # in mean square: the form that stands first is taken
_LOST = 4.0  # times the best mean square, on two stretches in a row: the form stops
_LATE = 1024  # samples before which none stops for being worse
_CLEARLY = 0.5  # of the mean square of the best stable model: what an unstable one must reach to be taken
_WINDOW = 3.0  # growth of an unstable initial model, in powers of e, after which its free run starts anew


@dataclass(frozen=True, slots=True, eq=False)
class Frozen:
    """Model frozen before a stretch.

    `raw` is true if it grows faster than the limit set by the initial model.
    """

    name: str
    model: LinearModel
    raw: bool


@dataclass(frozen=True, slots=True, eq=False)
class FormsState:
    """State of the forms between two blocks.

    Parameters
    ----------
    filters : dict
        State of each filter by the name of its form.
    waiting : Block
        Samples of a block that is not complete.
    frozen : tuple of Frozen
        Models that the present stretch judges.
    stretch : Block
        The present stretch so far.
    scores : dict
        Mean square over the variance of the outputs by each judged model, on the last whole stretch.
    chosen : tuple of str and bool
        Form that won it, and whether an unstable model of it did.
    behind : dict
        Stretches in a row that a form was far behind on.
    stopped : dict
        Why a form stopped, by its name.
    length : int
        Samples of the last whole stretch.
    n_learned : int
        Samples in whole blocks.
    silent : str
        Why stage 1 does not run, "" where it does.
    """

    filters: dict[str, FilterState]
    waiting: Block
    frozen: tuple[Frozen, ...]
    stretch: Block
    scores: dict[str, float]
    chosen: tuple[str, bool]
    behind: dict[str, int]
    stopped: dict[str, str]
    length: int
    n_learned: int
    silent: str


storable(Frozen, FormsState)
#: Arrays of a file that may have other rows than fresh ones.
_ROWS = {
    **dict.fromkeys(("inputs", "outputs", "known", "use"), "samples"),
    **{name: name for name in ("before", "left", "widths")},
}


class Forms:
    """Filters on the same samples, and the paper's stage 1 beside them.

    Parameters
    ----------
    families : dict of str to Family
        Forms by their names, the one that is taken where two are alike first. Several, or one and "initial",
        compete; a single one does not.
    first : PaperStages or None
        Stage 1, None where it does not run.
    keep : bool
        Whether to keep the course of every sample.
    silent : str
        Why stage 1 does not run, "" where that was asked for.
    """

    def __init__(
        self, families: dict[str, Family], first: PaperStages | None, keep: bool, silent: str
    ) -> None:
        self.filters = {name: BlockFilter(family) for name, family in families.items()}
        self.first, self.keep, self._silent = first, keep, silent
        self._competing = len(families) > 1
        some = next(iter(families.values()))
        self.model, self.settings = some.model, some.settings
        rate = growth(to_discrete(self.model, self.settings.dt, self.settings.hold))
        # growth that a refined model may have, per sample: none where the initial model is stable
        self._limit = np.inf
        if rate <= 1e-9:
            self._limit = 1e-9 if rate > -1e-9 else 1e-3 * max(rate, -1.0)
        # an unstable initial model is simulated over short windows, each with a fitted initial state
        self._window = max(int(_WINDOW / rate), 8) if rate > 1e-6 else 0
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        states = {name: one.begin() for name, one in self.filters.items()}
        nothing = next(iter(states.values())).first
        form = INITIAL if self._competing else next(iter(states))
        self.state_ = FormsState(states, nothing, (), nothing, {}, (form, False), {}, {}, 0, 0, self._silent)
        self.records: dict[str, list[tuple[BlockCourse, Array]]] = {name: [] for name in states}
        self._waiting: list[Block] = []
        self._count = 0  # samples that wait
        self._ahead: list[Block] = []  # samples that stage 1 has not seen
        if self.first is not None:
            self.first.reset()

    # -- samples in ----------------------------------------------------------------------------------

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return self.n_learned + self._count

    @property
    def n_learned(self) -> int:
        """Samples in whole blocks, which the model is learned from."""
        return self.state_.n_learned

    def _end(self, n: int) -> int:
        """Sample at which the block that begins at `n` ends."""
        size = self.settings.block
        return next(end for end in (_FIRST, 2 * _FIRST, n - n % size + size) if end > n)

    def take(self, block: Block, *, keep_sound: bool = False) -> None:
        """Learn from a block: all of it or nothing.

        Samples wait until their block is whole, so that it makes no difference how a stream is cut.
        """
        if self.n_samples + len(block.inputs) < self._end(self.n_learned):
            self._waiting.append(block)
            self._ahead.append(block)
            self._count += len(block.inputs)
            return
        whole, state, position = Block.joined([*self._waiting, block]), self.state_, 0
        records: dict[str, list[tuple[BlockCourse, Array]]] = {name: [] for name in self.filters}
        while (size := self._end(state.n_learned) - state.n_learned) <= len(whole.inputs) - position:
            state = self._step(state, whole.part(position, position + size), records)
            position += size
        self._ahead.append(block)
        self.state_, self._waiting = state, [whole.part(position, len(whole.inputs))]
        self._count = len(whole.inputs) - position
        for name, found in records.items() if self.keep else ():
            self.records[name] += found
        self._stage_one()

    def _stage_one(self) -> PaperStages | None:
        """Stage 1, once it has learned from all samples."""
        if self.first is not None and self._ahead and not self.state_.silent:
            try:
                self.first.take(Block.joined(self._ahead), keep_sound=True)
            # stage 1 may stop; the static stage goes on without it
            except RCOError as error:
                self.state_ = replace(self.state_, silent=f"Stage 1 stopped: {error}")
        self._ahead = []
        return self.first

    def finish(self) -> None:
        """Learn from what waits for the first fit, however short."""
        state = self.state_
        if state.n_learned == 0 and self._waiting:
            whole = Block.joined(self._waiting)
            if len(whole.inputs) > self.model.n_states + 2:
                records: dict[str, list[tuple[BlockCourse, Array]]] = {name: [] for name in self.filters}
                state = self._step(state, whole, records)
                self._waiting, self._count = [], 0
        filters = {name: one.finish(state.filters[name]) for name, one in self.filters.items()}
        self.state_ = replace(state, filters=filters)
        if (first := self._stage_one()) is not None and not self.state_.silent:
            first.finish()

    def _step(self, state: FormsState, block: Block, records: dict[str, Any]) -> FormsState:
        """State after one block."""
        filters, stopped = dict(state.filters), dict(state.stopped)
        outputs = np.where(block.use, block.outputs, np.nan)
        for name in self._running(state):
            # the initial model has no coefficients: its state is needed where it is the best
            if name == INITIAL and state.chosen[0] != INITIAL and self._competing and not self.keep:
                continue
            try:
                filters[name], course = self.filters[name].step(filters[name], block, course=self.keep)
            except DivergenceError as error:
                if not self._competing or name == INITIAL:
                    raise
                stopped[name] = f"diverged: {str(error).split(';')[0]}"
                continue
            if course is not None:
                records[name].append((course, outputs))
        n = state.n_learned + len(block.inputs)
        state = replace(state, filters=filters, stopped=stopped, n_learned=n)
        return self._follow(state, block) if self._competing else state

    def _follow(self, state: FormsState, block: Block) -> FormsState:
        """Go on with the comparison by a block that was learned."""
        state = replace(state, stretch=Block.joined([state.stretch, block]))
        # samples since a form began anew: what was frozen before says nothing of it
        begun = [state.filters[name].begun for name in self._running(state) if name != INITIAL]
        age = state.n_learned - max(begun, default=0)
        if not age:
            nothing = block.part(0, 0)
            return replace(state, frozen=(), stretch=nothing, scores={}, behind={}, chosen=(INITIAL, False))
        return self._judge(state) if age in MILESTONES or age % _LONGEST == 0 else state

    def _running(self, state: FormsState) -> list[str]:
        return [name for name in self.filters if name not in state.stopped]

    # -- comparison ----------------------------------------------------------------------------------

    def _judge(self, state: FormsState) -> FormsState:
        """Judge the forms at the end of a stretch, and freeze their models."""
        running, stopped = self._running(state), dict(state.stopped)
        if state.frozen:
            chosen, scores = self._compare(state)
            best, behind = min(scores.values()), dict.fromkeys(running, 0)
            for name in running:
                own = min((s for key, s in scores.items() if key.removesuffix(_WILD) == name), default=np.inf)
                if name != INITIAL and own > _LOST * best and state.n_learned > _LATE:
                    behind[name] = state.behind.get(name, 0) + 1
                if behind[name] >= 2:
                    stopped[name] = f"fitted much worse after {state.n_learned} samples"
            length = len(state.stretch.inputs)
            state = replace(state, chosen=chosen, scores=scores, behind=behind, length=length)
        frozen = self._freeze(state, stopped)
        initial = state.filters[INITIAL]
        if not self.keep and state.chosen[0] == INITIAL:
            initial = self._started(state)
        elif not self.keep:
            initial = self.filters[INITIAL].begin(state.n_learned)
        filters, nothing = state.filters | {INITIAL: initial}, state.stretch.part(0, 0)
        return replace(state, filters=filters, frozen=tuple(frozen), stretch=nothing, stopped=stopped)

    def _freeze(self, state: FormsState, stopped: dict[str, str]) -> list[Frozen]:
        """Present models of the forms that go on; others enter `stopped`."""
        frozen = []
        for name in [name for name in self.filters if name not in stopped]:
            model = self._discrete(self._form_system(state, name, name))
            if not np.isfinite(model.A).all():
                stopped[name] = f"had no finite model after {state.n_learned} samples"
                continue
            # with poles that grow too fast pulled back; the model as it is takes part, too
            calm = stabilized(model, self._limit)
            frozen.append(Frozen(name, calm, False))
            if calm is not model:
                frozen.append(Frozen(name, model, True))
        return frozen

    def _started(self, state: FormsState) -> FilterState:
        """State of the initial model, from the stretch where it did not run."""
        one, found = self.filters[INITIAL], state.filters[INITIAL]
        enough = len(state.stretch.inputs) > one.n + 2 and state.stretch.known.all()
        return one.fit(found, state.stretch) if found.rounds == 0 and enough else found

    def _compare(self, state: FormsState) -> tuple[tuple[str, bool], dict[str, float]]:
        """Which form predicted the present stretch best, and the scores of all."""
        _, outputs, _, use = stretch = state.stretch
        # weight each output by its standard deviation
        spread = np.ma.filled(np.ma.masked_array(outputs, use == 0).var(axis=0), 0.0)
        weights = 1.0 / np.sqrt(np.where(spread > 0, spread, 1.0))
        calm: dict[str, float] = {}
        wild: dict[str, float] = {}
        for frozen in state.frozen:
            score = free_run_cost(frozen.model, stretch, weights, self._window)
            (wild if frozen.raw else calm)[frozen.name] = score if np.isfinite(score) else np.inf
        # the first form within 2 % of the best; the initial model unless a form beats it
        best, name = min(calm.values()), INITIAL
        if best < calm[INITIAL]:
            name = next(key for key, score in calm.items() if score <= _ALIKE * best)
        scores = calm | {key + _WILD: score for key, score in wild.items()}
        # an unstable model only if it halves the mean square error
        unstable = min(wild, key=lambda key: wild[key], default=None)
        if unstable is not None and wild[unstable] < _CLEARLY * calm[name]:
            return (unstable, True), scores
        return (name, False), scores

    @property
    def _chosen(self) -> tuple[str, bool]:
        """Form that predicts best, and whether its model may grow."""
        # the present stretch decides once it has a quarter of its length
        state = self.state_
        if state.frozen and len(state.stretch.inputs) >= max(state.length, _FIRST) // 4:
            return self._compare(state)[0]
        return state.chosen

    @property
    def form(self) -> str:
        """Form that predicts best."""
        return self._chosen[0]

    @property
    def scores(self) -> dict[str, float]:
        """Fit in % of each form's free run on the last stretch it had not seen."""
        return {name: float(100.0 * (1.0 - np.sqrt(s))) for name, s in self.state_.scores.items()}

    # -- results -------------------------------------------------------------------------------------

    def _form_system(self, state: FormsState, form: str, name: str) -> LinearModel:
        one, now = self.filters[form], state.filters[form]
        if now.rounds == 0:
            return self.model.with_arrays(name=name)
        return one.family.system(now.z[one.n :], name)

    def _discrete(self, model: LinearModel) -> LinearModel:
        return to_discrete(model, self.settings.dt, self.settings.hold)

    def _own_system(self, name: str) -> LinearModel:
        """Best model in its own timebase; it grows only where data support it."""
        form, grows = self._chosen
        model = self._form_system(self.state_, form, name)
        if not self._competing or grows:
            return model
        return stabilized(model, self._limit / (self.settings.dt if model.is_continuous else 1.0))

    def system(self, name: str) -> LinearModel:
        """Refined model, continuous where the initial one is."""
        model = self._own_system(name)
        return nearest_continuous(model) if self.model.is_continuous and not model.is_continuous else model

    def discrete_system(self, name: str) -> LinearModel:
        """Refined model in discrete time."""
        return self._discrete(self._own_system(name))

    def _best(self) -> tuple[BlockFilter, FilterState]:
        form, state = self.form, self.state_
        return self.filters[form], self._started(state) if form == INITIAL else state.filters[form]

    def estimate(self) -> tuple[Array, Array]:
        """Coefficients and their covariance, in the model's time domain."""
        one, state = self._best()
        return one.family.translated(state.z[one.n :].copy(), one.covariance(state))

    @property
    def parameters(self) -> tuple[Any, ...]:
        """Estimated parameters, one row each."""
        theta, covariance = self.estimate()
        return self._best()[0].family.rows(theta, standard_deviations(covariance))

    @property
    def covariance(self) -> Array:
        """Covariance of the coefficients."""
        return self.estimate()[1]

    def static_theta(self) -> Array:
        """Static coefficients, shape (1, p)."""
        return self.estimate()[0][None]

    def standard_deviations(self) -> Array:
        """Standard deviations of the static coefficients, shape (1, p)."""
        return standard_deviations(self.covariance)[None]

    @property
    def scales(self) -> Any:
        """Sizes that stage 1 divides signals by."""
        return None if (first := self._stage_one()) is None else first.scales

    def dynamic_theta(self) -> Array:
        """Coefficients of stage 1."""
        return np.zeros((0, 0)) if (first := self._stage_one()) is None else first.dynamic_theta()

    def predict(self, inputs: Array) -> Array:
        """Free run on further inputs of shape (N, n_w); outputs of shape (n_y, N)."""
        one, state = self._best()
        waiting = Block.joined(self._waiting) if self._waiting else self.state_.waiting
        return np.ascontiguousarray(one.predict(state, waiting, inputs).T)

    def deviation(self) -> Callable[[Array], Array] | None:
        """Standard deviation of the refined response, a function of frequency."""
        one, state = self._best()
        around = _variants(one, state)
        return (
            partial(_response_deviation, one.family.system(state.z[one.n :], ""), around) if around else None
        )

    def history(self) -> CoefficientHistory:
        """Course of both stages; samples that wait are the last block."""
        form = self.form
        one, state, records = self.filters[form], self.state_.filters[form], list(self.records[form])
        if waiting := [block for block in self._waiting if len(block.inputs)]:
            block = Block.joined(waiting)
            course = one.unlearned(state, block)
            if state.rounds:  # predicted from the last block on, not learned from
                ahead = one.predict(state, block.part(0, 0), block.inputs)
                course = course._replace(predicted=np.where(block.use, ahead, np.nan))
            records.append((course, np.where(block.use, block.outputs, np.nan)))
        y = joined([y for _, y in records], (self.model.n_outputs,))
        total, first = y.shape[1], self._stage_one()
        stage = None if first is None else first.history()

        def beside(values: Array | None, rows: int) -> Array:
            values = np.zeros((rows, 0)) if values is None else values[:, :total]
            # NaN after the sample at which stage 1 stopped
            return np.pad(values, ((0, 0), (0, total - values.shape[1])), constant_values=np.nan)

        theta = joined([course.theta for course, _ in records], (state.centre.size,))
        timepts = np.arange(total, dtype=np.float64) * self.settings.dt
        at = pole_samples(total)
        names = one.family.labels
        return CoefficientHistory(
            timepts=timepts,
            coefficients=theta,
            poles=poles_of([one.family.system(theta[:, k], "") for k in at], self.settings.dt),
            pole_timepts=timepts[at],
            z1=beside(None if stage is None else stage.z1, len(y)),
            z2=joined([course.predicted for course, _ in records], (len(y),)) - y,
            x_D=beside(None if stage is None else stage.x, self.model.n_states),
            x=joined([course.x for course, _ in records], (one.n,)),
            y=y,
            names=tuple(f"discrete {name}" for name in names) if one.family.translates else names,
            output_labels=self.model.output_labels,
        )

    def summary(self) -> Summary:
        """Cells and sentences of `str`."""
        self._stage_one()
        (form, grows), state = self._chosen, self.state_
        one, now = self.filters[form], state.filters[form]
        what = f"form {form!r} of the static stage" if self._competing else f"{now.centre.size} coefficients"
        title = f"RCORefiner of {self.model.name!r}: {what}, dt = {self.settings.dt:g} s"
        age = self.n_samples - state.n_learned
        notes = [f"{self.n_samples} samples taken; the model is that of {age} samples ago."]
        if self._competing and state.scores:
            shown = ", ".join(
                f"{name.rstrip(_WILD)}{' (unstable)' if name.endswith(_WILD) else ''} {score:.4g} %"
                for name, score in self.scores.items()
            )
            notes.append(
                f"Chosen by the fit of each form's simulation (free run) over {state.length} held-out "
                f"samples: {shown}."
            )
        elif self._competing:
            notes.append("No form has been compared yet: the refined model is the initial one.")
        if grows:
            notes.append("The refined model is unstable, and the data clearly support this.")
        notes += [f"{name} {why}; it is no longer compared." for name, why in state.stopped.items()]
        if form != INITIAL:
            notes += _notes(one, now)
        if state.silent:
            notes.append(state.silent.split(";")[0] + "; the static stage does not need it.")
        return Summary(title, PARAMETERS, [row.cells for row in self.parameters], notes)

    def state(self) -> dict[str, Any]:
        """All that is remembered, for a file."""
        # as many rows as a block has, so that files do not grow and shrink
        waiting = Block.joined([self.state_.waiting, *self._waiting])
        empty = Block(*(np.zeros((2 * _FIRST - len(part), *part.shape[1:]), part.dtype) for part in waiting))
        first = None if (first := self._stage_one()) is None else first.state()
        count = len(waiting.inputs)
        return {
            "forms": replace(self.state_, waiting=Block.joined([waiting, empty])), "count": count,
            "records": self.records, "first": first,
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave."""
        forms, count = state["forms"], state["count"]
        self._check(forms)
        check_range(count, 0, len(forms.waiting.inputs), "samples that wait")
        for name, one in self.filters.items():
            p = len(one.begin().centre)
            rows = BlockCourse(*(np.zeros((0, size)) for size in (p, one.n, one.ny)))
            check_course(state["records"][name], rows, one.ny)
        self.records = state["records"]
        self.state_ = replace(forms, waiting=forms.waiting.part(0, 0))
        self._waiting, self._ahead, self._count = [forms.waiting.part(0, count)], [], count
        if self.first is not None:
            self.first.restore(state["first"])

    def _check(self, found: FormsState) -> None:
        """Hold what a file held against a fresh state: kernels trust shapes."""
        fresh, like = self.state_, self._discrete(self.model)
        check_like(found.stretch, fresh.stretch, "stretch", _ROWS)
        check_like(found.waiting, fresh.stretch, "waiting", _ROWS)
        check_like((found.length, found.n_learned), (0, 0), "counts")
        for frozen in found.frozen:
            m = frozen.model
            check_like((m.A, m.B, m.C, m.D), (like.A, like.B, like.C, like.D), f"model of {frozen.name}")
        for name, one in self.filters.items():
            now, own, unknown = found.filters[name], one.begin(), np.full((1, one.ny), np.nan)
            sizes = [np.shape(part)[-1] if np.ndim(part) == 2 else 0 for part in (now.L, now.filters)]
            inner = one.family.structure(np.zeros(0)).n_ports + one.ny
            own = own._replace(
                L=np.zeros((len(own.z), sizes[0])), filters=np.ones((one.ny, sizes[1])), left=unknown,
                inner=np.zeros(inner if np.size(now.inner) else 0), widths=unknown[0],
            )  # fmt: skip
            check_like(now, own, f"filter of {name}", _ROWS)


def free_run_cost(model: LinearModel, stretch: Block, weights: Array, window: int) -> float:
    """Return the weighted mean square simulation error of a frozen model.

    The initial state is fitted.

    Parameters
    ----------
    model : LinearModel
        Discrete model.
    stretch : Block
        Samples that it has not seen.
    weights : ndarray, shape (ny,)
        One over the size of each output.
    window : int
        Samples after which the run starts anew with a state of its own, 0 for never.
    """
    A, B, C, D = model.A, model.B, model.C, model.D
    W, Y, _, use = stretch
    n, N, total = len(A), len(W), 0.0
    start = np.eye(n, n + 1, 1)  # the run from rest, then the response to each entry of the state
    for a in range(0, N, window or N):
        b = min(a + (window or N), N)
        # simulate from rest and from each unit initial state at once
        pushes = np.zeros((n, b - a - 1, n + 1))
        with np.errstate(all="ignore"):  # a model that blows up costs an infinity
            pushes[:, :, 0] = B @ W[a : b - 1].T
            # outputs of both, weighted by use and size
            states = np.concatenate([start[:, None], recursion(A, start, pushes)], axis=1)
            seen = np.tensordot(C, states, 1)
            scale = (use[a:b] * weights).T
            error = np.where(use[a:b], Y[a:b], 0.0).T - seen[:, :, 0] - D @ W[a:b].T
            error, columns = (scale * error).ravel(), scale[:, :, None] * seen[:, :, 1:]
            columns = columns.reshape(error.size, n)
            # normal equations for the initial state
            H, g, square = columns.T @ columns, columns.T @ error, float(error @ error)
        if not (np.isfinite(H).all() and np.isfinite(square)):
            return np.inf
        # least squares for the state at the start of the window, each column of unit size
        size = np.sqrt(np.diag(H))
        unit = np.divide(1.0, size, out=np.zeros(n), where=size > 0)
        normal = H * np.outer(unit, unit) + np.diag(np.where(size > 0, 1e-10, 1.0))
        total += max(square - float(unit * g @ np.linalg.solve(normal, unit * g)), 0.0)
    return total / max(float(use.sum()), 1.0)


# Of a standard deviation: to first order, for directions that no sensor sees (a change of
# coordinates) have deviations that are large, and would bend the response.
_SHARE = 1e-4


def _variants(one: BlockFilter, state: FilterState) -> list[LinearModel]:
    """Models that deviate slightly, one along each independent direction."""
    theta, covariance = state.z[one.n :], one.covariance(state)
    if state.rounds == 0 or not covariance.size:
        return []
    # correlation first: coefficients of unlike size would hide one another
    size = standard_deviations(covariance)
    scale = np.where(size > 0, size, 1.0)
    values, directions = np.linalg.eigh(covariance / np.outer(scale, scale))
    # one standard deviation along each, in units of the coefficients
    steps = (directions * np.sqrt(np.maximum(values, 0.0))).T * scale
    return [one.family.system(theta + _SHARE * step, "variant") for step in steps if step.any()]


def _response_deviation(center: LinearModel, around: Sequence[LinearModel], omega: Array) -> Array:
    """Standard deviation of the frequency response, (n_y, n_w, K).

    It is NaN beyond the Nyquist frequency.
    """
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


# -- sentences -------------------------------------------------------------------------------------


_UNLEARNED = 0.5  # of its prior deviation: a coefficient that is no better known has not been seen
_UNEXPLAINED = 0.3  # of the rms of an output left in the residual: the effects do not explain it
_APART = 0.995  # correlation of two estimates that the sensors can hardly tell apart


def _notes(one: BlockFilter, state: FilterState) -> list[str]:
    """Sentences about the coefficients."""
    if state.rounds == 0:
        return ["The first samples are held back until the size of the signals is known."]
    family, level = one.family, np.sqrt(np.nan_to_num(np.nanmean(state.left**2, axis=0)))
    levels = ", ".join(f"{label} {x:.3g}" for label, x in zip(family.model.output_labels, level, strict=True))
    of = _pole_caution, _bound_caution, _doubt_cautions, _error_cautions
    return [
        "std is the standard deviation of the value at this sample. Residual of the simulation (rms): "
        f"{levels}.",
        *(sentence for caution in of for sentence in caution(one, state)),
    ]


def _doubt_cautions(one: BlockFilter, state: FilterState) -> list[str]:
    """Coefficients that the samples do not determine, or not one by one."""
    found, names = [], np.array(one.family.labels, dtype=object)
    P = state.L[one.n :] @ state.L[one.n :].T
    std = standard_deviations(P)
    # held: the prior fixes more than the data determine
    together = names[np.diag(state.held) > std**2]
    if together.size:
        found.append(
            f"Determined only together: {', '.join(together)}. What no sample changes is held "
            "at the initial model, and std is that of its prior."
        )
    # not excited: the posterior deviation is close to the prior
    blind = names[std > _UNLEARNED * state.spread]
    if blind.size:
        found.append(f"Not excited: the samples hardly determine {', '.join(blind)}; excite or omit it.")
    # nearly collinear estimates
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = np.argwhere(np.tril(np.abs(P) / np.outer(std, std) > _APART, -1))
    if alike.size:
        pairs = "; ".join(f"{names[i]} and {names[j]}" for i, j in alike[:3])
        found.append(f"Hardly distinguished by these sensors: {pairs}.")
    return found


def _error_cautions(one: BlockFilter, state: FilterState) -> list[str]:
    """Residuals above the declared noise, or above a share of the signal."""
    found, level = [], np.sqrt(np.nan_to_num(np.nanmean(state.left**2, axis=0)))
    rows = zip(one.family.model.output_labels, level, state.sizes, one.settings.noise, strict=True)
    for label, left, whole, declared in rows:
        error = f"Not explained: the prediction error of {label} is"
        if declared > 0 and left > 2.0 * declared:
            found.append(
                f"{error} {left:.3g}, the declared noise {declared:.3g}. An effect is missing or at another "
                "place."
            )
        elif declared == 0 and left > _UNEXPLAINED * whole:
            found.append(
                f"{error} {100 * left / whole:.3g} % of its rms. Unless this is noise, an effect is missing "
                "or at another place (rcorefine.diagnose ranks the candidates)."
            )
    return found


def _pole_caution(one: BlockFilter, state: FilterState) -> list[str]:
    """Poles that became unstable, or are too slow for the stream."""
    family, dt = one.family, one.settings.dt
    before = rates(family.model, dt).real.max(initial=-np.inf)
    poles: Complex = rates(family.system(state.z[one.n :], "refined"), dt)
    if not poles.size:
        return []
    worst, size = poles[np.argmax(poles.real)], np.abs(poles[np.isfinite(poles)]).max(initial=0.0)
    if worst.real > max(before, 0.0) + 1e-9 * size:
        return [
            f"Unstable: the refined model has a pole at {worst:.4g} rad/s. A wrong place or a missing effect "
            "can cause it."
        ]
    length = (state.n_samples - state.begun) * dt
    if 0 < -worst.real * length < 1.0:
        return [
            f"Not decayed: the slowest mode has a time constant of {-1 / worst.real:.3g} s and the stream is "
            f"{length:.3g} s long. The unknown initial state still affects the coefficients."
        ]
    return []


def _bound_caution(one: BlockFilter, state: FilterState) -> list[str]:
    theta, (lower, upper) = state.z[one.n :], one.family.bounds
    held = np.array(one.family.labels, dtype=object)[((theta <= lower) | (theta >= upper)) & (theta != 0)]
    return [f"At its bound: {', '.join(held)}."] if held.size else []
