"""StateSpace in, arrays and labels out, and back again."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgebal

from ..arguments import as_text
from ..exceptions import ConversionWarning, ModelError, warn

Array = NDArray[np.float64]


def check_finite(key: str, matrix: Array, of: str = "") -> None:
    """Check that a matrix of a model is finite."""
    if not np.isfinite(matrix).all():
        row, col = np.argwhere(~np.isfinite(matrix))[0]
        raise ModelError(f"matrix {key}{of} is not finite at [{row}, {col}]; give finite parameters")


@dataclass(frozen=True, slots=True, eq=False)
class LinearModel:
    """Arrays and labels of a `control.StateSpace`.

    Results hold this rather than a `StateSpace`, which cannot be pickled.

    Parameters
    ----------
    A, B, C, D : ndarray
        State matrices of shape (n, n), (n, n_w), (n_y, n), (n_y, n_w).
    dt : float or None
        0 for continuous time, the sampling time in seconds otherwise;
        True and None as in python-control.
    input_labels, output_labels, state_labels : tuple of str
        Signal names.
    name : str
        Name of the system.

    Examples
    --------
    >>> import control as ct
    >>> model = LinearModel.from_statespace(ct.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]))
    >>> model.n_states, model.to_statespace().nstates
    (1, 1)
    """

    A: Array
    B: Array
    C: Array
    D: Array
    dt: Any
    input_labels: tuple[str, ...]
    output_labels: tuple[str, ...]
    state_labels: tuple[str, ...]
    name: str

    @property
    def n_states(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.C.shape[0])

    @property
    def is_continuous(self) -> bool:
        """Return whether the model is in continuous time (dt = 0)."""
        return self.dt is not None and self.dt is not True and self.dt == 0

    @classmethod
    def from_statespace(cls, sys: ct.StateSpace) -> LinearModel:
        """Copy arrays and labels out of a `control.StateSpace`.

        Parameters
        ----------
        sys : StateSpace or TransferFunction
            Linear system with finite entries; a transfer function is `realized`.

        Returns
        -------
        LinearModel
            Independent copy.

        Raises
        ------
        control.ControlArgument
            If `sys` is not a `StateSpace`; the message says what to convert.
        ModelError
            If a matrix holds NaN or Inf.
        """
        if isinstance(sys, ct.TransferFunction):
            sys = realized(sys)
        if not isinstance(sys, ct.StateSpace):
            raise ct.ControlArgument(
                f"model must be a control.StateSpace, not {type(sys).__name__}; convert it first (a "
                "NonlinearIOSystem with its .linearize(x0, u0))"
            )
        # copies, so that later changes of the system do not reach the model
        arrays = [np.array(getattr(sys, key), dtype=float, ndmin=2) for key in "ABCD"]
        for key, array in zip("ABCD", arrays, strict=True):
            check_finite(key, array, f" of system {sys.name!r}")
        A, B, C, D = arrays
        inputs, outputs, states = map(tuple, (sys.input_labels, sys.output_labels, sys.state_labels))
        return cls(A, B, C, D, sys.dt, inputs, outputs, states, str(sys.name))

    def to_statespace(self, name: str | None = None) -> ct.StateSpace:
        """Build the `control.StateSpace` anew, labels and timebase kept.

        Parameters
        ----------
        name : str, optional
            Name of the system; default the stored one.

        Returns
        -------
        StateSpace
            System that shares no memory with this object.
        """
        return ct.ss(
            *(getattr(self, key).copy() for key in "ABCD"),
            self.dt,
            inputs=list(self.input_labels),
            outputs=list(self.output_labels),
            states=list(self.state_labels),
            name=self.name if name is None else as_text(name, "name"),
        )

    def with_arrays(self, **changes: Any) -> LinearModel:
        """Return a copy with some fields replaced.

        The fields are `A`, `B`, `C`, `D`, `dt`, `name` and the labels.
        """
        return replace(self, **changes)


def balance(size: Array) -> Array:
    """Powers of two d with which d_j size_ij / d_i is balanced.

    Parameters
    ----------
    size : ndarray of shape (n, n)
        Sizes of the entries of a matrix, or of several of the same structure.

    Returns
    -------
    ndarray of shape (n,)

    Notes
    -----
    LAPACK's gebal without permutations; `scipy.linalg.matrix_balance` writes the factors as integers,
    too, which units 1e15 apart exceed.
    """
    # gebal also returns the balanced matrix, which is not needed
    *_, scale, _ = dgebal(np.asarray(size, dtype=np.float64), scale=1, permute=0)
    return np.asarray(scale, dtype=np.float64)


def entry_of(linear: LinearModel, place: str) -> tuple[int, int]:
    """Return row and column of a matrix entry such as ``"A[1,0]"``.

    They refer to the matrix [A B; C D]. Labels are accepted, too, as in ``"B[v1,force]"``.

    Parameters
    ----------
    linear : LinearModel
        Model.
    place : str
        Row and column in its matrix, counted from 0 or by label.

    Returns
    -------
    row, column : int

    Raises
    ------
    ModelError
        If the text is not of this form or the entry does not exist.
    """
    match = re.fullmatch(r"([ABCD])\[(.+)\]", as_text(place, "place").strip())
    states, inputs, outputs = linear.state_labels, linear.input_labels, linear.output_labels
    # letter of the matrix: C and D are rows of outputs, B and D columns of inputs
    if match:
        below, right = match[1] in "CD", match[1] in "BD"
        pieces = match[2].split(",")
        for cut in range(1, len(pieces)):  # a label may hold a comma itself
            row = _index(outputs if below else states, ",".join(pieces[:cut]).strip())
            column = _index(inputs if right else states, ",".join(pieces[cut:]).strip())
            if row is not None and column is not None:
                return row + len(states) * below, column + len(states) * right
    named = (", ".join(labels) or "none" for labels in (states, inputs, outputs))
    raise ModelError(
        f"{place!r} is no entry of the model: write 'A[i,j]' (or B, C, D) with numbers from 0, or labels "
        "of states ({}), inputs ({}) and outputs ({})".format(*named)
    )


def _index(labels: Sequence[str], text: str) -> int | None:
    """Which of the labels a text names, itself or by its number."""
    # a label comes before a number, since labels may be numbers
    if text in labels:
        return labels.index(text)
    return int(text) if text.isdecimal() and int(text) < len(labels) else None


def realized(transfer: ct.TransferFunction) -> ct.StateSpace:
    """State space of a transfer function, and a word on what its states are.

    Parameters
    ----------
    transfer : TransferFunction
        Proper; of one input and one output unless python-control can realize more (slycot).

    Returns
    -------
    StateSpace
        The output is the state of a first-order lag; output and its rate are those of a second-order one
        without zeros. Else the states are those of `control.ss`.

    Raises
    ------
    ModelError
        If python-control cannot realize it.

    Warns
    -----
    ConversionWarning
        That a transfer function tells no states: places are named after those that were chosen.

    Examples
    --------
    >>> import warnings
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore", rco.ConversionWarning)
    ...     realized(ct.tf([6.0], [1.0, 0.4, 9.0], outputs="x")).state_labels
    ['x', 'x_rate']
    """
    try:
        # SISO: companion form; MIMO: python-control, which may need slycot
        one = transfer.ninputs * transfer.noutputs == 1
        system = _companion(transfer) if one else ct.ss(transfer, name=transfer.name)
    except (ct.ControlMIMONotImplemented, ct.ControlSlycot, ValueError, TypeError) as error:
        raise ModelError(
            f"transfer function {transfer.name!r} has no state space here ({error}); "
            "give a control.StateSpace"
        ) from error
    # physical coordinates, where the output defines them
    system = _by_output(system)
    warn(
        f"a transfer function tells no states; {system.name!r} was realized with the states "
        f"{', '.join(system.state_labels)}, after which the places are named. Give a control.StateSpace in "
        "physical coordinates to find effects at other places",
        ConversionWarning,
    )
    return system


def _companion(transfer: ct.TransferFunction) -> ct.StateSpace:
    """Return the controllable canonical form with all coefficients.

    `scipy.signal.tf2ss` drops small leading ones.
    """
    # without leading zeros, the degree of the denominator is the order
    (num,), (den,) = (np.trim_zeros(np.ravel(part), "f")[None] for part in ct.tfdata(transfer))
    n = den.size - 1
    if num.size > n + 1:
        raise ValueError("it is non-proper: its numerator is of the higher degree")
    # monic denominator
    num = np.concatenate([np.zeros(n + 1 - num.size), num]) / den[0]
    den = den / den[0]
    # controllable canonical form: negative coefficients in the first row, ones below the diagonal
    A = np.eye(n, k=-1)
    A[:1] = -den[1:]
    return ct.ss(
        A, np.eye(n, 1), (num[1:] - num[0] * den[1:])[None], num[0], transfer.dt,
        inputs=transfer.input_labels, outputs=transfer.output_labels, name=transfer.name,
    )  # fmt: skip


def _by_output(system: ct.StateSpace) -> ct.StateSpace:
    """In the coordinates output and rate of output, where that is a state."""
    n = system.nstates
    if system.dt != 0 or system.ninputs * system.noutputs != 1 or n not in (1, 2) or system.D.any():
        return system
    # T = C, or T = [C; C A]: output and its rate
    rows = system.C if n == 1 else np.vstack([system.C, system.C @ system.A])
    # the rate is a state only if the input does not reach it at once, C B = 0
    if (n == 2 and (system.C @ system.B).any()) or np.linalg.matrix_rank(rows) < n:
        return system
    back = np.linalg.inv(rows)
    (label,) = system.output_labels
    return ct.ss(
        rows @ system.A @ back, rows @ system.B, np.eye(1, n), system.D,
        inputs=system.input_labels, outputs=[label], states=[label, f"{label}_rate"][:n], name=system.name,
    )  # fmt: skip
