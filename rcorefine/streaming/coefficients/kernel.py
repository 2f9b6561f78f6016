"""The loop over a block of samples: predict with the model at the present coefficients, compare, correct."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...effects.compiled import raise_pending
from ...engine.kernels import march_at
from ...jit import compiled, put
from ...systems.linear import Array
from ..gaps import Block
from .correction import (
    coefficient_gain,
    collect,
    forget,
    move_coefficients,
    move_state,
    moved,
    reduce_covariance,
    state_gain,
    step_covariance,
)
from .input_laws import drive, hold, inputs_of, keep_first
from .linear_model import linear_at, shift_outputs, step_outputs, step_sensitivity, step_state, through_state
from .packed import CoefficientRecord, given_at, remembered, sample_of
from .with_laws import Laws, enter, fill, march_of, push, read, shift_matrices

__all__ = ["DIVERGED", "DONE", "MOVED", "SURPRISED", "Kernel", "advance"]

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

    sizes: NDArray[np.int64]
    fixed: Array
    laws: Laws | None
    floor: Array

    def over(
        self,
        packed: Array,
        counters: NDArray[np.int64],
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
    """Follow the level of the innovations of output i; the noise is that, or what was declared, if larger."""
    count[i] += 1.0
    level[0, i] += _SHORT * (e * e - level[0, i])
    level[1, i] += max(_LONG, 1.0 - forgetting, 1.0 / count[i]) * (e * e - level[1, i])
    return max(floor[i], level[1, i], 0.5 * level[0, i])


@compiled
def _excites(i, R, h, least, power):
    """Whether the coefficients show at output i, now and by what they ever did: else nothing is forgotten."""
    doubt = 0.0
    for a in range(least.shape[0]):
        doubt += (h[i, a] * 1e6 * least[a]) ** 2
    power[0, i] += _SHORT * (doubt - power[0, i])
    power[1, i] = max(power[1, i], power[0, i])
    return doubt >= _EXCITED * R and power[0, i] >= _QUIET * power[1, i]


@compiled
def _bounded(x, limit):
    """Whether all states are numbers below a limit."""
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
    given, at = given_at(sizes, fixed)
    centre, limits, least, floor, numbers, Q, Qw = given
    share, forgetting, limit, watch = numbers[0], numbers[1], numbers[2], numbers[3]
    F, H, h, yhat, predicted, g, gain, T, loose = sample_of(sizes)
    n, nu, ny = sizes[0], sizes[2], sizes[3]
    if laws is None:
        M, O, dM, dO, columns, rows, varied, Oc, step, driven, Sn = linear_at(sizes, fixed, at)
    else:
        inputs = inputs_of(laws.statics, laws.substeps, laws.foh, nu, kept)
        Wn, Wout, dW, dWout, affected = inputs.W, inputs.Wout, inputs.dW, inputs.dWout, inputs.driven
        Ms, O, Y, S_all, SY_all, S_few, SY_few, measured, unused, none, X0, F0 = march_of(sizes, laws)
    w, anywhere = np.ones(nu), np.full(ny, np.inf)
    for k in range(block.inputs.shape[0]):
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
            if laws is None:
                put(step, 0, x)
                put(step, n, before)
                put(step, n + nu, w)
                step_state(x, F, M, dM, columns, rows, theta, centre, step, driven)
                step_sensitivity(S, F, columns, rows, driven, Sn)
                if varied:
                    shift_outputs(Oc, O, dO, columns, theta, centre)
                step_outputs(x, w, S, Oc, dO, columns, varied, yhat, h)
                if uncertain:
                    through_state(H, Oc, F)
            else:
                push(ring, w)
                shift_matrices(Ms, O, laws.Ms, laws.dMs, laws.O, laws.dO, laws.linear, theta, centre)
                fill(laws.values, laws.columns, 0, theta)
                fill(laws.outvalues, laws.outcolumns, 0, theta)
                hold(ring, laws.substeps, laws.foh, Wn, Wout)
                if laws.statics.shape[0] > 0:
                    fill(laws.levels, laws.statics, 2, theta)
                    drive(ring, laws.statics, laws.levels, laws.substeps, laws.foh, laws.dt, inputs)
                through, shown = (S_all, SY_all) if uncertain else (S_few, SY_few)
                enter(through, S)
                blew_up = march_at(
                    laws.march, Ms, laws.dMs, laws.pieces, laws.linear, O, laws.dO, laws.P, laws.dP,
                    laws.codes, laws.values, laws.columns, laws.widths, Wn, int(laws.foh), Wout, dW, dWout,
                    affected, measured, unused, none, np.zeros((0, 0)), laws.outcodes, laws.outvalues,
                    laws.outcolumns, x, z, through,
                    laws.substeps, Y, shown, X0, F0, limit, anywhere,
                    0, np.zeros((1, 0)), np.zeros(0, dtype=np.int64),
                )  # fmt: skip
                if blew_up >= 0:
                    return k, DIVERGED
                read(through, shown, Y, S, yhat, h, F, H)

            # correct with one output after the other
            put(predicted, 0, yhat)
            settled, seen = True, False
            if forgetting < 1.0:
                loose[:, :] = 0.0
            for i in range(ny):
                if not block.use[k, i]:
                    continue
                e = block.outputs[k, i] - yhat[i]
                calm = max(floor[i], level[1, i])
                R = floor[i] if frozen else _follow(i, e, floor, level, count, forgetting)
                forgets = forgetting < 1.0 and _excites(i, R, h, least, power)
                s = state_gain(i, R, Pb, F, H, gain) if uncertain else R
                spread = coefficient_gain(i, Pt, h, g)
                left = e
                if frozen:
                    collect(i, e, s + spread, delta, h, g)
                else:
                    left = move_coefficients(i, e, s + spread, theta, limits, x, S, h, g, yhat)
                if uncertain:
                    move_state(i, left, s, x, S, Pb, H, h, gain, yhat)
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
