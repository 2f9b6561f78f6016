"""Linear models over a record: the compiled loop and the blocks against a loop written out here."""

from __future__ import annotations

import numpy as np
import pytest

from rcorefine.engine import linear
from rcorefine.engine import march as marching
from rcorefine.engine.inputs import Drive


def case(rng, n=3, nw=2, ny=2, N=150, p=4, substeps=1, course=0, pattern="off", radius=0.98):
    """A random model with sensitivities: matrices, inputs, corrections, first state, substeps, bounds."""
    A = rng.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max(initial=1e-300)
    rows = rng.permutation(p)[:2]
    at = linear.Substep(
        np.hstack([A, rng.standard_normal((n, 2 * nw))])[None],
        rng.standard_normal((1, 2, n, n + 2 * nw)),
        rows,
        rng.standard_normal((ny, n + nw)),
        rng.standard_normal((2, ny, n + nw)),
        np.zeros((0, n + nw)),
        np.zeros((0, 0, n + nw)),
    )
    points = {0: (N - 1) * substeps, 1: (N - 1) * substeps + 1, 2: 2 * (N - 1) * substeps}[course]
    W, Wout = rng.standard_normal((points, nw)), rng.standard_normal((N, nw))
    drive = Drive(
        W, course, Wout, rng.standard_normal((1, points, nw)), rng.standard_normal((1, N, nw)),
        np.array([rows[0]]),
    )  # fmt: skip
    measured, use = rng.standard_normal((N, ny)), np.zeros((N, ny), dtype=np.uint8)
    if pattern == "gaps":
        use[:] = rng.random((N, ny)) < 0.9
        measured[use == 0] = np.nan
    if pattern == "windows":
        use[: N // 2] = 1
    corrections = linear.Corrections(measured, use, 0.02 * rng.standard_normal((n, ny)), np.zeros((0, 0)))
    x, S = rng.standard_normal(n), rng.standard_normal((p, n))
    return at, drive, corrections, x, S, substeps, np.full(ny, 1e30), 1e30


def room(given):
    *_, x, S, substeps, far, limit = given
    N, ny = given[2].measured.shape
    y, X = np.full((N, ny), np.nan), np.full((N, len(x)), np.nan)
    return marching.MarchResult(y, np.zeros((N, ny, len(S))), X, np.zeros((0, 0)), far, limit, substeps)


def in_blocks(*given):
    """The record by products over all of it."""
    at, drive, corrections, x, S, *_ = given
    into = room(given)
    blew_up = linear.simulate_linear(at, drive, corrections, x.copy(), S.copy(), into)
    return into.outputs, into.sensitivity, into.states, blew_up


def sample_by_sample(*given):
    """The march, with no law."""
    at, drive, corrections, x, S, *_ = given
    into, ny, none = room(given), given[2].measured.shape[1], np.zeros(0, dtype=np.int64)
    nothing = np.full((0, 4), -1), np.full((ny, 4), -1)
    model = marching.Discretized(
        at, marching.PortLaws(none, np.zeros((0, 7)), nothing[0], np.zeros(0)),
        marching.SensorLaws(np.zeros(ny, dtype=np.int64), np.zeros((ny, 4)), nothing[1]),
        marching.FieldLaw(0, np.zeros((1, 0)), none),
    )  # fmt: skip
    with np.errstate(all="ignore"):
        blew_up = marching.march(
            model, drive, corrections, marching.MarchState(x.copy(), np.zeros(ny), S.copy()), into
        )
    return into.outputs, into.sensitivity, into.states, blew_up


def by_hand(at, drive, corrections, x, S, substeps, far, limit):
    """Outputs, sensitivities and corrected states, sample by sample."""
    n, (N, ny) = len(x), corrections.measured.shape
    x, S = x.copy(), S.copy()
    y, slopes, X = np.zeros((N, ny)), np.zeros((N, ny, len(S))), np.zeros((N, n))
    for k in range(N):
        seen = np.concatenate([x, drive.Wout[k]])
        y[k], rise = at.O @ seen, at.O[:, :n] @ S.T
        rise[:, at.linear] += (at.dO @ seen).T
        rise[:, drive.driven] += at.O[:, n:] @ drive.dWout[:, k].T
        slopes[k] = rise
        for i in np.flatnonzero(corrections.use[k]):
            x = x + corrections.gain[:, i] * (corrections.measured[k, i] - y[k, i])
            S = S - np.outer(rise[i], corrections.gain[:, i])
        X[k] = x
        for j in range(substeps if k < N - 1 else 0):
            row = (k * substeps + j) * max(drive.course, 1)
            after = row + min(drive.course, 1)
            step = np.concatenate([x, drive.W[row], drive.W[after]])
            x, S = at.M[0] @ step, S @ at.M[0][:, :n].T
            S[at.linear] += at.dM[0] @ step
            both = np.concatenate([drive.dW[:, row], drive.dW[:, after]], axis=1)
            S[drive.driven] += both @ at.M[0][:, n:].T
    return y, slopes, X


@pytest.mark.parametrize("body", [sample_by_sample, in_blocks])
@pytest.mark.parametrize("pattern", ["off", "gaps", "windows"])
@pytest.mark.parametrize(("substeps", "course"), [(1, 0), (1, 1), (4, 1), (3, 2)])
def test_states_outputs_and_derivatives_are_those_of_the_loop(body, pattern, substeps, course):
    given = case(np.random.default_rng(5), substeps=substeps, course=course, pattern=pattern)
    y, slopes, X, blew_up = body(*given)
    assert blew_up == -1
    for found, wanted in zip((y, slopes, X), by_hand(*given), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-10, atol=1e-10 * np.abs(wanted).max())


@pytest.mark.parametrize("body", [sample_by_sample, in_blocks])
def test_an_unstable_run_ends_at_the_sample_at_which_it_leaves_the_bounds(body):
    at, drive, corrections, x, S, substeps, far, limit = case(np.random.default_rng(6), radius=3.0, N=400)
    y, slopes, _, blew_up = body(at, drive, corrections, x, S, substeps, far, limit)
    wanted = by_hand(at, drive, corrections, x, S, substeps, far, limit)[0]
    assert blew_up == int(np.argmax((np.abs(wanted) > far).any(axis=1)))
    np.testing.assert_allclose(y[:blew_up], wanted[:blew_up], rtol=1e-9)
    assert np.isnan(y[blew_up + 1 :]).all()
    assert not slopes[blew_up + 1 :].any()


def test_many_columns_are_cut_where_the_cache_ends(monkeypatch):
    given = case(np.random.default_rng(7), substeps=2, pattern="gaps")
    whole = in_blocks(*given)
    monkeypatch.setattr(linear, "_AT_ONCE", 1)
    for one, other in zip(whole, in_blocks(*given), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_responses_and_an_observer_restart_from_rest():
    rng = np.random.default_rng(8)
    Phi, C, K = (
        0.5 * rng.standard_normal((2, 2)),
        rng.standard_normal((1, 2)),
        0.1 * rng.standard_normal((2, 1)),
    )
    falling, rising, D = rng.standard_normal((2, 3)), rng.standard_normal((2, 3)), rng.standard_normal((1, 3))
    signals, restarts = rng.standard_normal((60, 3)), np.zeros(60, dtype=np.uint8)
    restarts[[0, 25]] = 1
    found = linear.linear_responses(Phi, (falling, rising), C, D, signals, gain=K, restarts=restarts)
    states = linear.observed(Phi, C, K, signals[:, :1], restarts)
    for k in range(60):
        if restarts[k]:
            x, z = np.zeros((2, 3)), np.zeros(2)
        y = C @ x + D * signals[k]
        np.testing.assert_allclose(found[k], y, rtol=1e-10, atol=1e-12)
        z = z + K @ (signals[k, :1] - C @ z)
        np.testing.assert_allclose(states[:, k], z, rtol=1e-10, atol=1e-12)
        if k < 59:
            x = Phi @ (x - K @ y) + falling * signals[k] + rising * signals[k + 1]
        z = Phi @ z
