"""The refined model: the initial one with the static correction in feedback."""

from __future__ import annotations

import numpy as np

from ...systems.linear import Array, LinearModel
from .arrays import Plant

__all__ = ["refined", "with_lags"]


def refined(model: LinearModel, plant: Plant, theta: Array, order: int, name: str) -> LinearModel:
    """Close the loop u = theta psi around the discrete model.

    Parameters
    ----------
    model : LinearModel
        Discrete initial model, for labels and timebase.
    plant : Plant
        Its arrays with B_u and D_u.
    theta : ndarray
        Coefficients in physical units, shape (l_u, l_psi).
    order : int
        n_c of the static stage; with 0 the model keeps its n states (the
        paper's (44): A + B_u theta_x, B + B_u theta_w).
    name : str
        Name of the refined system.
    """
    n, n_w = plant.B.shape
    if order > 0:
        return with_lags(model, plant, theta, order, name)
    on_x, on_w = theta[:, :n], theta[:, n : n + n_w]
    return model.with_arrays(
        A=plant.A + plant.Bu @ on_x,
        B=plant.B + plant.Bu @ on_w,
        C=plant.C + plant.Du @ on_x,
        D=plant.D + plant.Du @ on_w,
        name=name,
    )


def with_lags(model: LinearModel, plant: Plant, theta: Array, order: int, name: str) -> LinearModel:
    """Close a loop that remembers: the states are x and the past n_c samples of x, w and u."""
    n, n_w = plant.B.shape
    l_u = plant.Bu.shape[1]
    first_w, first_u = (order + 1) * n, (order + 1) * (n + n_w)
    on_x, on_w, on_u = theta[:, :first_w], theta[:, first_w:first_u], theta[:, first_u:]
    # u = K [x; past x; past w; past u] + L w
    gain = np.hstack([on_x, on_w[:, n_w:], on_u])
    feed = on_w[:, :n_w]
    size = gain.shape[1]
    a, b = np.zeros((size, size)), np.zeros((size, n_w))
    a[:n, :n], b[:n] = plant.A, plant.B
    a[:n] += plant.Bu @ gain
    b[:n] += plant.Bu @ feed
    _shift(a, n, 0, n, order)  # x(k) enters its own past
    past_w, past_u = first_w, first_w + order * n_w
    b[past_w : past_w + n_w] = np.eye(n_w)
    _shift(a, past_w + n_w, past_w, n_w, order - 1)
    a[past_u : past_u + l_u], b[past_u : past_u + l_u] = gain, feed
    _shift(a, past_u + l_u, past_u, l_u, order - 1)
    c = np.hstack([plant.C, np.zeros((plant.C.shape[0], size - n))]) + plant.Du @ gain
    labels = list(model.state_labels)
    for names, count in ((model.state_labels, n), (model.input_labels, n_w), (("correction",), l_u)):
        for lag in range(1, order + 1):
            labels += [f"{names[i % len(names)]}[{i}](k-{lag})" for i in range(count)]
    return model.with_arrays(
        A=a, B=b, C=c, D=plant.D + plant.Du @ feed, state_labels=tuple(labels), name=name
    )


def _shift(a: Array, to: int, source: int, width: int, times: int) -> None:
    """Copy `times` blocks of `width` states one place on."""
    count = width * times
    a[to : to + count, source : source + count] += np.eye(count)
