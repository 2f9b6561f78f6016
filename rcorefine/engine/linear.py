"""Simulation of linear models over a whole record.

Where numba is installed, a compiled loop over the samples is the fastest. Without it there is no loop: what
a linear recursion does over two samples is a linear recursion over half as many, so that N samples take
log2(N) products of matrices (the work-efficient scan of Blelloch, "Prefix sums and their applications",
1990). Responses to many signals share these products.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array
from .inputs import Drive

if TYPE_CHECKING:
    from .march import MarchResult

_FEW = 12  # fewer samples are faster one by one
_LARGE = 1e60  # entries of a power of the transition; beyond it one by one, to locate the overflow
_AT_ONCE = 60_000  # numbers processed together, which fit in the cache of the processor


class Substep(NamedTuple):
    """Matrices of a substep and its pieces, with derivatives.

    Attributes
    ----------
    M : ndarray, shape (grades, n, n + 2 n_w + 2 m) or (1, 2 n, n + 2 n_w + 3 m)
        Transition, and what inputs and forces at the start and at the end add: of a substep, of a quarter of
        it, and so on. Or that to the middle of a substep and to its end, with forces amid it.
    dM : ndarray, shape (grades, q, ...)
        Its derivatives by the parameters `linear`.
    linear : ndarray of int, shape (q,)
        Columns of the sensitivity that dM, dO and dP drive.
    O : ndarray, shape (n_y, n + n_w + m)
        Outputs.
    dO : ndarray, shape (q, n_y, n + n_w + m)
        Their derivatives.
    P, dP : ndarray
        What places feel, and its derivatives.
    """

    M: Array
    dM: Array
    linear: NDArray[np.int64]
    O: Array
    dO: Array
    P: Array
    dP: Array


class Corrections(NamedTuple):
    """Corrections of the states by an observer.

    Attributes
    ----------
    measured : ndarray, shape (N, n_y)
        Measured outputs.
    use : ndarray of uint8, shape (N, n_y)
        Which of them correct the states: 1 as an observer does, by the slope of the sensor's law; 2 as a
        controller that reads it.
    gain : ndarray, shape (n, n_y)
        Observer gain.
    reset : ndarray, shape (n, n) or (0, 0)
        The state becomes `reset` times the state at every sample, before anything else.
    """

    measured: Array
    use: NDArray[np.uint8]
    gain: Array
    reset: Array

    @property
    def stretches(self) -> list[tuple[slice, Array]]:
        """Return stretches with one pattern of corrections, and their gains."""
        use = self.use
        changes = np.flatnonzero((use[1:] != use[:-1]).any(axis=1)) + 1
        edges = [0, *changes.tolist(), len(use)]
        return [(slice(a, b), self.gain * use[a]) for a, b in pairwise(edges)]


def recursion(F: Array, start: Array, pushes: Array) -> Array:
    """Return x[1], ..., x[L] of x[k + 1] = F x[k] + pushes[k].

    Parameters
    ----------
    F : ndarray, shape (n, n)
        Transition.
    start : ndarray, shape (n, k)
        First states, one recursion per column.
    pushes : ndarray, shape (n, L, k)
        What is added.

    Returns
    -------
    ndarray, shape (n, L, k)

    Examples
    --------
    >>> import numpy as np
    >>> from rcorefine.engine.linear import recursion
    >>> recursion(np.array([[0.5]]), np.array([[1.0]]), np.zeros((1, 3, 1)))[0, :, 0]
    array([0.5  , 0.25 , 0.125])
    """
    n, length, columns = pushes.shape
    out = np.empty((n, length, columns))
    squared = F @ F if length > _FEW else F
    # few samples: one by one
    if length <= _FEW or not np.abs(squared).max(initial=0.0) < _LARGE:
        x = start
        for k in range(length):
            x = F @ x + pushes[:, k]
            out[:, k] = x
        return out
    half = length // 2
    # scan: x[k + 2] = F^2 x[k] + (F pushes[k] + pushes[k + 1]), half as many samples
    pairs = _times(F, pushes[:, 0 : 2 * half : 2]) + pushes[:, 1::2]
    out[:, 1::2] = recursion(squared, start, pairs)
    # samples in between, from their predecessors
    before = np.concatenate([start[:, None], out[:, 1 : length - 1 : 2]], axis=1)
    out[:, ::2] = _times(F, before) + pushes[:, ::2]
    return out


def _times(M: Array, signals: Array) -> Array:
    """Return the product of a matrix and signals (n, ...), sample by sample."""
    columns = math.prod(signals.shape[1:])  # also for models without states
    return (M @ signals.reshape(len(signals), columns)).reshape(len(M), *signals.shape[1:])


def _filter(
    Phi: Array, C: Array, stretches: list[tuple[slice, Array]], start: Array, added: Array, direct: Array,
    measured: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the states (n, N, k) before and after their corrections.

    `added`, shape (n, N - 1, k), comes to the states over a sample, `direct`, (n_y, N, k), to the outputs.
    """
    n, N, k = len(Phi), direct.shape[1], direct.shape[2]
    before = np.empty((n, N, k))
    before[:, 0] = x = start
    after = before.copy()
    for stretch, gain in stretches:
        a, last = stretch.start, min(stretch.stop, N - 1)
        pushes, F, innovation = added[:, a:last], Phi, None
        # observer: x(k+1) = Phi (x + K (y - C x - D w)) + pushes = (Phi - Phi K C) x + ...
        if gain.any():
            innovation = _times(gain, measured[:, stretch] - direct[:, stretch])
            pushes, F = pushes + _times(Phi, innovation[:, : last - a]), Phi - Phi @ gain @ C
        before[:, a + 1 : last + 1] = recursion(F, x, pushes)
        x, after[:, stretch] = before[:, last], before[:, stretch]
        # corrected states: x + K (y - C x - D w)
        if innovation is not None:
            after[:, stretch] += innovation - _times(gain @ C, before[:, stretch])
    return before, after


