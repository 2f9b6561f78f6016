"""A state space behind a transfer function."""

from __future__ import annotations

import control as ct
import numpy as np

from ..exceptions import ConversionWarning, ModelError, warn

__all__ = ["realized"]


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
        one = transfer.ninputs * transfer.noutputs == 1
        system = _companion(transfer) if one else ct.ss(transfer, name=transfer.name)
    except (ct.ControlMIMONotImplemented, ct.ControlSlycot, ValueError, TypeError) as error:
        raise ModelError(
            f"transfer function {transfer.name!r} has no state space here ({error}); "
            "give a control.StateSpace"
        ) from error
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
    (num,), (den,) = (np.trim_zeros(np.ravel(part), "f")[None] for part in ct.tfdata(transfer))
    n = den.size - 1
    if num.size > n + 1:
        raise ValueError("it is non-proper: its numerator is of the higher degree")
    num = np.concatenate([np.zeros(n + 1 - num.size), num]) / den[0]
    den = den / den[0]
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
    rows = system.C if n == 1 else np.vstack([system.C, system.C @ system.A])
    if (n == 2 and (system.C @ system.B).any()) or np.linalg.matrix_rank(rows) < n:
        return system
    back = np.linalg.inv(rows)
    (label,) = system.output_labels
    return ct.ss(
        rows @ system.A @ back, rows @ system.B, np.eye(1, n), system.D,
        inputs=system.input_labels, outputs=[label], states=[label, f"{label}_rate"][:n], name=system.name,
    )  # fmt: skip
