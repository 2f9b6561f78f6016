"""Loop over a block of samples: predict, compare and correct.

The prediction uses the model at the present coefficients.

The filter is a Kalman filter for state and coefficients jointly, kept in two parts
(Friedland, IEEE Trans. Automatic Control 14 (1969) 359): the state as if the coefficients
were known, and the sensitivity of the filtered state to them. What a sample teaches about
the coefficients moves the state as if the model had always had them, to first order; that is the
retrospective filter about the current refined model.

One packed array holds what the filter remembers, another what it is given: one array to copy makes a
call all or nothing at no cost, and one array to write makes a save exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np

from ...effects.compiled import raise_pending
from ...engine.inputs import Drive
from ...engine.march import MarchState, march_at
from ...jit import compiled, put, put_rows
from ...systems.linear import Array
from ..samples import Block, Integers
from .laws import Laws, drive, enter, fill, hold, inputs_of, keep_first, march_of, push, read, shift_matrices


@dataclass(frozen=True, slots=True)
class Layout:
    """Sizes, and where each quantity stands in the packed memory.

    Parameters
    ----------
    n, p, nu, ny, m : int
        States, coefficients, inputs with the constant one, outputs, inner states of laws.
    lag : int
        Samples of the input that delays look back on.
    kept : int
        Input laws, where one of them has an inner state.
    """

    n: int
    p: int
    nu: int
    ny: int
    m: int
    lag: int
    kept: int = 0

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes in the order of the memory."""
        n, p, nu, ny = self.n, self.p, self.nu, self.ny
        return {
            "theta": (p,),
            "delta": (p,),
            "x": (n,),
            "S": (p, n),
            "Pb": (n, n),
            "Pt": (p, p),
            "level": (2, ny),
            "count": (ny,),
            "cost": (2, ny),
            "power": (2, ny),
            "surprise": (1,),
            "w": (nu,),
            "z": (self.m,),
            "ring": (self.lag, nu),
            "kept": (self.kept, 6),
        }

    @property
    def size(self) -> int:
        """Length of the memory."""
        return sum(int(np.prod(shape)) for shape in self.shapes.values())

    def parts(self, memory: Array) -> SimpleNamespace:
        """Quantities by name, as views into the memory."""
        places = _places(self).items()
        return SimpleNamespace(**{name: memory[part].reshape(shape) for name, (part, shape) in places})

    def record(self, n_samples: int) -> CoefficientRecord:
        """Room for the course over some samples, nothing known of it yet."""
        return CoefficientRecord(
            *(np.full((n_samples, width), np.nan) for width in (self.p, self.ny, self.n))
        )


