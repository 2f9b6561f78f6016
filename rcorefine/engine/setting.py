"""Arguments of the simulation loop at given coefficients.

They are computed once for all records that need them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array
from .linear import LinearStep
from .point import field_numbers

if TYPE_CHECKING:
    from .structure import Structure


PIECES = 16  # of a substep in which a friction force jumps


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Arguments of the march that do not hang on the record.

    Attributes
    ----------
    substep : tuple
        Matrices of a substep and of a piece of it, their derivatives, the number of pieces, and what the
        outputs and the ports take.
    laws, outputs, field : tuple
        Codes, numbers and columns of the laws at ports, of those of the sensors, and of the field.
    finite : bool
        Whether the matrices are numbers.
    """

    substep: tuple[Any, ...]
    laws: tuple[Any, ...]
    outputs: tuple[Any, ...]
    field: tuple[Any, ...]
    finite: bool

    @property
    def linear(self) -> LinearStep:
        """Return the matrices that `simulate_linear` takes."""
        M, dM, _, rows, O, dO = self.substep[:6]
        return LinearStep(M[0], dM[0], rows, O, dO)

    def decay(self, substeps: int, gain: Array, samples: int) -> Array:
        """Return the linear response to unit initial states, (N, n_y, n).

        At every sample the outputs correct the states by a gain (n, n_y).
        """
        M, O = self.substep[0][0], self.substep[4]
        n = len(M)
        with np.errstate(all="ignore"):  # what grows beyond all numbers is noticed by who asks
            ahead = np.linalg.matrix_power(M[:, :n], substeps)
            ahead = ahead - (ahead @ gain) @ O[:, :n]
            found = np.empty((samples, len(O), n))
            found[0], count = O[:, :n], 1
            while count < samples:  # twice as many with every product
                more = min(count, samples - count)
                found[count : count + more] = found[:more] @ ahead
                ahead, count = ahead @ ahead, count + more
        return found


def setting(structure: Structure, theta: Array, step: float, derivatives: bool) -> Setting:
    """Return the arguments of `march` at given coefficients.

    Parameters
    ----------
    structure : Structure
        Model with effects.
    theta : ndarray, shape (p,)
        Coefficients.
    step : float
        Substep in seconds.
    derivatives : bool
        Whether derivatives by the coefficients are carried.

    Returns
    -------
    Setting
    """

    def made() -> Setting:
        disc = structure.discretize(theta, step, derivatives=derivatives)
        grades, pieces = [disc], 1
        if structure.jumps:
            grades.append(structure.discretize(theta, step / PIECES, derivatives=derivatives))
            pieces = PIECES
        substep = (
            _stacked([one.M for one in grades]), _stacked([one.dM for one in grades]), pieces, disc.linear,
            disc.O, disc.dO, disc.P, disc.dP,
        )  # fmt: skip
        codes, values, columns, widths = structure.laws(theta)
        outcodes, outvalues, outcolumns = structure.output_laws(theta)
        field, fvalues, fcolumns = field_numbers(structure, theta)
        if not derivatives:
            columns, outcolumns, fcolumns = (np.full_like(one, -1) for one in (columns, outcolumns, fcolumns))
        laws, outputs = (codes, values, columns, widths), (outcodes, outvalues, outcolumns)
        return Setting(substep, laws, outputs, (field, fvalues, fcolumns), bool(np.isfinite(disc.M).all()))

    return structure.kept(("setting", theta.tobytes(), step, derivatives), made)


def _stacked(parts: list[NDArray[Any]]) -> NDArray[Any]:
    """Arrays one behind the other; of one alone a view."""
    return parts[0][None] if len(parts) == 1 else np.stack(parts)