@np.errstate(all="ignore")  # overflow is detected below
def simulate_linear(
    at: Substep, drive: Drive, corrections: Corrections, x: Array, S: Array, into: MarchResult
) -> int:
    """Simulate a linear model with its sensitivities.

    Products over the whole record take the place of a loop.

    Parameters
    ----------
    at : Substep
        Matrices of a substep.
    drive : Drive
        Inputs.
    corrections : Corrections
        What the observer does; `use` is zero in a free run.
    x : ndarray, shape (n,)
        State at the first sample; at the last one on return.
    S : ndarray, shape (p, n)
        Its derivatives.
    into : MarchResult
        Takes outputs, sensitivities and states, as `march` has them. From where it blew up on outputs and
        states are NaN, derivatives zero.

    Returns
    -------
    int
        First sample beyond the bounds, or -1.
    """
    n, p, (N, nw), substeps = len(x), len(S), drive.Wout.shape, into.substeps
    C, D = np.ascontiguousarray(at.O[:, :n]), at.O[:, n : n + nw]
    # transition over a sample, and inputs at both ends of its substeps
    over, ends = _Sample(at.M[0], substeps), _ends(drive.W, drive.course, substeps)
    stretches = corrections.stretches
    measured = np.where(corrections.use, corrections.measured, 0.0).T[:, :, None]
    direct = (D @ drive.Wout.T)[:, :, None]
    # motion: states before and after the correction
    added = over.gathered(over.pushes(ends)[..., None])
    before, after = (
        one[:, :, 0] for one in _filter(over.Phi, C, stretches, x[:, None], added, direct, measured)
    )
    outputs, states = (C @ before + direct[:, :, 0]).T, after.T.copy()
    # first sample beyond the bounds
    inside: NDArray[np.bool_] = np.all(np.abs(outputs) <= into.far, axis=1)
    inside[1:] &= (np.abs(before[:, 1:]) < into.limit).all(axis=0)
    blew_up = -1 if inside.all() else int(inside.argmin())
    if p:
        # what the derivatives of the matrices multiply: [x; w at both ends] and [x; w]
        steps = np.concatenate([over.within(after[:, :-1], ends), ends])
        signals = np.concatenate([before, drive.Wout.T])
    # sensitivities obey the same recursion; as many at once as fit in the cache
    width = max(1, _AT_ONCE // max(n * N * substeps, 1))
    for a in range(0, p, width):
        group = np.arange(a, min(a + width, p))
        added, direct = np.zeros((n, N - 1, len(group))), np.zeros((len(C), N, len(group)))
        # parameters that change the matrices: dM [x; w], dO [x; w]
        mine = (at.linear >= a) & (at.linear <= group[-1])
        added[:, :, at.linear[mine] - a] = over.gathered(_by_each(at.dM[0][mine], steps))
        direct[:, :, at.linear[mine] - a] = _by_each(at.dO[mine], signals)
        # parameters that change the inputs
        for r in np.flatnonzero((drive.driven >= a) & (drive.driven <= group[-1])):
            column, pushes = drive.driven[r] - a, over.pushes(_ends(drive.dW[r], drive.course, substeps))
            added[:, :, column] += over.gathered(pushes[..., None])[:, :, 0]
            direct[:, :, column] += D @ drive.dWout[r].T
        moved, final = _filter(over.Phi, C, stretches, S[group].T, added, direct, 0.0 * measured)
        S[group] = final[:, -1].T
        into.sensitivity[:, :, group] = (_times(C, moved) + direct).transpose(1, 0, 2)
    x[:] = states[-1]
    end = N if blew_up < 0 else blew_up
    into.outputs[:end], into.sensitivity[end:] = outputs[:end], 0.0
    if len(into.states):
        into.states[:end] = states[:end]
    return blew_up


class _Sample:
    """Transition over one sample, in substeps."""

    def __init__(self, M: Array, substeps: int) -> None:
        n = len(M)
        self._step, self._input = M[:, :n], M[:, n:]
        self._powers = [np.eye(n)]
        for _ in range(substeps):
            self._powers.append(self._step @ self._powers[-1])
        self.Phi = self._powers[-1]

    def pushes(self, ends: Array) -> Array:
        """Return what inputs add over each substep, (n, N - 1, substeps)."""
        return _times(self._input, ends)

    def gathered(self, pushes: Array) -> Array:
        """Return what pushes (n, N - 1, substeps, k) add over each sample."""
        last = pushes.shape[2] - 1
        found = pushes[:, :, last]
        # carry the push of each substep to the end of the sample
        for j in range(last):
            found = found + _times(self._powers[last - j], pushes[:, :, j])
        return found

    def within(self, states: Array, ends: Array) -> Array:
        """Return the states (n, N - 1, substeps) at the start of each substep."""
        found, pushes = np.empty((len(states), *ends.shape[1:])), self.pushes(ends)
        for j in range(ends.shape[2]):
            found[:, :, j] = states
            states = self._step @ states + pushes[:, :, j]
        return found


def _ends(W: Array, course: int, substeps: int) -> Array:
    """Return the inputs at both ends of each substep.

    The shape is (2 n_w, N - 1, substeps); see `Drive`.
    """
    before, after = {0: (W, W), 1: (W[:-1], W[1:]), 2: (W[::2], W[1::2])}[course]
    return np.concatenate([before, after], axis=1).T.reshape(2 * W.shape[1], -1, substeps)


def _by_each(maps: Array, signals: Array) -> Array:
    """Return q maps (q, a, b) of signals (b, ...), stacked last."""
    found = maps.reshape(-1, len(signals)) @ signals.reshape(len(signals), -1)
    return np.moveaxis(found.reshape(*maps.shape[:2], *signals.shape[1:]), 0, -1)


@np.errstate(all="ignore")  # overflow is detected by the callers
def unit_responses(A: Array, C: Array, samples: int) -> Array:
    """Return C A^k, the outputs (N, n_y, n) from unit initial states."""
    found = np.empty((samples, *C.shape))
    found[0], count = C, 1
    while count < samples:  # each product doubles the number of samples
        more = min(count, samples - count)
        found[count : count + more] = found[:more] @ A
        A, count = A @ A, count + more
    return found


@np.errstate(all="ignore")  # divergence shows in the result
def state_power(A: Array, B: Array, W: Array) -> Array:
    """Return the mean square of each state, from rest, with inputs (N, n_w)."""
    states = recursion(A, np.zeros((len(A), 1)), (B @ W.T)[:, :, None])[:, :, 0]
    return np.asarray(np.mean(states**2, axis=1)) if len(W) else np.zeros(len(A))


@np.errstate(all="ignore")
def observed(Phi: Array, C: Array, K: Array, measured: Array, restarts: NDArray[np.uint8]) -> Array:
    """Return the states of an observer, corrected by each sample.

    Parameters
    ----------
    Phi : ndarray, shape (n, n)
        Transition over one sample.
    C : ndarray, shape (n_y, n)
        Outputs.
    K : ndarray, shape (n, n_y)
        Gain.
    measured : ndarray, shape (N, n_y)
        Measured outputs.
    restarts : ndarray of uint8, shape (N,)
        Where it begins anew from rest.

    Returns
    -------
    ndarray, shape (n, N)
    """
    n, N = len(Phi), len(measured)
    found = np.empty((n, N))
    # between restarts: observer from rest, without inputs
    for a, b in pairwise([0, *(np.flatnonzero(restarts[1:]) + 1), N]):
        added, none = np.zeros((n, b - a - 1, 1)), np.zeros((len(C), b - a, 1))
        part = measured[a:b].T[:, :, None]
        found[:, a:b] = _filter(Phi, C, [(slice(0, b - a), K)], np.zeros((n, 1)), added, none, part)[1][
            :, :, 0
        ]
    return found


@np.errstate(all="ignore")
def linear_responses(
    Phi: Array,
    drives: tuple[Array, Array],
    C: Array,
    D: Array,
    signals: Array,
    *,
    gain: Array | None = None,
    restarts: NDArray[np.uint8] | None = None,
) -> Array:
    """Outputs that each of several signals adds, from rest.

    Parameters
    ----------
    Phi : ndarray, shape (n, n)
        Transition over one sample.
    drives : two ndarrays, each of shape (n, k)
        Of a signal that falls from one to zero over the sample, and of one that rises.
    C, D : ndarray, shapes (n_y, n) and (n_y, k)
        Outputs.
    signals : ndarray, shape (N, k)
        One per column.
    gain : ndarray, shape (n, n_y), optional
        Of an observer; a free run without it.
    restarts : ndarray of uint8, shape (N,), optional
        Where the run begins anew from rest.

    Returns
    -------
    ndarray, shape (N, n_y, k)
    """
    (N, k), n = signals.shape, len(Phi)
    K = np.zeros((n, len(C))) if gain is None else gain
    edges = [0, *([] if restarts is None else np.flatnonzero(restarts[1:]) + 1), N]
    out = np.empty((N, len(C), k))
    width = max(1, _AT_ONCE // max(n * N, 1))
    for group in (slice(a, a + width) for a in range(0, k, width)):
        falling, rising, through = (one[:, None, group] for one in (*drives, D))
        for a, b in pairwise(edges):
            # first-order hold: the input falls from one sample and rises to the next
            F = signals[a:b, group]
            added, direct = falling * F[:-1] + rising * F[1:], through * F
            start, nothing = np.zeros((n, F.shape[1])), np.zeros((len(C), b - a, 1))
            states, _ = _filter(Phi, C, [(slice(0, b - a), K)], start, added, direct, nothing)
            out[a:b, :, group] = (_times(C, states) + direct).transpose(1, 0, 2)
    return out