@lru_cache(maxsize=64)
def _places(layout: Layout) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Return the position and shape of each quantity in the memory."""
    found, at = {}, 0
    for name, shape in layout.shapes.items():
        stop = at + int(np.prod(shape))
        found[name] = slice(at, stop), shape
        at = stop
    return found


class CoefficientRecord(NamedTuple):
    """History over a block: coefficients, predicted outputs and states.

    Each has shape (N, .), or no rows.
    """

    theta: Array
    predicted: Array
    x: Array

    def part(self, start: int, stop: int) -> CoefficientRecord:
        """Samples from `start` up to `stop`."""
        return CoefficientRecord(*(column[start:stop] for column in self))


@compiled
def row(packed, at, size):
    """Numbers from `at` on, and where the next ones stand."""
    return packed[at : at + size], at + size


@compiled
def matrix(packed, at, rows, columns):
    """Return a matrix view of the packed array, and the next position."""
    return packed[at : at + rows * columns].reshape(rows, columns), at + rows * columns


@compiled
def remembered(sizes, packed):
    """Views of the packed memory, in the order of `Layout.shapes`.

    theta : coefficients; delta : what a block of frozen ones says about them; x : state;
    S : sensitivity of the state, (p, n); Pb : covariance of the state for known coefficients;
    Pt : covariance of the coefficients; level : mean square of the innovations, quick and slow,
    (2, n_y); count : samples in it; cost : sum of squares and count; power : what the prior doubt
    moves at an output; surprise : mean square of what the filter was sure of; w : last inputs;
    z, ring, kept : inner states of force laws, past inputs, inner states of input effects.
    """
    # the packed memory holds the quantities one behind the other, in the order of `Layout.shapes`
    n, p, nu, ny = sizes[0], sizes[1], sizes[2], sizes[3]
    theta, at = row(packed, 0, p)
    delta, at = row(packed, at, p)
    x, at = row(packed, at, n)
    S, at = matrix(packed, at, p, n)
    Pb, at = matrix(packed, at, n, n)
    Pt, at = matrix(packed, at, p, p)
    level, at = matrix(packed, at, 2, ny)
    count, at = row(packed, at, ny)
    cost, at = matrix(packed, at, 2, ny)
    power, at = matrix(packed, at, 2, ny)
    surprise, at = row(packed, at, 1)
    w, at = row(packed, at, nu)
    z, at = row(packed, at, sizes[6])
    ring, at = matrix(packed, at, sizes[5], nu)
    kept, at = matrix(packed, at, sizes[7], 6)
    return theta, delta, x, S, Pb, Pt, level, count, cost, power, surprise, w, z, ring, kept


@compiled
def given_at(sizes, fixed):
    """Views of what `CoefficientSetup.head` packed, and the model's place.

    They stay fixed until the next discretization. centre : its coefficients; limits : their bounds,
    (2, p); least : steps that do not matter; floor : declared variance of the noise; numbers : when to
    discretize (standard deviations), what is not forgotten, limit of the state, when to begin anew;
    Q, Qw : covariance of unknown forces, and of inputs that were not measured.
    """
    n, p, ny = sizes[0], sizes[1], sizes[3]
    centre, at = row(fixed, 0, p)
    limits, at = matrix(fixed, at, 2, p)
    least, at = row(fixed, at, p)
    floor, at = row(fixed, at, ny)
    numbers, at = row(fixed, at, 4)
    Q, at = matrix(fixed, at, n, n)
    Qw, at = matrix(fixed, at, n, n)
    return centre, limits, least, floor, numbers, Q, Qw, at


@compiled
def sample_of(sizes):
    """Room for the prediction of one sample, and its correction.

    F : transition; H, h : outputs by the state before and by the coefficients; yhat : outputs, the
    later ones corrected by the earlier; predicted : outputs as they were predicted; g : gain of the
    coefficients; gain : of the state, before and after the transition; T, loose : room.
    """
    n, p, ny = sizes[0], sizes[1], sizes[3]
    room = np.zeros(3 * n * n + ny * (n + p) + 2 * ny + p + 2 * n)
    F, at = matrix(room, 0, n, n)
    H, at = matrix(room, at, ny, n)
    h, at = matrix(room, at, ny, p)
    yhat, at = row(room, at, ny)
    predicted, at = row(room, at, ny)
    g, at = row(room, at, p)
    gain, at = matrix(room, at, 2, n)
    T, at = matrix(room, at, n, n)
    loose, at = matrix(room, at, n, n)
    return F, H, h, yhat, predicted, g, gain, T, loose


DONE, MOVED, DIVERGED, SURPRISED = 0, 1, 2, 3

_SHORT = 1.0 / 32.0  # weight of a sample in the quick level of the innovations
_LONG = 1.0 / 1000.0  # least weight of a sample in the slow one
_MOST = 36.0  # of its variance that the square of an innovation counts for as a surprise
_EXCITED = 25.0  # of the noise: what the prior doubt moves at an output that counts as excited
_QUIET = 0.02  # of the most that it ever moved: less is no excitation
_SETTLED = 1e-6  # share of the noise below which the initial state no longer matters


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """A discretized model, ready for the loop over samples.

    Parameters
    ----------
    sizes, fixed, laws
        As `advance` takes them.
    floor : ndarray of shape (n_y,)
        Declared variance of the noise.
    """

    sizes: Integers
    fixed: Array
    laws: Laws | None
    floor: Array

    def over(
        self,
        packed: Array,
        counters: Integers,
        block: Block,
        record: CoefficientRecord,
        frozen: bool = False,
    ) -> tuple[int, int]:
        """Advance over a block, in place; samples done, and why no more."""
        done, why = advance(self.sizes, self.fixed, packed, counters, block, frozen, record, self.laws)
        raise_pending()
        return done, why


@compiled
def _follow(i, e, floor, level, count, forgetting):
    """Update the innovation level of output i and return the noise.

    The noise variance is that level, or the declared one if that is larger.
    """
    # exponential averages of the squared innovation: a quick one and a slow one
    count[i] += 1.0
    level[0, i] += _SHORT * (e * e - level[0, i])
    level[1, i] += max(_LONG, 1.0 - forgetting, 1.0 / count[i]) * (e * e - level[1, i])
    # noise variance; half of the quick level lets it rise soon after a change
    return max(floor[i], level[1, i], 0.5 * level[0, i])


@compiled
def _excites(i, R, h, least, power):
    """Return whether the coefficients are excited at output i.

    Their present effect must be large enough compared with the noise and with the largest effect so
    far. Otherwise nothing is forgotten.
    """
    # variance that the prior doubt of the coefficients would cause at this output
    doubt = 0.0
    for a in range(least.shape[0]):
        doubt += (h[i, a] * 1e6 * least[a]) ** 2
    power[0, i] += _SHORT * (doubt - power[0, i])
    power[1, i] = max(power[1, i], power[0, i])
    # persistent excitation: above the noise, and not a remainder of earlier excitation
    return doubt >= _EXCITED * R and power[0, i] >= _QUIET * power[1, i]


@compiled
def _bounded(x, limit):
    """Return whether all states are numbers below a limit."""
    for i in range(x.shape[0]):
        if not abs(x[i]) < limit:
            return False
    return True


@compiled
def advance(sizes, fixed, packed, counters, block, frozen, record, laws):
    """Advance over a block.

    Parameters
    ----------
    sizes : ndarray of int64, shape (8,)
        n, p, nw + 1, ny, q (coefficients in the matrices), and what `Layout` calls lag, m, kept.
    fixed, packed : ndarray
        What is given and what is remembered, as in `packed`; without laws the model behind the former.
    counters : ndarray of int64, shape (3,)
        Samples taken; samples for which the initial state still matters; unknown disturbances.
    block : Block
        Samples; what is not to be used may hold anything finite.
    frozen : bool
        Keep the coefficients, and collect in `delta` what the block says about them.
    record : CoefficientRecord
        Takes every sample, or has no rows.
    laws : Laws or None
        The model, where it has laws; each way is compiled for itself.

    Returns
    -------
    tuple of int
        Samples done, and DONE, MOVED (discretize anew), SURPRISED (innovations far beyond what the
        filter was sure of) or DIVERGED.
    """
    theta, delta, x, S, Pb, Pt, level, count, cost, power, surprise, before, z, ring, kept = remembered(
        sizes, packed
    )
    centre, limits, least, floor, numbers, Q, Qw, at = given_at(sizes, fixed)
    share, forgetting, limit, watch = numbers[0], numbers[1], numbers[2], numbers[3]
    F, H, h, yhat, predicted, g, gain, T, loose = sample_of(sizes)
    n, nu, ny = sizes[0], sizes[2], sizes[3]
    if laws is None:
        M, O, dM, dO, columns, rows, varied, Oc, step, driven, Sn = linear_at(sizes, fixed, at)
    else:
        inputs = inputs_of(laws.statics, laws.substeps, laws.foh, nu, kept)
        Wn, Wout, dW, dWout, affected = inputs.W, inputs.Wout, inputs.dW, inputs.dWout, inputs.driven
        model, nobody, S_all, into_all, S_few, into_few = march_of(sizes, laws, limit)
    w = np.ones(nu)
    for k in range(block.inputs.shape[0]):
        # w = [inputs; 1], so that constant forces are a column of the model
        put(w, 0, block.inputs[k])
        if counters[0] == 0:
            # the first sample has none before it that predicts it
            predicted[:] = np.nan
            if laws is not None:
                for row in range(ring.shape[0]):
                    put(ring[row], 0, w)
                keep_first(w, laws.statics, laws.levels, inputs)
        else:
            # the state is uncertain: at first, where unknown forces act, after an input that is missing
            if counters[2] > 0 or not block.known[k]:
                counters[1] = 10 * n + 10
                if not block.known[k]:
                    Pb += Qw
            uncertain = counters[1] > 0

            # predict the sample, with the sensitivities to coefficients and to the state before
            # time update: x+ = M [x; w; w+], S+ = F S + dM/dtheta [x; w; w+]
            if laws is None:
                put(step, 0, x)
                put(step, n, before)
                put(step, n + nu, w)
                step_state(x, F, M, dM, columns, rows, theta, centre, step, driven)
                step_sensitivity(S, F, columns, rows, driven, Sn)
                if varied:
                    shift_outputs(Oc, O, dO, columns, theta, centre)
                step_outputs(x, w, S, Oc, dO, columns, varied, yhat, h)
                # H = C F: outputs by the state before this sample, for the gain of the state
                if uncertain:
                    through_state(H, Oc, F)
            else:
                # nonlinear or delayed inputs: march over the substeps with forces at the present coefficients
                push(ring, w)
                shift_matrices(model.at, laws.model.at, theta, centre)
                fill(model.ports.values, model.ports.columns, 0, theta)
                fill(model.sensors.values, model.sensors.columns, 0, theta)
                hold(ring, laws.substeps, laws.foh, Wn, Wout)
                if laws.statics.shape[0] > 0:
                    fill(laws.levels, laws.statics, 2, theta)
                    drive(ring, laws.statics, laws.levels, laws.substeps, laws.foh, laws.dt, inputs)
                through, into = (S_all, into_all) if uncertain else (S_few, into_few)
                enter(through, S)
                acting = Drive(Wn, int(laws.foh), Wout, dW, dWout, affected)
                if march_at(laws.march, model, acting, nobody, MarchState(x, z, through), into) >= 0:
                    return k, DIVERGED
                read(through, into.sensitivity, into.outputs, S, yhat, h, F, H)

            # correct with one output after the other
            put(predicted, 0, yhat)
            settled, seen = True, False
            # covariance that forgetting adds to the state
            if forgetting < 1.0:
                loose[:, :] = 0.0
            for i in range(ny):
                if not block.use[k, i]:
                    continue
                # innovation of output i, after the outputs before it have corrected the prediction
                e = block.outputs[k, i] - yhat[i]
                calm = max(floor[i], level[1, i])
                # frozen coefficients keep the declared noise; otherwise it follows the innovations
                R = floor[i] if frozen else _follow(i, e, floor, level, count, forgetting)
                forgets = forgetting < 1.0 and _excites(i, R, h, least, power)
                # innovation variance: s for known coefficients, plus what their doubt adds
                s = state_gain(i, R, Pb, F, H, gain) if uncertain else R
                spread = coefficient_gain(i, Pt, h, g)
                left = e
                # frozen: collect the information on theta; otherwise correct theta first, then the state
                if frozen:
                    collect(i, e, s + spread, delta, h, g)
                else:
                    left = move_coefficients(i, e, s + spread, theta, limits, x, S, h, g, yhat)
                if uncertain:
                    move_state(i, left, s, x, S, Pb, H, h, gain, yhat)
                # gain of Pt: 1 / (innovation variance), smaller where the filter forgets
                down = 1.0 / (s + spread)
                if forgets and not frozen and spread > 0.0:
                    down = forget(i, s, spread, forgetting, S, h, g, gain, loose)
                reduce_covariance(Pt, g, down)
                # a lone outlier does not count for much; a run of errors where the filter was sure does
                ratio = e * e / (s + spread - R + calm)
                surprise[0] += _SHORT * (min(ratio, _MOST) - surprise[0])
                cost[0, i] += e * e * R / s
                cost[1, i] += 1.0
                seen = True
                settled = settled and s - R <= _SETTLED * R

            # the state's covariance; several samples without a trace of the initial state: it is forgotten
            if uncertain:
                step_covariance(Pb, F, Q, loose, T)
                if counters[2] > 0 or not settled:
                    counters[1] = 10 * n + 10
                elif seen:
                    counters[1] -= 1
            if not _bounded(x, limit):
                return k, DIVERGED

        # count and record the sample
        put(before, 0, w)
        counters[0] += 1
        if record.theta.shape[0] > 0:
            put(record.theta[k], 0, theta)
            put(record.predicted[k], 0, predicted)
            put(record.x[k], 0, x)
        if not frozen and surprise[0] > watch:
            return k + 1, SURPRISED
        if not frozen and moved(theta, centre, Pt, share, least):
            return k + 1, MOVED
    return block.inputs.shape[0], DONE


@compiled
def apply(A, x, out):
    """Multiply a matrix by a vector."""
    for i in range(A.shape[0]):
        total = 0.0
        for j in range(A.shape[1]):
            total += A[i, j] * x[j]
        out[i] = total


@compiled
def state_gain(i, R, Pb, F, H, gain):
    """Compute the state gain for known coefficients.

    `gain` holds it before and after the transition. Return the variance of output i.
    """
    # s = H Pb H' + R and K = Pb H' / s
    s = R
    apply(Pb, H[i], gain[0])
    for a in range(Pb.shape[0]):
        s += H[i, a] * gain[0, a]
    for a in range(Pb.shape[0]):
        gain[0, a] /= s
    # the same gain carried over the transition: F K corrects the predicted state
    apply(F, gain[0], gain[1])
    return s


@compiled
def coefficient_gain(i, Pt, h, g):
    """Compute the covariance of the coefficients with output i.

    Return what the coefficients add to the variance of that output.
    """
    # g = Pt h' and spread = h Pt h'
    spread = 0.0
    apply(Pt, h[i], g)
    for a in range(g.shape[0]):
        spread += h[i, a] * g[a]
    return spread


@compiled
def collect(i, e, st, delta, h, g):
    """Accumulate the information of output i on frozen coefficients."""
    # e - h delta: innovation that the information collected so far leaves
    for a in range(g.shape[0]):
        e -= h[i, a] * delta[a]
    # recursive least squares step
    for a in range(g.shape[0]):
        delta[a] += g[a] * e / st


@compiled
def move_coefficients(i, e, st, theta, limits, x, S, h, g, yhat):
    """Update the coefficients inside their bounds and what depends on them.

    Return what is left of the innovation `e`.
    """
    left = e
    # theta + Pt h' e / s, projected on the bounds
    for a in range(theta.shape[0]):
        aim = theta[a] + g[a] * e / st
        if aim < limits[0, a]:
            aim = limits[0, a]
        elif aim > limits[1, a]:
            aim = limits[1, a]
        # Friedland: a change of theta moves state and later outputs through the sensitivities
        move = aim - theta[a]
        theta[a] = aim
        left -= h[i, a] * move
        for b in range(x.shape[0]):
            x[b] += S[a, b] * move
        for j in range(i + 1, yhat.shape[0]):
            yhat[j] += h[j, a] * move
    return left


@compiled
def move_state(i, e, s, x, S, Pb, H, h, gain, yhat):
    """Update the state, the later outputs and the sensitivities."""
    n, p = x.shape[0], S.shape[0]
    # x + F K e
    for b in range(n):
        x[b] += gain[1, b] * e
    # scalar updates in turn: the later outputs of this sample see the corrected state
    for j in range(i + 1, yhat.shape[0]):
        c = 0.0
        for b in range(n):
            c += H[j, b] * gain[0, b]
        yhat[j] += c * e
        for a in range(p):
            h[j, a] -= c * h[i, a]
    # S - F K h: sensitivity of the filtered state
    for a in range(p):
        for b in range(n):
            S[a, b] -= gain[1, b] * h[i, a]
    # Pb - s K K'
    for a in range(n):
        for b in range(n):
            Pb[a, b] -= s * gain[0, a] * gain[0, b]


@compiled
def forget(i, s, spread, forgetting, S, h, g, gain, loose):
    """Forget only along the direction that this sample excited (Kulhavy).

    Return the share of the sample that is learned.

    The coefficients may have changed just now: the state no longer answers for them since the start.
    """
    n, p = gain.shape[1], g.shape[0]
    # the information matrix loses a share along h only; `kept` is what remains of this direction
    st = s + spread
    ratio = spread / s
    kept = forgetting - (1.0 - forgetting) / ratio
    down = kept / (s * (1.0 + kept * ratio))
    extra = 1.0 / st - down
    share = extra / (1.0 + extra * spread * st / s)
    # sensitivity of the state along the direction of g
    for b in range(n):
        total = 0.0
        for a in range(p):
            total += g[a] * S[a, b]
        gain[0, b] = total
    # the state was filtered with the earlier coefficients: it follows a change by less
    for a in range(p):
        for b in range(n):
            S[a, b] -= share * h[i, a] * st / s * gain[0, b]
    # and its covariance grows by what they may have changed
    for a in range(n):
        for b in range(n):
            loose[a, b] += share * gain[0, a] * gain[0, b]
    return down


@compiled
def reduce_covariance(Pt, g, down):
    """Covariance of the coefficients after an output."""
    p = g.shape[0]
    for a in range(p):
        before = Pt[a, a]
        # rank-one downdate of Pt
        for b in range(p):
            Pt[a, b] -= down * g[a] * g[b]
        # rounding must not make it negative where one sample teaches almost everything
        if Pt[a, a] < 1e-13 * before:
            Pt[a, a] = 1e-13 * before


@compiled
def step_covariance(Pb, F, Q, loose, T):
    """Propagate the covariance of the state by one sample.

    It becomes F Pb F' plus what unknown forces and forgetting add.
    """
    n = F.shape[0]
    # T = F Pb
    for a in range(n):
        for b in range(n):
            total = 0.0
            for c in range(n):
                total += F[a, c] * Pb[c, b]
            T[a, b] = total
    # lower triangle of T F' + Q + loose, mirrored
    for a in range(n):
        for b in range(a + 1):
            total = Q[a, b] + loose[a, b]
            for c in range(n):
                total += T[a, c] * F[b, c]
            Pb[a, b] = total
            Pb[b, a] = total


@compiled
def moved(theta, centre, Pt, share, least):
    """Return whether the model must be discretized again.

    This is so if a coefficient has moved too far.
    """
    for a in range(theta.shape[0]):
        shift = abs(theta[a] - centre[a])
        if shift > least[a] and shift > share * np.sqrt(max(Pt[a, a], 0.0)):
            return True
    return False


@compiled
def linear_at(sizes, fixed, at):
    """Views of the discretized model and its derivatives, and room.

    The model is x+ = M [x; w; w+], y = O [x; w]. columns : coefficient of each derivative; rows : first
    row that it moves, and the last one + 1; varied : whether O depends on a coefficient; Oc : O at the
    present coefficients; others : room.
    """
    n, nu, ny, q = sizes[0], sizes[2], sizes[3], sizes[4]
    nz, no = n + 2 * nu, n + nu
    M, at = matrix(fixed, at, n, nz)
    O, at = matrix(fixed, at, ny, no)
    slopes, at = row(fixed, at, q * n * nz)
    shown, at = row(fixed, at, q * ny * no)
    last, at = row(fixed, at, q)
    dM, dO = slopes.reshape(q, n, nz), shown.reshape(q, ny, no)
    # most coefficients move few rows: keep the range of rows that are not zero in each dM
    columns = np.zeros(q, dtype=np.int64)
    rows = np.zeros((q, 2), dtype=np.int64)
    varied = False
    for r in range(q):
        columns[r] = int(last[r])
        for i in range(n):
            for j in range(nz):
                if dM[r, i, j] != 0.0:
                    if rows[r, 1] == 0:
                        rows[r, 0] = i
                    rows[r, 1] = i + 1
        for i in range(ny):
            for j in range(no):
                if dO[r, i, j] != 0.0:
                    varied = True
    return M, O, dM, dO, columns, rows, varied, O.copy(), np.zeros(nz), np.zeros((q, n)), np.zeros(n)


@compiled
def step_state(x, F, M, dM, columns, rows, theta, centre, step, drive):
    """Compute the next state and its transition matrix.

    Both are at the present coefficients, to first order about those of `M`.
    """
    # x+ = (M + sum_r shift_r dM_r) [x; w; w+]
    n, nz = M.shape
    apply(M, step, x)
    for i in range(n):
        for j in range(n):
            F[i, j] = M[i, j]
    for r in range(columns.shape[0]):
        shift = theta[columns[r]] - centre[columns[r]]
        for i in range(rows[r, 0], rows[r, 1]):
            total = 0.0
            for j in range(nz):
                total += dM[r, i, j] * step[j]
            drive[r, i] = total
            x[i] += shift * total
            for j in range(n):
                F[i, j] += shift * dM[r, i, j]


@compiled
def step_sensitivity(S, F, columns, rows, drive, Sn):
    """Sensitivity of the state to the coefficients."""
    # S+ = S F'
    for a in range(S.shape[0]):
        apply(F, S[a], Sn)
        put(S[a], 0, Sn)
    # plus the direct effect of each coefficient in the matrices
    for r in range(columns.shape[0]):
        for i in range(rows[r, 0], rows[r, 1]):
            S[columns[r], i] += drive[r, i]


@compiled
def shift_outputs(Oc, O, dO, columns, theta, centre):
    """Matrix of the outputs at the present coefficients."""
    put_rows(Oc, O)
    for r in range(columns.shape[0]):
        shift = theta[columns[r]] - centre[columns[r]]
        for i in range(O.shape[0]):
            for j in range(O.shape[1]):
                Oc[i, j] += shift * dO[r, i, j]


@compiled
def step_outputs(x, w, S, Oc, dO, columns, varied, yhat, h):
    """Outputs, and their sensitivity to the coefficients."""
    n, p = x.shape[0], S.shape[0]
    for i in range(yhat.shape[0]):
        # y = Oc [x; w]
        total = 0.0
        for j in range(n):
            total += Oc[i, j] * x[j]
        for j in range(w.shape[0]):
            total += Oc[i, n + j] * w[j]
        yhat[i] = total
        # h = Oc dx/dtheta + dOc/dtheta [x; w]
        for a in range(p):
            total = 0.0
            for j in range(n):
                total += Oc[i, j] * S[a, j]
            h[i, a] = total
        if varied:
            for r in range(columns.shape[0]):
                total = 0.0
                for j in range(n):
                    total += dO[r, i, j] * x[j]
                for j in range(w.shape[0]):
                    total += dO[r, i, n + j] * w[j]
                h[i, columns[r]] += total


@compiled
def through_state(H, Oc, F):
    """Outputs by the state before."""
    n = F.shape[0]
    for i in range(H.shape[0]):
        for b in range(n):
            total = 0.0
            for j in range(n):
                total += Oc[i, j] * F[j, b]
            H[i, b] = total
