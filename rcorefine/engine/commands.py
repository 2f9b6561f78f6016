"""Effects at an input inside of a closed loop.

A controller drives the input, so what acts on the plant depends on the outputs of the model: it is not known
before the simulation. Here the simulation goes from sample to sample. At each one the outputs correct the
states of the controller; its command, held over the sample, passes the effects of the input; and the model
moves on to the next sample, driven by what comes out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..effects.compiled import COUNT, MAX_COEFFICIENTS, evaluate
from ..effects.formula import InputLaw
from ..jit import compiled
from ..systems.linear import Array
from .controlled import closes_loop
from .inputs import Drive, InputSignal
from .linear import Corrections
from .march import MarchResult, MarchState, march_at

if TYPE_CHECKING:
    from .structure import Structure

_SETTLED = 1e200  # seconds for which a command had its first value before the record


class Commands(NamedTuple):
    """Driven inputs with effects.

    Attributes
    ----------
    channels, held : ndarray of int, shape (k,)
        Inputs, and the states that hold what the controller adds to them.
    first : ndarray of int, shape (k + 1,)
        Where the laws of each input begin among all of them.
    codes : ndarray of int, shape (l,)
        Laws, as `evaluate` takes them.
    values : ndarray, shape (l, 4)
        Their coefficients.
    given : ndarray, shape (k, N)
        Commands as recorded.
    weights : ndarray, shape (k, substeps, depth)
        Means over the substeps, by the commands of this sample and of those before.
    late : ndarray of int, shape (k,)
        How many samples ago the command was given that acts at a sample.
    levels : ndarray, shape (k, 2)
        Absolute value of a zero command, and of what acts then.
    before : float
        Share of the first command that acted before the record.
    dt : float
        Sampling time in s.
    """

    channels: NDArray[np.int64]
    held: NDArray[np.int64]
    first: NDArray[np.int64]
    codes: NDArray[np.int64]
    values: Array
    given: Array
    weights: Array
    late: NDArray[np.int64]
    levels: Array
    before: float
    dt: float


class _Past(NamedTuple):
    """Results of the laws at each sample, and their memory.

    Attributes
    ----------
    V, dV : ndarray, shape (k, N) and (k, N, p)
        Results, and their derivatives.
    memory, slopes : ndarray, shape (l, 2) and (l, 2, p)
        Inner states and commands before, and their derivatives.
    """

    V: Array
    dV: Array
    memory: Array
    slopes: Array


def commands(structure: Structure, theta: Array, signal: InputSignal, lead: Array | None) -> Commands | None:
    """Return the driven inputs with effects, or None where the loop is open.

    Parameters
    ----------
    structure : Structure
        Model with its controller, and effects.
    theta : ndarray, shape (p,)
        Coefficients.
    signal : InputSignal
        Inputs of the record.
    lead : ndarray, shape (n, n_y), or None
        Gain on the errors of the outputs; the loop is closed if it moves the states of the controller.
    """
    model, loop = structure.model, structure.loop
    if model.controller is None or not closes_loop(structure, lead):
        return None
    driven = model.controller.driven
    channels = sorted({channel for _, channel in structure.input_statics} & set(driven))
    if not channels:
        return None
    # laws of each driven input in their order; its delays add up
    first, codes, values, delays, levels = [0], [], [], [], []
    for channel in channels:
        here = [index for index, at in structure.input_statics if at == channel]
        level = 0.0 if model.operating_point is None else float(model.operating_point.inputs[channel])
        # laws act on absolute commands: start from the operating point
        rest, delay = level, 0.0
        for index in here:
            law, row = structure.effects[index].spec, structure.law_values(theta, index)
            if law.delays:
                delay += row[0]
                continue
            assert isinstance(law, InputLaw)
            codes.append(law.code)
            values.append(np.pad(row, (0, MAX_COEFFICIENTS - len(row))))
            if structure.balanced:
                # constant that leaves the laws at the operating point, subtracted later
                rest = float(law.through(np.array([rest]), *row, step=_SETTLED)[0][0])
        first.append(len(codes))
        # holding the command of a continuous controller delays it by half a sample
        held = 0.0 if model.controller.sampled else 0.5
        delays.append(max(delay / signal.dt - held, 0.0))
        levels.append((level, rest))
    depth = int(max(delays)) + 2
    edges = np.arange(signal.substeps + 1) / signal.substeps
    # share of each substep in which the command of j samples ago acts, (k, substeps, depth)
    begun = edges[:, None] - np.array(delays)[:, None, None] + np.arange(depth)
    start = loop.stop - len(driven)
    return Commands(
        np.array(channels), np.array([start + driven.index(channel) for channel in channels]),
        np.array(first), np.array(codes, dtype=np.int64), np.array(values).reshape(-1, MAX_COEFFICIENTS),
        np.ascontiguousarray(signal.inputs[channels, signal.past :]),
        np.diff(np.clip(begun, 0.0, 1.0), axis=1) * signal.substeps,
        np.ceil(np.array(delays) - 1e-9).astype(np.int64), np.array(levels), signal.before, signal.dt,
    )  # fmt: skip


@compiled
def _pass(loop, past, i, k, x, S, keep):  # type: ignore[no-untyped-def]
    """Pass a command through the laws of its input.

    With `keep` the laws remember it.
    """
    memory, slopes = past.memory, past.slopes
    p, out, nothing = S.shape[0], np.zeros((loop.codes.shape[0], COUNT)), np.zeros(0)
    # command = recorded one + what the controller adds, around the operating point
    value, moved = loop.given[i, k] + x[loop.held[i]] + loop.levels[i, 0], np.zeros(p)
    for r in range(p):
        moved[r] = S[r, loop.held[i]]
    # laws in series: the output of one is the input of the next
    for law in range(loop.first[i], loop.first[i + 1]):
        last = value if k == 0 else memory[law, 1]
        lasts = _SETTLED if k == 0 and loop.before > 0.0 else loop.dt
        evaluate(loop.codes[law], value, 1.0, last, memory[law, 0], loop.values, law, lasts, nothing, out)
        # chain rule: by the command now, the command before and the inner state
        for r in range(p):
            now, before, inner = moved[r], moved[r] if k == 0 else slopes[law, 1, r], slopes[law, 0, r]
            moved[r] = out[law, 1] * now + out[law, 3] * before + out[law, 4] * inner
            if keep:
                slopes[law, 0, r] = out[law, 6] * now + out[law, 7] * before + out[law, 8] * inner
                slopes[law, 1, r] = now
        if keep:
            memory[law, 0], memory[law, 1] = out[law, 5], value
        value = out[law, 0]
    # back to deviations from the operating point
    past.V[i, k] = value - loop.levels[i, 1]
    for r in range(p):
        past.dV[i, k, r] = moved[r]


@compiled
def _ago(row, k, j, before):  # type: ignore[no-untyped-def]
    """Return what came out j samples before sample k."""
    return row[k - j] if j <= k else before * row[0]


@compiled
def _reset(reset, x, S, ahead, S_ahead):  # type: ignore[no-untyped-def]
    """Apply the jump of a sample to a copy of the states."""
    for a in range(x.shape[0]):
        ahead[a] = 0.0
        for b in range(x.shape[0]):
            ahead[a] += reset[a, b] * x[b]
        for r in range(S.shape[0]):
            S_ahead[r, a] = 0.0
            for b in range(x.shape[0]):
                S_ahead[r, a] += reset[a, b] * S[r, b]


@compiled
def _at_sample(loop, past, k, x, S, keep, Wout, dWout):  # type: ignore[no-untyped-def]
    """Enter what acts at a sample.

    The model adds what the controller holds.
    """
    for i in range(loop.channels.shape[0]):
        channel, held, late = loop.channels[i], loop.held[i], loop.late[i]
        _pass(loop, past, i, k, x, S, keep)
        # the model adds the held command itself, so it is subtracted from the delayed one
        Wout[k, channel] = _ago(past.V[i], k, late, loop.before) - x[held]
        for r in range(S.shape[0]):
            dWout[r, :, channel] = _ago(past.dV[i, :, r], k, late, loop.before) - S[r, held]


@compiled
def _over_sample(loop, past, k, x, S, W, dW):  # type: ignore[no-untyped-def]
    """Enter what acts over the substeps up to the next sample."""
    for i in range(loop.channels.shape[0]):
        channel, held = loop.channels[i], loop.held[i]
        for s in range(W.shape[0]):
            W[s, channel] = -x[held]
            for r in range(S.shape[0]):
                dW[r, s, channel] = -S[r, held]
            # mean of the delayed command over the substep; W has both ends of each substep
            for j in range(loop.weights.shape[2]):
                weight = loop.weights[i, s // 2, j]
                W[s, channel] += weight * _ago(past.V[i], k, j, loop.before)
                for r in range(S.shape[0]):
                    dW[r, s, channel] += weight * _ago(past.dV[i, :, r], k, j, loop.before)


@compiled
def march_in_loop(at_march, model, drive, observer, course, into, loop):  # type: ignore[no-untyped-def]
    """March from sample to sample; return the first that blew up, or -1.

    Parameters
    ----------
    at_march : int
        Address of `march`.
    model, drive, observer, course, into
        As in `march`; both ends of every substep stand in the drive (course 2).
    loop : Commands
        Driven inputs.

    Notes
    -----
    What a sensor remembers goes on from sample to sample; its derivatives do not, and are those of a sensor
    at rest.
    """
    x, S, W, Wout, rows = course.x, course.S, drive.W, drive.Wout, 2 * into.substeps
    (samples, nw), (p, n), ny = Wout.shape, S.shape, observer.measured.shape[1]
    ports, laws, inputs = model.ports.codes.shape[0], loop.codes.shape[0], loop.channels.shape[0]
    past = _Past(
        np.zeros((inputs, samples)), np.zeros((inputs, samples, p)), np.zeros((laws, 2)),
        np.zeros((laws, 2, p)),
    )  # fmt: skip
    driven = np.arange(p)
    # derivatives of the inputs, which depend on the parameters through the loop: (p, rows, n_w)
    dW, dW1, dW2 = np.zeros((p, rows, nw)), np.zeros((p, 1, nw)), np.zeros((p, 2, nw))
    nobody = Corrections(
        np.zeros((2, ny)), np.zeros((2, ny), dtype=np.uint8), observer.gain, np.zeros((0, 0))
    )
    # results between the samples, which nobody reads
    aside = MarchResult(
        np.zeros((2, ny)), np.zeros((2, ny, p)), into.states[:0], into.forces[:0], np.full(ny, np.inf),
        into.limit, into.substeps,
    )  # fmt: skip
    ahead, S_ahead = np.zeros(n), np.zeros((p, n))
    for k in range(samples):
        # before the correction: direct feedthrough must not depend on the correction of the same sample
        _reset(observer.reset, x, S, ahead, S_ahead)
        _at_sample(loop, past, k, ahead, S_ahead, False, Wout, dW1)
        here = slice(k, k + 1)
        # outputs at the sample, and the controller's correction of the states; no time passes
        found = march_at(
            at_march, model, Drive(W[:0], 2, Wout[here], dW, dW1, driven),
            Corrections(observer.measured[here], observer.use[here], observer.gain, observer.reset), course,
            MarchResult(
                into.outputs[here], into.sensitivity[here], into.states[here], into.forces[here], into.far,
                into.limit, into.substeps,
            ),
        )  # fmt: skip
        if found >= 0:
            return k
        # the corrected command, which the laws remember
        _at_sample(loop, past, k, x, S, True, Wout, dW2)
        if k == samples - 1:
            break
        # integrate over the substeps to the next sample, without a correction
        acting = W[rows * k : rows * (k + 1)]
        _over_sample(loop, past, k, x, S, acting, dW)
        found = march_at(
            at_march, model, Drive(acting, 2, Wout[k : k + 2], dW, dW2, driven), nobody,
            MarchState(x, course.z[:ports], S), aside,  # between samples no sensor is read
        )  # fmt: skip
        if found >= 0:
            return k + 1
    return -1
