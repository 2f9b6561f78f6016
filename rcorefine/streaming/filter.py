"""Kalman filter for state and coefficients of a model, block by block.

The state of the filter is z = [x; theta]: the state of the model at the first sample of a block, and its
coefficients. The engine simulates the block and gives its outputs h(z) with their exact derivatives H, so a
block of samples is one measurement y = h(z) + v of z, and the filter is an iterated extended Kalman filter
(Jazwinski, Stochastic Processes and Filtering Theory, 1970, section 8.3). Its covariance P = L L' is kept as
a square root. The noise v is whitened by the autoregressive filters that `refine` uses. The first samples are
kept and fitted once more as they double: errors of phase grow with time, so a short stretch has one valley
where a long one has many.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..data.measurement import block_of_stream
from ..engine.engine import Engine
from ..engine.observer import leading_gain
from ..engine.structure import Structure
from ..exceptions import DivergenceError
from ..gauss_newton import Minimum, Rows, gauss_newton
from ..inference.whitening import autoregression, highest_order, stable_model
from ..systems.conversion import to_discrete
from ..systems.linear import Array
from .families import MILESTONES, Family
from .persistence import storable
from .samples import Block, whole_block

_RING = 1024  # residuals that the noise is learned from
Flags = NDArray[np.bool_]

_SHARE = 0.3  # of its standard deviation that a coefficient may move before the model is linearized anew
_ROUNDS = 6  # linearizations of a block, at most
_SURPRISE = 9.0  # mean square of a block's normalized innovations: what was learned does not hold
_OUTLIER = 8.0  # standard deviations of a sample that is no measurement
_FEW = 0.1  # share of outliers in a block that is otherwise fine
_SOON, _TIMES = 500, 3  # surprises within so many samples: not the state alone was wrong
_FLOOR = 1e-8  # of the size of an output: its rounding
_WEAK = 0.1  # of its prior deviation: a direction that the first samples hardly determined
_MISFIT = 1.1  # mean square of the simulation for colored noise over that for white noise
_EXCITED = 0.1  # information of a block over what is forgotten, from which on all of that is forgotten
_SILENT = 1e-2  # information of a sample over that of the first ones: below it nothing is forgotten
_NOISE = 0.03  # of the size of an output: first guess of the noise


class FilterState(NamedTuple):
    """State of the filter between two blocks.

    Parameters
    ----------
    z : ndarray of shape (n + p,)
        State of the model at the first sample of `past`, and coefficients.
    L : ndarray of shape (n + p, d)
        Square root of their covariance P = L L'.
    centre : ndarray of shape (p,)
        Coefficients that the model is linearized about.
    filters, scales : ndarray of shape (n_y, m + 1), (n_y,)
        Whitening filters of the noise, and standard deviations of its innovations.
    gain : ndarray of shape (n, n_y)
        Observer gain of an unstable model; zero for a free run.
    past : Block
        Last samples, as many as the whitening filters look back on.
    before : ndarray of shape (K, n_w)
        Inputs before them.
    inner : ndarray
        Memory of laws at the first sample of `past`.
    first : Block
        Samples since the start, up to 2,048 of them; empty later.
    left : ndarray of shape (K, n_y)
        Residuals of the last 1,024 samples, NaN in gaps.
    spread, held : ndarray of shape (p,), (p, p)
        Standard deviations of the prior; its part along which coefficients are held.
    sizes, reach : ndarray of shape (n_y,), (n,)
        Sizes of outputs and states in the first samples.
    power : float
        Information of a sample about the coefficients, over that of their prior, in the first samples.
    widths : ndarray
        Smoothing width of each law that has one, NaN for others.
    n_samples, begun : int
        Samples learned from; sample at which the filter began, or began anew.
    collects : bool
        Whether the first samples are still kept.
    rounds, surprises, surprised : int
        Fits of the first samples; surprises in a row, and the sample of the last one.
    """

    z: Array
    L: Array
    centre: Array
    filters: Array
    scales: Array
    gain: Array
    past: Block
    before: Array
    inner: Array
    first: Block
    left: Array
    spread: Array
    held: Array
    sizes: Array
    reach: Array
    power: float
    widths: Array
    n_samples: int
    begun: int
    collects: bool
    rounds: int
    surprises: int
    surprised: int


class BlockCourse(NamedTuple):
    """Results of a filter at each sample of a block."""

    theta: Array  #: (N, p), after the block
    x: Array  #: (N, n), states
    predicted: Array  #: (N, n_y), outputs one sample ahead; NaN in gaps and before something is learned


class Model(NamedTuple):
    """Samples as the model sees them, about one point."""

    outputs: Array  #: (N, n_y)
    H: Array  #: (N, n_y, n + p), derivatives by z
    states: Array  #: (N, n)
    F: Array  #: (n, n + p), derivatives of the last state by z
    inner: Array  #: memory of laws at the last sample


class Update(NamedTuple):
    """Update of the filter by a block."""

    z: Array  #: (n + p,)
    root: Array  #: (n + p, d), square root of its covariance
    at: Array  #: (n + p,), where the model was linearized
    model: Model  #: the samples about that point
    e: Array  #: (k,), whitened innovations
    A: Array  #: (k, d), H L, whitened
    rows: tuple[Any, ...]  #: sample and output of each


class Pass(NamedTuple):
    """Fit of the first samples for one model of the noise."""

    point: Array  #: (d,), zeta of z = z0 + L zeta
    root: Array  #: (d, d), square root of its covariance
    left: Array  #: (N, n_y), residual
    use: Flags  #: (N, n_y), samples that are no outliers
    unsure: Array  #: (N, n_y, d), root of the covariance of the outputs: what the fit took out of the noise
    model: Model  #: the samples at that point


storable(FilterState, BlockCourse, Block)


class BlockFilter:
    """Iterated extended Kalman filter for a family of models.

    Every function returns a new state and changes nothing.

    Parameters
    ----------
    family : Family
        Model, coefficients, settings.
    """

    def __init__(self, family: Family) -> None:
        self.family, self.settings = family, family.settings
        self.n, self.ny = family.structure(np.zeros(0)).n_states, family.model.n_outputs
        self._order = np.roll(np.arange(self.n + family.start().size), self.n)
        # samples that are fitted together: no more than the memory that forgetting leaves
        memory = 1.0 / max(1.0 - self.settings.forgetting, 1e-9)
        self._last = max([n for n in MILESTONES if n <= memory], default=MILESTONES[0])
        # what a unit of each input adds to z in a sample
        pushes = to_discrete(family.physical.linear, family.settings.dt).B
        self._pushes = np.pad(pushes, ((0, self.n + family.start().size - len(pushes)), (0, 0)))

    def begin(self, n_samples: int = 0) -> FilterState:
        """State before the first sample."""
        family, n, ny = self.family, self.n, self.ny
        theta, nothing = family.start(), whole_block(np.zeros((0, family.model.n_inputs)), np.zeros((0, ny)))
        p = theta.size
        return FilterState(
            z=np.concatenate([np.zeros(n), theta]), L=np.zeros((n + p, 0)), centre=theta,
            filters=np.ones((ny, 1)), scales=np.ones(ny), gain=np.zeros((n, ny)), past=nothing,
            before=nothing.inputs, inner=np.zeros(0), first=nothing, left=np.zeros((0, ny)),
            spread=np.full(p, np.inf), held=np.zeros((p, p)), sizes=np.ones(ny), reach=np.ones(n), power=0.0,
            widths=np.zeros(0), n_samples=n_samples, begun=n_samples, collects=True, rounds=0, surprises=0,
            surprised=0,
        )  # fmt: skip

    # -- samples in ----------------------------------------------------------------------------------

    def step(
        self, state: FilterState, block: Block, *, course: bool = False
    ) -> tuple[FilterState, BlockCourse | None]:
        """Return the state after a block, and its course where that is asked for."""
        n_samples = state.n_samples + len(block.inputs)
        age, known = n_samples - state.begun, bool(block.known.all())
        after, found = self._taken(state, block, course, known)
        first = Block.joined([state.first, block]) if state.collects else state.first
        after = after._replace(first=first, n_samples=n_samples)
        # surprises that come again, or a start without inputs: all begins anew with the samples to come
        if after.surprises >= _TIMES or not (known or state.rounds):
            return self.begin(n_samples), found
        if state.collects and known and age in MILESTONES and age >= self.family.least:
            after = self._fit_or_wait(after, first, age)
        if age >= self._last or not known:
            after = after._replace(first=first.part(0, 0), collects=False)
        return after, found

    def _taken(
        self, state: FilterState, block: Block, course: bool, known: bool
    ) -> tuple[FilterState, BlockCourse | None]:
        """State after a block of which all inputs are known, or not."""
        found = self.unlearned(state, block) if course else None
        if not state.rounds:
            return state, found
        if not known:  # inputs that nobody measured: where the model stands is unknown
            return self._lost(state, block), found
        try:
            return self._learn(state, block, course)
        except DivergenceError:  # these coefficients make the model run away: they are no estimates
            if state.begun and not state.collects:
                raise
            return self.begin(state.begun if state.collects else state.n_samples + len(block.inputs)), found

    def finish(self, state: FilterState) -> FilterState:
        """Learn from samples that wait for the first fit, however few."""
        if state.rounds or len(state.first.inputs) <= self.n + 2:
            return state
        return self.fit(state, state.first)

    def _fit_or_wait(self, state: FilterState, first: Block, age: int) -> FilterState:
        """Fit the first samples, or wait for more where the fit runs away."""
        try:
            return self.fit(state, first)
        except DivergenceError:
            if state.rounds == 0 and age >= self._last:
                raise
            return state

    def _learn(
        self, state: FilterState, block: Block, course: bool
    ) -> tuple[FilterState, BlockCourse | None]:
        """Learn from a block, unless it is a surprise."""
        n, q, N = self.n, len(state.past.inputs), len(block.inputs)
        found = self.unlearned(state, block) if course else None
        whole = Block.joined([state.past, block])
        # the noise follows what the blocks leave
        if (state.n_samples + N) // _RING > state.n_samples // _RING and len(state.left) == _RING:
            most = None if state.filters.shape[1] > 1 else 0
            filters, scales = self._noise(state.left, np.isfinite(state.left), state.sizes, most=most)
            state = state._replace(filters=filters, scales=scales)
        use = whole.use > 0
        use[:q] = False  # learned before: there for the whitening filter alone
        update = self._update(state, whole, use, self.settings.forgetting**N)
        if update is None:
            return self._surprised(state, block), found
        z, root, at, model = update.z, update.root, update.at, update.model
        v = np.where(whole.use > 0, whole.outputs - model.outputs - model.H @ (z - at), np.nan)
        after = state._replace(left=np.concatenate([state.left, v[q:]])[-_RING:], centre=at[n:])
        if course and (again := self._simulate(state, whole, z)) is not None:
            found = BlockCourse(
                np.tile(z[n:], (N, 1)), again.states[q:], self._ahead(whole, update, state)[q:]
            )
        return self._move_on(after, whole, z, root, (model, at)), found

    def _update(self, state: FilterState, whole: Block, use: Flags, kept: float) -> Update | None:
        """Update by a block: innovations, gain, covariance.

        None where what was learned does not hold.

        The model is linearized anew until theta stays close to where that was done.
        """
        n, L, at, update = self.n, state.L, np.concatenate([state.z[: self.n], self._centre(state)]), None
        for _ in range(_ROUNDS):
            model = self._simulate(state, whole, at)
            if model is None:
                return None
            # innovations r = y - h(at) - H (z - at), whitened: their noise has covariance R = I
            r = whole.outputs - model.outputs + model.H @ (at - state.z)
            e, A, rows = self._whiten(state, r, model.H @ L, whole.use > 0, use)
            solved = _Solved(A, e)
            # S = H P H' + R: are the innovations as small as it says, but for a few outliers?
            if solved.surprise > _SURPRISE and e.size:
                far = np.abs(e) > _OUTLIER * np.sqrt(1.0 + np.sum(A**2, axis=1))
                if not far.any() or far.mean() > _FEW:
                    return None
                use[rows[0][far], rows[1][far]] = False
                continue
            if kept < 1.0 and self._power(state, model, use) > _SILENT * state.power:
                wider, kept = _forget(L, solved.root, n, kept), 1.0
                L, A = L @ wider, A @ wider
                solved = _Solved(A, e)
            # z = z + K e, P = P - K H P
            z, root = state.z + L @ solved.mean, L @ solved.root
            z[n:] = np.clip(z[n:], *self.family.bounds)
            update = Update(z, root, at, model, e, A, rows)
            moved, size = np.abs(z - at)[n:], np.sqrt(np.sum(root[n:] ** 2, axis=1))
            if np.all(moved <= _SHARE * size + 1e-12 * np.abs(z[n:])):
                break
            at = z.copy()
        return update

    def fit(self, state: FilterState, first: Block) -> FilterState:
        """Return the state after all first samples, fitted together.

        The fit is that of `refine`: damped Gauss-Newton for white noise, then for the noise that it leaves.
        """
        family, n = self.family, self.n
        prior, widths = family.prior(first, state.z[n:] if state.rounds else None)
        sizes = output_sizes(first)
        new = state._replace(
            widths=widths, sizes=sizes, filters=np.ones((self.ny, 1)), scales=self._level(state, sizes),
            past=first.part(0, 0), before=first.inputs[:0], inner=np.zeros(0), spread=prior.spread,
            held=np.diag(prior.spread**2) - prior.root @ prior.root.T, rounds=state.rounds + 1,
        )  # fmt: skip
        if state.rounds == 0:
            new = new._replace(gain=self._gain(first))
        new = new._replace(reach=self._reach(new, first, prior.theta))
        # z = z0 + L zeta with zeta ~ N(0, 1)
        p, q = prior.root.shape
        z0, L = np.concatenate([np.zeros(n), prior.theta]), np.zeros((n + p, n + q))
        L[:n, :n], L[n:, n:] = np.diag(new.reach), prior.root
        starts = [prior.start, prior.theta, state.z[n:]] if len(first.inputs) <= _SOON else [state.z[n:]]
        starts = list({one.tobytes(): one for one in starts}.values())
        found = [np.linalg.lstsq(prior.root, start - prior.theta, rcond=None)[0] for start in starts]
        points = [np.concatenate([np.zeros(n), zeta]) for zeta in found]
        # first for white noise, once more where its level was a guess
        best = self._pass(new, first, z0, L, points, first.use > 0)
        if state.rounds == 0:
            level = self._noise(best.left, best.use, sizes, best.unsure, 0)[1]
            best = self._pass(new._replace(scales=level), first, z0, L, [best.point], best.use)
        noise = self._noise(best.left, best.use, sizes, best.unsure, 0)
        # then for the color that is left, unless the simulation pays for it: that is a wrong structure
        colored = best
        for _ in range(2):
            color = self._noise(colored.left, colored.use, sizes, colored.unsure)
            new = new._replace(filters=color[0], scales=color[1])
            colored = self._pass(new, first, z0, L, [colored.point], colored.use)
        # a short record pays for the coefficients that white noise lets follow it
        most = _MISFIT + 10.0 * (n + q) / max(best.use.sum(), 1)
        if np.nansum((colored.left / sizes) ** 2) < most * np.nansum((best.left / sizes) ** 2):
            best, noise = colored, self._noise(colored.left, colored.use, sizes, colored.unsure)
        new = new._replace(filters=noise[0], scales=noise[1])
        z, root, v = z0 + L @ best.point, L @ best.root, best.left
        z[n:] = np.clip(z[n:], *family.bounds)
        power = self._power(new, best.model, best.use)
        new = new._replace(centre=z[n:].copy(), left=v[-_RING:], power=power)
        if family.one_to_one and len(v) == self._last:
            root, still = _held(root, n, prior.spread)
            new = new._replace(held=new.held + still)
        if len(v) == 128 and state.begun == 0:  # enough samples for the error of a mean
            family.check(first, v)
        return self._move_on(new, first, z, root, None)

    def _pass(
        self, state: FilterState, first: Block, z0: Array, L: Array, points: list[Array], use: Flags
    ) -> Pass:
        """Best of the descents from some points, for the noise that the state has."""
        best = min((self._descend(state, first, z0, L, point, use) for point in points), key=_cost)
        if not np.isfinite(best.cost):
            raise DivergenceError(
                f"the static stage diverged before sample {state.n_samples}: the model grows beyond all "
                "numbers within the first samples. Place: choose other effects, give them a start or a prior"
            )
        model = best.rows.more
        v = np.where(first.use > 0, first.outputs - model.outputs, np.nan)
        # samples far beyond the others are no measurements
        middle = np.ma.median(np.ma.masked_invalid(np.abs(v)), axis=0).filled(0.0)
        near = np.abs(v) <= _OUTLIER * np.maximum(1.5 * middle, 3 * _FLOOR * state.sizes)
        A = best.rows.jacobian[: -L.shape[1]]
        root = _Solved(A, np.zeros(len(A))).root
        return Pass(best.point, root, v, near, model.H @ (L @ root), model)

    def _descend(
        self, state: FilterState, first: Block, z0: Array, L: Array, begin: Array, use: Flags
    ) -> Minimum:
        """Gauss-Newton over zeta, z = z0 + L zeta."""
        n = self.n
        lower, upper = (np.full(begin.size, bound) for bound in (-np.inf, np.inf))
        sizes = np.diag(L[n:, n:]) if L.shape[0] == L.shape[1] else np.zeros(0)
        if sizes.size and not np.any(L[n:, n:] - np.diag(sizes)):
            lower[n:], upper[n:] = ((bound - z0[n:]) / sizes for bound in self.family.bounds)

        def rows(zeta: Array) -> Rows:
            z = z0 + L @ zeta
            model = self._simulate(state, first, z)
            if model is None:
                return Rows(np.full(1, np.inf), np.zeros((1, zeta.size)))
            r = model.outputs - first.outputs
            e, A, _ = self._whiten(state, r, model.H @ L, use, use)
            return Rows(np.concatenate([e, zeta]), np.vstack([A, np.eye(zeta.size)]), model)

        return gauss_newton(
            rows, np.clip(begin, lower, upper), lower=lower, upper=upper, evaluations=20,
            settled=lambda cost, gain: gain < 1e-3,
        )  # fmt: skip

    # -- pieces --------------------------------------------------------------------------------------

    def _simulate(self, state: FilterState, block: Block, z: Array) -> Model | None:
        """Outputs and states with their derivatives by z.

        None where the simulation leaves all bounds.
        """
        n, family = self.n, self.family
        structure, settings = family.structure(state.widths), self.settings
        data = block_of_stream(block.inputs.T, block.outputs.T, settings.dt, settings.hold)
        engine = Engine(structure, data, substeps=family.substeps, past=state.before.T)
        gain, use = None, None
        if state.gain.any():
            gain, use = state.gain, block.use > 0
        inner = state.inner if state.inner.size else None
        run = engine.run(
            z[n:], z[:n], initial_state=True, gain=gain, use=use, inner=inner, histories=True, check=False
        )
        if run.blew_up >= 0 or not np.isfinite(run.outputs).all() or run.last is None:
            return None
        H, F = run.sensitivity.swapaxes(0, 1), run.last.S.T
        if not np.isfinite(H).all():  # derivatives may overflow where the motion does not
            H, F = np.nan_to_num(H), np.nan_to_num(F)
        # the engine has theta first
        return Model(run.outputs.T, H[:, :, self._order], run.states.T, F[:, self._order], run.last.z)

    def _centre(self, state: FilterState) -> Array:
        """Coefficients to linearize about: the last ones if theta is close."""
        theta, size = state.z[self.n :], np.sqrt(np.sum(state.L[self.n :] ** 2, axis=1))
        near = np.all(np.abs(theta - state.centre) <= _SHARE * size)
        return state.centre if near else theta

    def _whiten(
        self, state: FilterState, r: Array, A: Array, there: Flags, use: Flags
    ) -> tuple[Array, Array, Any]:
        """Whiten innovations (N, n_y) and their derivatives (N, n_y, d).

        Return those that have a whole past and are used, and where they stand (sample, output).
        """
        order = state.filters.shape[1] - 1
        whole, e, white = use.copy(), r.copy(), A.copy()
        for j in range(1, order + 1):
            a = state.filters[:, j]
            e[j:] += a * r[:-j]
            white[j:] += a[:, None] * A[:-j]
            needed = a != 0
            whole[j:] &= there[:-j] | ~needed
            whole[:j] &= ~needed
        rows = np.nonzero(whole)
        return e[rows] / state.scales[rows[1]], white[rows] / state.scales[rows[1], None], rows

    def _noise(
        self, v: Array, there: Flags, sizes: Array, unsure: Array | None = None, most: int | None = None
    ) -> tuple[Array, Array]:
        """Whitening filters and scales from residuals (N, n_y).

        `unsure` (N, n_y, d) is a root of the covariance of the outputs that were fitted.
        """
        if self.settings.noise.any():
            return np.ones((self.ny, 1)), self.settings.noise
        # what a changing plant leaves is no noise of the sensors
        white = self.family.remembers or self.settings.disturbance > 0 or self.settings.forgetting < 1
        longest = 0 if white else highest_order(len(v))
        longest = longest if most is None else min(most, longest)
        filters, scales = np.eye(1, 1 + longest).repeat(self.ny, axis=0), np.zeros(self.ny)
        for i in range(self.ny):
            known, signal = there[:, i], np.where(there[:, i], v[:, i], 0.0)
            doubt = np.zeros((len(v), 0)) if unsure is None else unsure[:, i] * known[:, None]
            # gaps leave few samples with a whole past: then a short filter
            gaps = np.count_nonzero(~known)
            short = min(longest, int(0.1 * len(v) / gaps)) if gaps else longest
            variance = float((np.sum(signal**2) + np.sum(doubt**2)) / max(known.sum(), 1))
            a = np.ones(1)
            if short and variance > 0:
                price = float(np.log(max(known.sum(), 2)))  # Schwarz: white noise stays white
                there_all, doubt_all = (known, None) if gaps else (None, doubt)
                found = autoregression(signal, most=short, price=price, known=there_all, unsure=doubt_all)
                a, variance = stable_model(*found)
            filters[i, : a.size], scales[i] = a, np.sqrt(variance)
        orders = np.flatnonzero(filters.any(axis=0))
        return filters[:, : orders[-1] + 1], np.hypot(scales, _FLOOR * sizes)

    def _level(self, state: FilterState, sizes: Array) -> Array:
        """First guess of the noise.

        It is what was declared, what the last fit left, or a share of the outputs.
        """
        if self.settings.noise.any():
            return self.settings.noise
        if not state.rounds:
            return _NOISE * sizes
        left = np.where(np.isfinite(state.left), state.left, 0.0)
        return np.hypot(np.sqrt(np.mean(left**2, axis=0)), _FLOOR * sizes)

    def _power(self, state: FilterState, model: Model, use: Flags) -> float:
        """Information of a sample about theta, over that of the prior."""
        told = model.H[:, :, self.n :] * state.spread / state.scales[:, None]
        return float(np.sum(told[use] ** 2) / max(use.sum(), 1))

    def _gain(self, first: Block) -> Array:
        """Observer gain where the model has no free run."""
        physical, settings = self.family.physical, self.settings
        bare = Structure(physical)
        data = block_of_stream(first.inputs.T, first.outputs.T, settings.dt, settings.hold)
        found = leading_gain(bare, data)
        if found is None or not np.isfinite(found).all():
            return np.zeros((self.n, self.ny))
        return np.pad(found, ((0, self.n - len(found)), (0, 0)))

    def _reach(self, state: FilterState, first: Block, theta: Array) -> Array:
        """Sizes of the states: three times what they reach or outputs show."""
        model = self._simulate(state, first, np.concatenate([np.zeros(self.n), theta]))
        moving = np.zeros(self.n)
        if model is not None:
            moving = np.sqrt(np.mean(np.minimum(np.abs(model.states), 1e100) ** 2, axis=0))
        read = np.abs(np.linalg.pinv(self.family.physical.linear.C)) @ state.sizes
        size = 3.0 * np.hypot(moving, read)
        return np.where(size > 0, size, 1.0)

    def _move_on(
        self, state: FilterState, whole: Block, z: Array, root: Array, about: tuple[Model, Array] | None
    ) -> FilterState:
        """Predict: z and P at the first sample that the next block looks back on.

        `about` is a run over these samples and its point, if there is one close to z.
        """
        n, N = self.n, len(whole.inputs)
        at = N - min(max(state.filters.shape[1] - 1, 1), N)
        if about is None or at < N - 1:
            model = self._simulate(state, whole.part(0, at + 1), z)
            about = None if model is None else (model, z)
        if about is None:
            raise DivergenceError(f"the static stage diverged at sample {state.n_samples}")
        # x = f(z), P = F P F' with the derivatives F of x by z
        model, point = about
        x, L = model.states[-1] + model.F @ (z - point), np.vstack([model.F @ root, root[n:]])
        if self.settings.disturbance > 0:  # P = F P F' + Q for unknown forces held over each sample
            force = self.settings.disturbance * np.sqrt(np.sum(whole.inputs**2, axis=0))
            U, sizes, _ = np.linalg.svd(np.hstack([L, self._pushes * force]), full_matrices=False)
            L = (U * sizes)[:, : L.shape[1]]
        inputs = np.concatenate([state.before, whole.inputs[:at]])
        lag = self.family.lag
        return state._replace(z=np.concatenate([x, z[n:]]), L=L, past=whole.part(at, N), inner=model.inner,
            before=inputs[len(inputs) - min(lag, len(inputs)) :],
        )  # fmt: skip

    def _surprised(self, state: FilterState, block: Block) -> FilterState:
        """Count a block that taught nothing: a bump moves the state alone."""
        soon = state.n_samples - state.surprised < _SOON
        return self._lost(state, block)._replace(
            surprises=state.surprises + 1 if soon else 1, surprised=state.n_samples
        )

    def _lost(self, state: FilterState, block: Block) -> FilterState:
        """Return a state after a block whose x is as uncertain as at the start."""
        n, whole = self.n, Block.joined([state.past, block])
        # covariance of theta as before, the state as uncertain as at the start
        U, s, _ = np.linalg.svd(state.L[n:], full_matrices=False)
        L = np.zeros_like(state.L)
        L[n:, n:] = (U * s)[:, : state.L.shape[1] - n]
        after = self._move_on(state, whole, state.z, L, None)
        L[:n, :n] = np.diag(state.reach)
        return after._replace(L=L)

    def unlearned(self, state: FilterState, block: Block) -> BlockCourse:
        """Return the course of samples that nothing was learned from."""
        N = len(block.inputs)
        return BlockCourse(
            np.tile(state.z[self.n :], (N, 1)), np.tile(state.z[: self.n], (N, 1)),
            np.full((N, self.ny), np.nan),
        )  # fmt: skip

    def _ahead(self, whole: Block, update: Update, state: FilterState) -> Array:
        """Outputs one sample ahead, NaN in gaps."""
        _, _, _, _, e, A, rows = update
        # S = C C': the k-th entry of C^-1 e is the innovation of row k given the rows before
        C = np.linalg.cholesky(A @ A.T + np.eye(len(A)))
        found = np.full(whole.outputs.shape, np.nan)
        found[rows] = whole.outputs[rows] - np.diag(C) * np.linalg.solve(C, e) * state.scales[rows[1]]
        return found

    # -- results -------------------------------------------------------------------------------------

    def covariance(self, state: FilterState) -> Array:
        """Covariance of the coefficients, shape (p, p).

        It is infinite before anything is learned.
        """
        if not state.rounds:
            return np.diag(np.full(state.centre.size, np.inf))
        root = state.L[self.n :]
        return root @ root.T + state.held

    def predict(self, state: FilterState, waiting: Block, inputs: Array) -> Array:
        """Free run from the last sample on, outputs (N, n_y)."""
        past = Block.joined([state.past if state.rounds else state.first, waiting])
        total = np.vstack([past.inputs, inputs])
        z = state.z
        if not state.rounds:  # the initial model, from rest
            z = np.concatenate([np.zeros(self.n), self.family.start()])
        block = whole_block(total, np.zeros((len(total), self.ny)))
        model = self._simulate(state._replace(gain=0.0 * state.gain), block, z)
        if model is None:
            raise DivergenceError("the refined model grows beyond all numbers over these inputs")
        return model.outputs[len(past.inputs) :]


def output_sizes(block: Block) -> Array:
    """Rms of each output where it was measured; 1 for one that is zero."""
    power = np.sum(np.where(block.use, block.outputs, 0.0) ** 2, axis=0)
    return np.sqrt(
        np.where(power > 0, power, 1.0) / np.where(power > 0, np.maximum(block.use.sum(axis=0), 1), 1.0)
    )


def _cost(best: Minimum) -> float:
    return best.cost


class _Solved:
    """Kalman update in square-root form.

    With A = H L and unit noise, K = P H' S^-1 = L (I + A'A)^-1 A' and P - K H P = L (I + A'A)^-1 L'.
    """

    def __init__(self, A: Array, e: Array) -> None:
        d = A.shape[1]
        # R'R = I + A'A by orthogonal transformations: it has no smaller pivot than one
        R = np.linalg.qr(np.vstack([A, np.eye(d)]), mode="r")
        self.root = np.linalg.inv(R)  # (I + A'A)^-1 = root root'
        half = self.root.T @ (A.T @ e)
        self.mean = self.root @ half
        #: mean of e' S^-1 e, the normalized innovations squared
        self.surprise = float(e @ e - half @ half) / max(e.size, 1)
        #: number of coefficients that the block determines
        self.explained = float(d - np.sum(self.root**2))


def _held(root: Array, n: int, spread: Array) -> tuple[Array, Array]:
    """Hold theta along directions that the first samples hardly determined.

    Return the square root of the covariance without them, and their own covariance (p, p). Blocks that are
    linearized at different points seem to tell something along a curved ridge; each pushes theta on.
    """
    _, sizes, V = np.linalg.svd(root[n:] / spread[:, None], full_matrices=False)
    weak = V[sizes > _WEAK].T @ V[sizes > _WEAK]
    kept = root - root @ weak
    return kept, root[n:] @ weak @ root[n:].T


def _forget(L: Array, root: Array, n: int, kept: float) -> Array:
    """Widening W of the covariance, P = L W W' L', to forget.

    It acts along the directions of theta that a block informs of.

    A direction that learns little forgets in proportion (Kulhavy, Kybernetika 23 (1987) 1). `root` is that of
    the block's update.
    """
    # theta depends on the columns of U alone; theirs are the first L.shape[1] - n
    U = np.linalg.qr(L[n:].T, mode="complete")[0][:, : L.shape[1] - n]
    left, V = np.linalg.eigh(U.T @ root @ root.T @ U)  # of their unit variances, after the block
    lost, learned = 1.0 / kept - 1.0, 1.0 / np.maximum(left, 1e-12) - 1.0
    f = 1.0 + lost * np.clip(learned / lost / _EXCITED, 0.0, 1.0)
    widened: Array = np.eye(len(U)) + (U @ V * (np.sqrt(f) - 1.0)) @ (U @ V).T
    return widened
