"""StateSpace in, arrays and labels out, and back again."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import control as ct
import numpy as np
from numpy.typing import NDArray

from ..arguments import as_text

__all__ = ["Array", "LinearModel"]

Array = NDArray[np.float64]


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
        from ..exceptions import ModelError
        from .realization import realized

        if isinstance(sys, ct.TransferFunction):
            sys = realized(sys)
        if not isinstance(sys, ct.StateSpace):
            raise ct.ControlArgument(
                f"model must be a control.StateSpace, not {type(sys).__name__}; convert it first (a "
                "NonlinearIOSystem with its .linearize(x0, u0))"
            )
        arrays = [np.array(getattr(sys, key), dtype=float, ndmin=2) for key in "ABCD"]
        for key, array in zip("ABCD", arrays, strict=True):
            if not np.isfinite(array).all():
                row, col = np.argwhere(~np.isfinite(array))[0]
                raise ModelError(
                    f"matrix {key} of system {sys.name!r} is not finite at [{row}, {col}]; "
                    "give finite parameters"
                )
        a, b, c, d = arrays
        return cls(
            A=a,
            B=b,
            C=c,
            D=d,
            dt=sys.dt,
            input_labels=tuple(sys.input_labels),
            output_labels=tuple(sys.output_labels),
            state_labels=tuple(sys.state_labels),
            name=str(sys.name),
        )

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
            self.A.copy(),
            self.B.copy(),
            self.C.copy(),
            self.D.copy(),
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
