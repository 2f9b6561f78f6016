"""Several forms of the static correction side by side on one stream.

The initial model is one of them.

Each is judged by what it predicts, never by what it was fitted to: its model is frozen, then simulated
over the stretch that follows (Dawid's prequential principle, J. Royal Statistical Soc. A 147 (1984) 278).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..engine.linear import recursion
from ..exceptions import DataError, DivergenceError
from ..systems.conversion import growth, stabilized, to_discrete
from ..systems.linear import Array, LinearModel
from .coefficients.entries import MILESTONES
from .coefficients.setup import CoefficientFilter, CoefficientSetup
from .history import PARAMETERS, Summary
from .persistence import check_like, storable
from .samples import Block, Flags

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
class FilterBankMemory:
    """State of the competing forms between two calls.

    Parameters
    ----------
    frozen : tuple of Frozen
        Models that the present stretch judges.
    inputs, outputs, use : ndarray of shape (K, n_w), (K, n_y), (K, n_y)
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
    n_samples : int
        Samples taken.
    """

    frozen: tuple[Frozen, ...]
    inputs: Array
    outputs: Array
    use: Flags
    scores: dict[str, float]
    chosen: tuple[str, bool]
    behind: dict[str, int]
    stopped: dict[str, str]
    length: int
    n_samples: int


storable(Frozen, FilterBankMemory)


class FilterBank:
    """Forms of a static correction that compete, and the initial model.

    Parameters
    ----------
    setups : mapping of str to CoefficientSetup
        Forms by their names, the one that is taken where two are alike first.
    initial : CoefficientSetup
        The initial model, without coefficients.
    keep : bool
        Whether to keep the course of every sample.
    """

    def __init__(self, setups: dict[str, CoefficientSetup], initial: CoefficientSetup, keep: bool) -> None:
        self.filters = {name: CoefficientFilter(setup, keep) for name, setup in setups.items()}
        self.filters[INITIAL] = CoefficientFilter(initial, keep)
        self._model = self.filters[INITIAL].discrete_system("initial")
        rate = growth(self._model)
        # growth that a refined model may have, per sample: none where the initial model is stable
        self._limit = np.inf
        if rate <= 1e-9:
            self._limit = 1e-9 if rate > -1e-9 else 1e-3 * max(rate, -1.0)
        # an unstable initial model is simulated over short windows, each with a fitted initial state
        self._window = max(int(_WINDOW / rate), 8) if rate > 1e-6 else 0
        outputs = np.zeros((0, self._model.n_outputs))
        self._nothing = np.zeros((0, self._model.n_inputs)), outputs, outputs.astype(np.uint8)
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        for form in self.filters.values():
            form.reset()
        self.memory = FilterBankMemory((), *self._nothing, {}, (INITIAL, False), {}, {}, 0, 0)

    @property
    def n_samples(self) -> int:
        """Samples taken."""
        return self.memory.n_samples

    @property
    def running(self) -> list[str]:
        """Forms that have not stopped."""
        return [name for name in self.filters if name not in self.memory.stopped]

    @contextmanager
    def all_or_nothing(self) -> Iterator[None]:
        """Undo what the forms learned where not all of them could."""
        before = self.memory
        with ExitStack() as forms:
            for form in self.filters.values():
                forms.enter_context(form.all_or_nothing())
            try:
                yield
            except BaseException:
                self.memory = before
                raise

    def take(self, block: Block, *, predict: bool = False) -> Array:
        """Learn from a block, and predict its outputs if asked.

        With `predict`, return what the best form expected one sample ahead.
        """
        position, total = 0, len(block.inputs)
        expected = np.full(block.outputs.shape if predict else (0, 0), np.nan)
        while position < total:
            # up to the end of the present stretch: the milestones, then every 2,048 samples
            last = (self.n_samples // _LONGEST + 1) * _LONGEST
            end = next((end for end in MILESTONES if end > self.n_samples), last)  # of the present stretch
            size = min(total - position, end - self.n_samples)
            part = slice(position, position + size)
            piece = block.part(position, position + size)
            # of the last whole stretch: a choice within this one would depend on where blocks begin
            form = self.memory.chosen[0] if self.memory.chosen[0] in self.running else INITIAL
            for name in self.running:
                found = self._learn(name, piece, predict and name == form)
                if predict and name == form and found is not None:
                    expected[part] = found
            memory = self.memory
            self.memory = replace(
                memory,
                inputs=np.concatenate([memory.inputs, piece.inputs]),
                outputs=np.concatenate([memory.outputs, piece.outputs]),
                use=np.concatenate([memory.use, piece.use]),
                n_samples=memory.n_samples + size,
            )
            position += size
            if self.n_samples in MILESTONES or self.n_samples % _LONGEST == 0:
                self._end_stretch()
        return expected

    def _learn(self, name: str, block: Block, predict: bool) -> Array | None:
        try:
            return self.filters[name].take(block, predict=predict)
        except DivergenceError as error:
            if name != INITIAL:
                self._stop(name, f"diverged: {str(error).split(';')[0]}")
            return None

    def _stop(self, name: str, why: str) -> None:
        self.memory = replace(self.memory, stopped={**self.memory.stopped, name: why})

    def _end_stretch(self) -> None:
        """Judge the forms at the end of a stretch and prepare the next one.

        Forms that predict poorly are dropped, and the present models are frozen.
        """
        memory = self.memory
        # score the models frozen before this stretch on its samples, which they have not seen
        if memory.frozen:
            chosen, scores = self._compare_forms()
            best = min(scores.values())
            behind = {name: 0 for name in self.running}
            for name in self.running:
                own = min((s for key, s in scores.items() if key.removesuffix(_WILD) == name), default=np.inf)
                if name != INITIAL and own > _LOST * best and self.n_samples > _LATE:
                    behind[name] = memory.behind.get(name, 0) + 1
            self.memory = replace(
                memory, chosen=chosen, scores=scores, behind=behind, length=len(memory.inputs)
            )
            for name, times in behind.items():
                if times >= 2:
                    self._stop(name, f"fitted much worse after {self.n_samples} samples")
        # freeze the present models for the next stretch
        frozen = []
        for name in self.running:
            model = self.filters[name].discrete_system(name)
            if not np.isfinite(model.A).all():
                self._stop(name, f"had no finite model after {self.n_samples} samples")
                continue
            # with poles that grow too fast pulled back; the model as it is takes part, too
            calm = stabilized(model, self._limit)
            frozen.append(Frozen(name, calm, False))
            if calm is not model:
                frozen.append(Frozen(name, model, True))
        inputs, outputs, use = self._nothing
        self.memory = replace(self.memory, frozen=tuple(frozen), inputs=inputs, outputs=outputs, use=use)

    def _compare_forms(self) -> tuple[tuple[str, bool], dict[str, float]]:
        """Which form predicted the present stretch best, and the scores of all."""
        memory = self.memory
        # weight each output by its standard deviation
        spread = np.ma.filled(np.ma.masked_array(memory.outputs, memory.use == 0).var(axis=0), 0.0)
        weights = 1.0 / np.sqrt(np.where(spread > 0, spread, 1.0))
        stretch = memory.inputs, memory.outputs, memory.use
        calm: dict[str, float] = {}
        wild: dict[str, float] = {}
        for frozen in memory.frozen:
            m = frozen.model
            arrays = tuple(map(np.ascontiguousarray, (m.A, m.B, m.C, m.D)))  # compiled for one layout
            score = float(free_run_cost(arrays, *stretch, weights, self._window))
            (wild if frozen.raw else calm)[frozen.name] = score if np.isfinite(score) else np.inf
        # the most physical form within 2 % of the best; the initial model unless a form beats it
        best = min(calm.values())
        name = INITIAL
        if best < calm[INITIAL]:
            name = next(key for key, score in calm.items() if score <= _ALIKE * best)
        scores = dict(calm)
        scores.update({key + _WILD: score for key, score in wild.items()})
        # an unstable model only if it halves the mean square error
        unstable = min(wild, key=lambda key: wild[key], default=None)
        if unstable is not None and wild[unstable] < _CLEARLY * calm[name]:
            return (unstable, True), scores
        return (name, False), scores

    # -- results -------------------------------------------------------------------------------------

    @property
    def chosen(self) -> tuple[str, bool]:
        """Form that predicts best, and whether its model may grow.

        The present stretch decides if it is long enough.
        """
        # the present stretch decides once it has a quarter of its length
        memory = self.memory
        if memory.frozen and len(memory.inputs) >= max(memory.length, _FIRST) // 4:
            return self._compare_forms()[0]
        return memory.chosen

    @property
    def form(self) -> str:
        """Form that predicts best."""
        return self.chosen[0]

    @property
    def scores(self) -> dict[str, float]:
        """Fit in % of each form's free run on the last stretch it had not seen."""
        return {name: float(100.0 * (1.0 - np.sqrt(s))) for name, s in self.memory.scores.items()}

    def summary(self, name: str) -> Summary:
        """Cells and sentences of `str`."""
        (form, grows), memory = self.chosen, self.memory
        part = self.filters[form]
        dt = part.setup.settings.dt
        title = f"RCORefiner of {name!r}: form {form!r} of the static stage, dt = {dt:g} s"
        notes = [f"{memory.n_samples} samples taken."]
        if memory.scores:
            shown = ", ".join(
                f"{name.rstrip(_WILD)}{' (unstable)' if name.endswith(_WILD) else ''} {score:.4g} %"
                for name, score in self.scores.items()
            )
            notes.append(
                f"Chosen by the fit of each form's simulation (free run) over {memory.length} held-out "
                f"samples: {shown}."
            )
        else:
            notes.append("No form has been compared yet: the refined model is the initial one.")
        if grows:
            notes.append("The refined model is unstable, and the data clearly support this.")
        notes += [f"{name} {why}; it is no longer compared." for name, why in memory.stopped.items()]
        if form != INITIAL:
            notes += part.notes()
        return Summary(title, PARAMETERS, part.rows(), notes)

    @property
    def filter(self) -> CoefficientFilter:
        """Filter of the form that predicts best."""
        return self.filters[self.form]

    def system(self, name: str) -> LinearModel:
        """Return the best model in the timebase that it is estimated in.

        Its growth exceeds the limit only if the data support that.
        """
        form, grows = self.chosen
        model = self.filters[form].system(name)
        limit = np.inf if grows else self._limit
        if model.is_continuous:
            limit = limit / self.filters[form].setup.settings.dt
        return stabilized(model, limit)

    def discrete_system(self, name: str) -> LinearModel:
        """Best model, in discrete time."""
        settings = self.filter.setup.settings
        return to_discrete(self.system(name), settings.dt, settings.hold)

    def finish(self) -> None:
        """Learn from what is still held back."""
        for name in self.running:
            self.filters[name].finish()

    def state(self) -> dict[str, Any]:
        """All that is remembered, for a file."""
        parts = {name: form.state() for name, form in self.filters.items()}
        return {"race": self.memory, "filters": parts}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore what `state` holds after checking it.

        It is checked against a model comparison that has just begun.
        """
        memory, names = state["race"], set(self.filters)
        bare = replace(memory, frozen=(), scores={}, behind={}, stopped={})
        check_like(bare, self.memory, "race", dict.fromkeys(("inputs", "outputs", "use"), "samples"))
        for frozen in memory.frozen:
            check_like(frozen, Frozen("", self._model, False), "race.frozen")
        for part, fresh in ((memory.scores, np.inf), (memory.behind, 0), (memory.stopped, "")):
            check_like(part, dict.fromkeys(part, fresh), "race")
        scored = {name.removesuffix(_WILD) for name in memory.scores}
        judged = {frozen.name for frozen in memory.frozen}
        told_of = {memory.chosen[0], *scored, *judged, *memory.behind, *memory.stopped}
        calm = not judged or INITIAL in {frozen.name for frozen in memory.frozen if not frozen.raw}
        # a comparison without the initial model could not choose it
        if not (names >= told_of and set(state["filters"]) == names and calm):
            raise DataError(
                f"the saved comparison is of other forms than {', '.join(names)}: the file is damaged"
            )
        for name, part in state["filters"].items():
            self.filters[name].restore(part)
        self.memory = memory


def free_run_cost(
    model: tuple[Array, ...], W: Array, Y: Array, use: Flags, weights: Array, window: int
) -> float:
    """Return the weighted mean square simulation error of a frozen model.

    The initial state is fitted.

    Parameters
    ----------
    model : tuple of ndarray
        A, B, C, D of the discrete model.
    W, Y : ndarray, shape (N, nw), (N, ny)
        Samples that it has not seen.
    use : ndarray of uint8, shape (N, ny)
        Which outputs to compare.
    weights : ndarray, shape (ny,)
        One over the size of each output.
    window : int
        Samples after which the run starts anew with a state of its own, 0 for never.
    """
    A, B, C, D = model
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
