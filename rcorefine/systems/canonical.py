"""Observable canonical form, in which the paper writes its uncertainty."""

from __future__ import annotations

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from ..exceptions import ModelError
from .discretization import balanced
from .linear import Array, LinearModel

_EPS = float(np.finfo(float).eps)


def observable_form(model: LinearModel) -> tuple[LinearModel, Array]:
    """Transform a SISO model to the observable canonical form.

    The form is that of equations (10) and (11) of the paper. The first column of A holds the negative
    coefficients of the characteristic polynomial, ones stand above the diagonal, and ``C = [1, 0, ..., 0]``:
    whatever is uncertain about the transfer function is then in A and B alone. Holds in continuous and in
    discrete time; the direct feedthrough D stays as it is.

    Parameters
    ----------
    model : LinearModel
        Observable model with one input and one output.

    Returns
    -------
    canonical : LinearModel
        The same transfer function, timebase, name and signal labels. The
        states are new, and labeled ``o[0]``, ``o[1]``, ...
    T : ndarray
        Transformation, shape (n, n): the new state is ``T x``.

    Raises
    ------
    control.ControlDimension
        If the model has several inputs or outputs.
    ModelError
        If the output does not see every state.

    Examples
    --------
    >>> import control as ct
    >>> from rcorefine.systems.linear import LinearModel
    >>> model = LinearModel.from_statespace(ct.ss([[0, 1], [-2, -3]], [[0], [1]], [[1, 0]], 0))
    >>> canonical, T = observable_form(model)
    >>> print(canonical.A)
    [[-3.  1.]
     [-2.  0.]]
    """
    if model.n_inputs != 1 or model.n_outputs != 1:
        raise ct.ControlDimension(
            f"the observable canonical form is for one input and one output; model {model.name!r} has "
            f"{model.n_inputs} and {model.n_outputs}. Choose one channel, or keep the form given"
        )
    n = model.n_states
    _check_observable(model)
    coefficients = characteristic_polynomial(model.A)
    canonical = np.eye(n, k=1)
    transformation = np.zeros((n, n))
    if n:
        canonical[:, 0] = -coefficients[1:]
        transformation[0] = model.C[0]
    # Row i + 1 of T A = A_o T, solved for the next row of T.
    for i in range(n - 1):
        transformation[i + 1] = transformation[i] @ model.A + coefficients[i + 1] * model.C[0]
    output = np.zeros((1, n))
    output[:, :1] = 1.0
    return (
        model.with_arrays(
            A=canonical,
            B=transformation @ model.B,
            C=output,
            D=model.D.copy(),
            state_labels=tuple(f"o[{i}]" for i in range(n)),
        ),
        transformation,
    )


def characteristic_polynomial(A: Array) -> Array:
    """Give the coefficients of ``det(s I - A)``, highest power first.

    Taken from the Hessenberg form (La Budde's recursion) rather than from
    the eigenvalues, which lose the slow poles of a stiff model.

    Parameters
    ----------
    A : ndarray
        State matrix, shape (n, n).

    Returns
    -------
    ndarray
        Coefficients, shape (n + 1,), the first one 1.

    Examples
    --------
    >>> import numpy as np
    >>> print(characteristic_polynomial(np.array([[0.0, 1.0], [-2.0, -3.0]])))
    [1. 3. 2.]
    """
    n = A.shape[0]
    if n == 0:
        return np.ones(1)
    h = linalg.hessenberg(balanced(A)[0])
    polynomials = [np.ones(1)]
    for i in range(n):
        following = np.append(polynomials[i], 0.0)
        following[1:] -= h[i, i] * polynomials[i]
        product = 1.0
        for m in range(1, i + 1):
            product *= h[i - m + 1, i - m]
            following[m + 1 :] -= h[i - m, i] * product * polynomials[i - m]
        polynomials.append(following)
    return np.asarray(polynomials[n], dtype=float)


def _check_observable(model: LinearModel) -> None:
    """Raise an error if the model is not observable (Hautus test)."""
    n = model.n_states
    if n == 0:
        return
    a, scale = balanced(model.A)
    c = model.C * scale
    a_size = float(linalg.norm(a, 2)) or 1.0
    c_size = float(linalg.norm(c, 2)) or 1.0
    for pole in linalg.eigvals(a):
        pencil: NDArray[np.complex128] = np.vstack([(a - pole * np.eye(n)) / a_size, c / c_size])
        if linalg.svdvals(pencil)[-1] <= 10 * n * _EPS:
            raise ModelError(
                f"model {model.name!r} is not observable: its output does not see the mode at "
                f"{pole:.4g}, so it has no observable canonical form. Remove that mode, "
                "or keep the form given"
            )
