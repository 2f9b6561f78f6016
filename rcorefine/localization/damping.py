"""Damping that is one number: every modal ratio scaled alike."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..effects.bodies import ConstantForce
from ..effects.effect import Effect
from ..engine.structure import Parameter, Structure
from ..exceptions import ModelError
from ..models.physical_model import PhysicalModel
from ..systems.linear import Array

RATIO_NAMES = ("damping ratio", "share that follows")
_ITERATIONS = 60


def square_root(X: NDArray[Any]) -> NDArray[Any]:
    """Return the principal square root of a matrix.

    It uses the product form of the Newton iteration (Denman and Beavers). The result is analytic in the
    entries of X, so that a complex step gives exact derivatives (an eigenvalue routine would not).

    Parameters
    ----------
    X : ndarray, shape (n, n)
        Matrix without eigenvalues on the negative real axis; real or complex.

    Returns
    -------
    ndarray, shape (n, n)
        Y with Y @ Y = X.

    Examples
    --------
    >>> import numpy as np
    >>> bool(np.allclose(square_root(np.array([[4.0, 1.0], [0.0, 9.0]])), [[2.0, 0.2], [0.0, 3.0]]))
    True
    """
    # real matrix with real roots: by eigenvalues, faster
    if not np.iscomplexobj(X):
        values, vectors = np.linalg.eig(X)
        root = (vectors * np.sqrt(values.astype(complex))) @ np.linalg.inv(vectors)
        if np.abs(root.imag).max() <= 1e-9 * np.abs(root.real).max():
            return np.asarray(root.real)
    # scale the eigenvalues to about one, for fast convergence
    scale = float(np.abs(np.trace(X.real))) / X.shape[0] or 1.0
    Y, Z = X / scale, np.eye(X.shape[0], dtype=X.dtype)
    # Denman and Beavers: Y -> X^(1/2), Z -> X^(-1/2)
    for _ in range(_ITERATIONS):
        previous = Y
        Y, Z = 0.5 * (Y + np.linalg.inv(Z)), 0.5 * (Z + np.linalg.inv(Y))
        if np.abs(Y - previous).max() <= 1e-14 * np.abs(Y).max():
            break
    return np.asarray(Y * np.sqrt(scale))


def mechanical_pairs(model: PhysicalModel) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Displacement states and the velocity states that are their rates.

    Parameters
    ----------
    model : PhysicalModel
        Model.

    Returns
    -------
    displacements, velocities : ndarray of int
        Indices, empty where no state is the rate of another.
    """
    A = model.linear.A
    pairs = []
    # rows of A with a single 1 off the diagonal: x1' = x2
    for i, row in enumerate(A):
        nonzero = np.flatnonzero(row)
        if nonzero.size == 1 and nonzero[0] != i and row[nonzero[0]] == 1.0:
            pairs.append((i, int(nonzero[0])))
    found = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]


class RatioStructure(Structure):
    """Structure with scaled damping that may follow the stiffness.

    The damping part of the state matrix is
    ``(1 + s) [(1 - f) D0 + f D0 X0^(-1/2) X^(1/2)]``, with D0 the model's damping and X, X0
    the stiffness over mass, damaged and not. f = 1 keeps every modal damping *ratio* of
    the damaged structure at (1 + s) times the model's, f = 0 keeps the damping *matrix*.

    Parameters
    ----------
    model : PhysicalModel
        Initial model with damping.
    effects : sequence of Effect
        What is added.
    constants : mapping, optional
        As for `Structure`.

    Raises
    ------
    ModelError
        If the model has no damping to scale, or is not in displacements and velocities.
    """

    def __init__(
        self,
        model: PhysicalModel,
        effects: Sequence[Effect] = (),
        *,
        constants: Mapping[int, float] | None = None,
    ) -> None:
        carriers = [port.name for port in model.ports if port.kind == "mechanical"]
        displacements, velocities = mechanical_pairs(model)
        if not carriers or displacements.size == 0:
            raise ModelError(
                "damping='ratio' needs displacements and velocities as states; use damping='links' or 'fixed'"
            )
        # the two numbers belong to an effect that does nothing
        carrier = Effect(ConstantForce.name, carriers[0], fixed={"force": 0.0}, name=RATIO_NAMES[0])
        super().__init__(model, [*effects, carrier], constants=constants)
        # block of stiffness over mass, and block of damping over mass
        self._rows = velocities
        self._stiff = np.ix_(velocities, displacements)
        self._damp = np.ix_(velocities, velocities)
        self._start = super().start()
        base = super().matrices(self._start).A.real
        self._nominal = base[self._damp].copy()
        if not self._nominal.any():
            raise ModelError(
                "damping='ratio': the model has no damping to scale; give it some or use 'links'"
            )
        # positive definite: no rigid-body motion
        X = -base[self._stiff]
        if np.min(np.linalg.eigvals(X).real) <= 1e-12 * np.abs(X).max():
            raise ModelError(
                "damping='ratio': the model moves freely as a rigid body, so its damping ratios are not "
                "defined; use damping='links' or 'fixed'"
            )
        # D0 X0^(-1/2): damping per root of stiffness over mass
        self._ratio: Array = self._nominal @ np.linalg.inv(square_root(X))
        # two more parameters: factor of the damping, and the share that follows the stiffness
        index = len(self.effects) - 1
        self.ratio_columns = (len(self.parameters), len(self.parameters) + 1)
        self.parameters.append(Parameter(index, "ratio", RATIO_NAMES[0], -0.999, np.inf))
        self.parameters.append(Parameter(index, "follows", RATIO_NAMES[1], -2.0, 3.0, 0.5, 0.5))

    def start(self) -> Array:
        """Return the starting values, with the damping of the model.

        Half of the damping follows the stiffness.
        """
        return np.append(self._start, [0.0, 0.5])

    def adjusted_rates(self, A: NDArray[Any], theta: NDArray[Any]) -> NDArray[Any]:
        """Return the state matrix with the damping that `theta` implies.

        The damping follows from the stiffnesses and the damping ratio in `theta`.
        """
        if not hasattr(self, "ratio_columns"):
            return A
        # D = (1 + s) [(1 - f) D0 + f D0 X0^(-1/2) X^(1/2)]
        scale, follows = (theta[column] for column in self.ratio_columns)
        with np.errstate(all="ignore"):  # a trial point without stiffness gives nan, which the search rejects
            try:
                own = self._ratio @ square_root(-A[self._stiff])
            except np.linalg.LinAlgError:
                own = np.full_like(A[self._damp], np.nan)
        A = A.copy()
        A[self._damp] += (1.0 + scale) * ((1.0 - follows) * self._nominal + follows * own) - self._nominal
        return A
