"""Force laws and input effects over one sample, with derivatives."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...effects.compiled import COUNT, evaluate
from ...engine.linear import Corrections, Substep
from ...engine.march import Discretized, MarchResult
from ...jit import compiled, put, put_rows
from ...systems.linear import Array
from ..samples import Integers


class Inputs(NamedTuple):
    """Inputs over the last interval, and room to find them.

    W : nodes of the substeps, (rows, nu); Wout : at both ends; dW, dWout : their derivatives by the
    coefficients in `driven`; free : law and place of each of these, (c, 2); changed : whether an input
    has a law; delays, out, slopes, total, kept : room.
    """

    W: Array
    Wout: Array
    dW: Array
    dWout: Array
    driven: Integers
    free: Integers
    changed: NDArray[np.bool_]
    delays: Array
    out: Array
    slopes: Array
    total: Array
    kept: Array


@compiled
def inputs_of(statics, substeps, foh, nu, kept):
    """Room for the inputs of a model with these laws.

    Parameters
    ----------
    statics : ndarray of int64, shape (r, 6)
        Input laws: as `evaluate` takes it, 0 for a delay; channel; four columns in theta or -1.
    substeps, foh : int, bool
        Substeps per sample; whether inputs are linear between samples.
    nu : int
        Inputs, the constant one included.
    kept : ndarray, shape (r or 0, 6)
        Inner states of the laws, where one of them has one.
    """
    r = statics.shape[0]
    rows = substeps + 1 if foh else substeps
    free = np.zeros((4 * r, 2), dtype=np.int64)
    driven = np.zeros(4 * r, dtype=np.int64)
    changed = np.zeros(nu, dtype=np.bool_)
    count = 0
    # each coefficient that is estimated drives the inputs: note its law and its place there
    for i in range(r):
        changed[statics[i, 1]] = True
        for c in range(4):
            if statics[i, 2 + c] >= 0:
                driven[count] = statics[i, 2 + c]
                free[count, 0], free[count, 1] = i, c
                count += 1
    return Inputs(
        np.zeros((rows, nu)), np.zeros((2, nu)), np.zeros((count, rows, nu)), np.zeros((count, 2, nu)),
        driven[:count], free[:count], changed, np.zeros(nu), np.zeros((r, COUNT)), np.zeros((r, 4)),
        np.zeros((r, 4)), kept if kept.shape[0] else np.zeros((r, 6)),
    )  # fmt: skip


@compiled
def _through(value, channel, statics, levels, room, keep):
    """The laws of one input in turn.

    `room.slopes` takes the derivatives by their coefficients, the slope by the value is returned;
    `room.kept` holds inner state, its derivatives and the value of the sample before, and takes those
    of this one where `keep` is set.
    """
    kept, slopes, out = room.kept, room.slopes, room.out
    slopes[:, :] = 0.0
    # chain rule over the laws in series; `passed` is the slope of the value so far
    passed = 1.0
    for r in range(statics.shape[0]):
        if statics[r, 1] != channel or statics[r, 0] == 0:
            continue
        evaluate(statics[r, 0], value, 0.0, kept[r, 5], kept[r, 0], levels, r, 1.0, slopes[r], out)
        # derivatives of the earlier laws pass through this one
        for before in range(r):
            if statics[before, 1] == channel:
                for c in range(4):
                    slopes[before, c] *= out[r, 1]
        # derivative by its own coefficients: directly, and through the inner state
        for c in range(4):
            slopes[r, c] = out[r, 9 + c] + out[r, 4] * kept[r, 1 + c]
            if keep:
                kept[r, 1 + c] = out[r, 13 + c] + out[r, 8] * kept[r, 1 + c]
        # new inner state (backlash, hysteresis) and the value of this sample
        if keep:
            kept[r, 0], kept[r, 5] = out[r, 5], value
        value = out[r, 0]
        passed *= out[r, 1]
    return value, passed


@compiled
def keep_first(w, statics, levels, room):
    """Inner states of the laws at the first sample."""
    for channel in range(w.shape[0]):
        _through(w[channel], channel, statics, levels, room, True)


@compiled
def _input_at(ring, channel, when, foh):
    """Return the raw input and its slope at time `when`.

    `when` counts samples from the latest one (0 or negative). The slope is per sample.
    """
    last = ring.shape[0] - 1
    # the cell between two samples in which this time lies
    cell = int(np.floor(when + 1e-9))
    # before the oldest sample that is kept, and after the latest: hold the end value
    if cell < -last:
        return ring[0, channel], 0.0
    if cell >= 0:
        return ring[last, channel], 0.0
    start = ring[last + cell, channel]
    if not foh:
        return start, 0.0
    # first-order hold: linear between the samples
    rise = ring[last + cell + 1, channel] - start
    return start + (when - cell) * rise, rise


class Path(NamedTuple):
    """Way of the inputs through their laws.

    ring : last samples; statics, levels : laws and their coefficients; dt : sampling time; room : as
    `inputs_of` makes it.
    """

    ring: Array
    statics: Integers
    levels: Array
    dt: float
    room: Inputs


@compiled
def _node(when, channel, path, foh, found, slopes):
    """Compute one input at one time, and its derivatives.

    The value is written to `found`, the derivatives to `slopes` (c, nu).
    """
    ring, statics, levels, dt, room = path
    # effects act on the delayed input
    raw, rise = _input_at(ring, channel, when, foh)
    found[channel], passed = _through(raw, channel, statics, levels, room, False)
    for i in range(room.free.shape[0]):
        r, c = room.free[i, 0], room.free[i, 1]
        if statics[r, 1] == channel:
            # by a delay T: -du/dt, through the slope of the effects
            slopes[i, channel] = -rise * passed / dt if statics[r, 0] == 0 else room.slopes[r, c]


@compiled
def _mean(early, late, channel, path, s):
    """Compute the mean of a held input over a substep.

    The mean keeps the whole impulse if an edge falls inside the substep.
    """
    ring, statics, levels, dt, room = path
    # zero-order hold: where an edge falls inside the substep, take the mean of both levels
    turn = min(max(np.floor(early + 1e-9) + 1.0, early), late)
    share = (turn - early) / (late - early)
    total = room.total
    first, _ = _through(_input_at(ring, channel, early, False)[0], channel, statics, levels, room, False)
    for r in range(statics.shape[0]):
        for c in range(4):
            total[r, c] = share * room.slopes[r, c]
    last, _ = _through(_input_at(ring, channel, late, False)[0], channel, statics, levels, room, False)
    room.W[s, channel] = share * first + (1.0 - share) * last
    # derivatives: an edge moves with the delay, the levels with the other coefficients
    for i in range(room.free.shape[0]):
        r, c = room.free[i, 0], room.free[i, 1]
        if statics[r, 1] == channel:
            if statics[r, 0] == 0:
                room.dW[i, s, channel] = -(last - first) / (late - early) / dt
            else:
                room.dW[i, s, channel] = total[r, c] + (1.0 - share) * room.slopes[r, c]


@compiled
def hold(ring, substeps, foh, W, Wout):
    """Write the unchanged inputs over the last interval.

    They are taken at the nodes of the substeps and at both ends.
    """
    last = ring.shape[0] - 1
    # zero-order hold: the input of the sample before; first-order hold: linear to this sample
    for channel in range(ring.shape[1]):
        start, end = ring[last - 1, channel], ring[last, channel]
        Wout[0, channel], Wout[1, channel] = start, end
        for s in range(W.shape[0]):
            W[s, channel] = start + s / substeps * (end - start) if foh else start


@compiled
def drive(ring, statics, levels, substeps, foh, dt, room):
    """Compute inputs with effects over the last interval, with derivatives.

    The effects and delays are applied to the raw inputs.
    """
    delays, path = room.delays, Path(ring, statics, levels, dt, room)
    room.dW[:, :, :] = 0.0
    room.dWout[:, :, :] = 0.0
    delays[:] = 0.0
    # delays of one input add up
    for r in range(statics.shape[0]):
        if statics[r, 0] == 0:
            delays[statics[r, 1]] += levels[r, 0]
    for channel in range(ring.shape[1]):
        if not room.changed[channel]:
            continue
        # both ends of the interval, for the outputs
        delay = delays[channel] / dt
        for edge in range(2):
            when = edge - 1.0 - delay
            _node(when, channel, path, foh, room.Wout[edge], room.dWout[:, edge])
        # nodes of the substeps, for the state equation
        for s in range(room.W.shape[0]):
            early = s / substeps - 1.0 - delay
            if foh:
                _node(early, channel, path, foh, room.W[s], room.dW[:, s])
            else:
                _mean(early, early + 1.0 / substeps, channel, path, s)
        # last, advance the inner states of the input effects to the end of the interval
        _through(_input_at(ring, channel, -delay, foh)[0], channel, statics, levels, room, True)


class Laws(NamedTuple):
    """A model with laws, discretized: as the engine's `march` takes it.

    march : address of that; model, substeps : as there; statics, levels : laws of the inputs and their
    coefficients, as `input_laws` takes them; foh : whether inputs are linear between samples; dt : sampling
    time.
    """

    march: int
    model: Discretized
    statics: Integers
    levels: Array
    substeps: int
    foh: bool
    dt: float


@compiled
def march_of(sizes, laws, limit):
    """Room for the march over one interval.

    model : its matrices at the present coefficients; nobody : nothing that corrects; S, into :
    sensitivities of the state and results, by the coefficients and by the state before; S_settled,
    into_settled : where that no longer matters.
    """
    n, p, ny = sizes[0], sizes[1], sizes[3]
    at, ports, sensors, field = laws.model
    # own copies of the matrices: they shift with the coefficients, the given ones do not
    now = Substep(at.M.copy(), at.dM, at.linear, at.O.copy(), at.dO, at.P, at.dP)
    nobody = Corrections(
        np.zeros((2, ny)), np.zeros((2, ny), dtype=np.uint8), np.zeros((n, ny)), np.zeros((0, 0))
    )
    Y, X, F, anywhere = np.zeros((2, ny)), np.zeros((0, n)), np.zeros((0, 0)), np.full(ny, np.inf)
    # with and without sensitivities to the state before: fewer columns once it has settled
    return (
        Discretized(now, ports, sensors, field), nobody,
        np.zeros((p + n, n)), MarchResult(Y, np.zeros((2, ny, p + n)), X, F, anywhere, limit, laws.substeps),
        np.zeros((p, n)), MarchResult(Y, np.zeros((2, ny, p)), X, F, anywhere, limit, laws.substeps),
    )  # fmt: skip


@compiled
def push(ring, w):
    """The latest inputs behind those before."""
    last = ring.shape[0] - 1
    for i in range(last):
        put(ring[i], 0, ring[i + 1])
    put(ring[last], 0, w)


@compiled
def fill(values, columns, first, theta):
    """Fill in the estimated coefficients of force laws from `theta`.

    Their columns begin at `first`.
    """
    # a column of -1 marks a coefficient that is known
    for i in range(values.shape[0]):
        for c in range(4):
            if columns[i, first + c] >= 0:
                values[i, c] = theta[columns[i, first + c]]


@compiled
def shift_matrices(now, given, theta, centre):
    """Update the matrices to the present coefficients, to first order.

    The expansion is about the coefficients that the matrices were discretized for.
    """
    Ms, O, linear = now.M, now.O, now.linear
    if linear.shape[0] == 0:
        return
    # start from the matrices as discretized, for all powers of the substep
    for grade in range(Ms.shape[0]):
        put_rows(Ms[grade], given.M[grade])
    put_rows(O, given.O)
    # add the derivatives times the shift of each coefficient
    for r in range(linear.shape[0]):
        shift = theta[linear[r]] - centre[linear[r]]
        if shift == 0.0:
            continue
        for i in range(Ms.shape[1]):
            for j in range(Ms.shape[2]):
                for grade in range(Ms.shape[0]):
                    Ms[grade, i, j] += now.dM[grade, r, i, j] * shift
        for i in range(O.shape[0]):
            for j in range(O.shape[1]):
                O[i, j] += now.dO[r, i, j] * shift


@compiled
def enter(through, S):
    """Set the sensitivities at the start of the interval.

    Those to the coefficients come first, then those of the state to itself.
    """
    p, n = S.shape
    put_rows(through, S)
    # unit matrix: each state by itself at the start of the interval
    for i in range(through.shape[0] - p):
        for j in range(n):
            through[p + i, j] = 1.0 if i == j else 0.0


@compiled
def read(through, shown, Y, S, yhat, h, F, H):
    """Sensitivities and outputs at the end of the interval."""
    p, n = S.shape
    # rows of `through`: sensitivities to the coefficients, then the transition matrix
    put_rows(S, through[:p])
    for i in range(yhat.shape[0]):
        yhat[i] = Y[1, i]
        for a in range(p):
            h[i, a] = shown[1, i, a]
    for j in range(through.shape[0] - p):
        for i in range(n):
            F[i, j] = through[p + j, i]
        for i in range(yhat.shape[0]):
            H[i, j] = shown[1, i, p + j]
