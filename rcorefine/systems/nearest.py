"""Nearest continuous model of the same order.

It stands in for a discrete model that has no exact continuous one.
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from ..exceptions import ConversionWarning, ModelError, warn
from .balance import balance
from .conversion import d2c
from .linear import Array, LinearModel

__all__ = ["nearest_continuous"]

_FAST = 0.02  # pole in place of one without a real logarithm: gone within two samples, and still invertible
_REAL = 1e-5  # imaginary part over size below which a pole counts as real: multiple ones split by rounding
_ZERO = 1e-4  # size below which a pole counts as zero


def nearest_continuous(model: LinearModel) -> LinearModel:
    """Return the exact or the nearest continuous model of a discrete one.

    The exact one has the same samples. Where there is none, the nearest of the same order is returned. Real
    poles that are negative or zero have no real logarithm. They are moved to z = 0.02, where the mode dies
    out as fast as sampling shows, and the static gain is kept.

    Parameters
    ----------
    model : LinearModel
        Discrete model with a definite sampling time.

    Returns
    -------
    LinearModel
        Continuous model.

    Warns
    -----
    ConversionWarning
        If poles had to be moved: which, and where to.

    Examples
    --------
    >>> import warnings
    >>> import control as ct
    >>> from rcorefine.systems.linear import LinearModel
    >>> odd = LinearModel.from_statespace(ct.ss([[-0.9]], [[1.0]], [[1.0]], [[0.0]], 0.1))
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore")
    ...     near = nearest_continuous(odd).to_statespace()
    >>> bool(np.isclose(near.dcgain(), odd.to_statespace().dcgain()))
    True
    """
    moved, poles = _without_bad_poles(model)
    if poles.size:
        shown = ", ".join(f"{pole:.4g}" for pole in poles[:4].real)
        warn(
            f"system {model.name!r} has no continuous model of its order: pole(s) at {shown} have no real "
            f"logarithm. They were moved to z = {_FAST:g}, the static gain kept; discrete_system is exact",
            ConversionWarning,
        )
    try:
        return LinearModel.from_statespace(d2c(moved.to_statespace()))
    except ModelError as error:
        if not poles.size:
            warn(
                f"{error}. The bilinear transformation was taken instead; discrete_system is exact",
                ConversionWarning,
            )
        return LinearModel.from_statespace(d2c(moved.to_statespace(), method="tustin"))


def _without_bad_poles(model: LinearModel) -> tuple[LinearModel, Array]:
    """Model with poles without a real logarithm moved, and those poles.

    The model is split in two invariant subspaces (ordered Schur form and a Sylvester equation), so
    that multiple poles do no harm.
    """

    def bad(real: float, imaginary: float) -> bool:
        size = abs(complex(real, imaginary))
        return size < _ZERO or (real <= 0 and abs(imaginary) <= _REAL * size)

    units = balance(model.A)  # those of the user may be far apart
    triangle, basis, count = linalg.schur(model.A * units / units[:, None], output="real", sort=bad)
    if count == 0:
        return model, np.zeros(0)
    poles = linalg.eigvals(triangle[:count, :count])
    first, coupling, rest = triangle[:count, :count], triangle[:count, count:], triangle[count:, count:]
    apart = linalg.solve_sylvester(first, -rest, -coupling)
    n = model.n_states
    split = np.eye(n)
    split[:count, count:] = apart
    basis = basis @ split  # columns: the bad subspace, then the good one
    basis, back = units[:, None] * basis, linalg.inv(basis) / units
    gain = back[:count] @ model.B
    # the static response of the moved modes stays: (1 - z) (I - A1)^-1 B1
    gain = (1.0 - _FAST) * linalg.solve(np.eye(count) - first, gain)
    A = basis @ linalg.block_diag(_FAST * np.eye(count), rest) @ back
    B = basis @ np.vstack([gain, back[count:] @ model.B])
    return model.with_arrays(A=A, B=B), poles
