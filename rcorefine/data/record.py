"""Answers of a record to what callers ask, in time or in frequency."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..systems.linear import Array


class TimeRecord:
    """Answers of signals in time.

    Attributes
    ----------
    in_time : bool
        Whether the samples follow each other in time, from an initial state on.
    shortest : int
        Least number of values of an output that can be tested.
    known : bool
        Whether the outputs are in units of their noise.
    note : str
        What is to be said of the noise.
    n_balances : int
        Given frequencies at which nonlinear effects need a harmonic balance.
    there : ndarray of bool, shape (n_y, N), or None
        Output samples that were measured, None for all.
    """

    __slots__ = ()
    inputs: Array
    outputs: Array

    in_time: ClassVar[bool] = True
    shortest: ClassVar[int] = 36
    known: ClassVar[bool] = False
    note: ClassVar[str] = ""
    n_balances: ClassVar[int] = 0

    @property
    def color(self) -> int | None:
        """Highest order of the noise filter, None for any.

        1 for free decays: with two coefficients a filter takes any oscillation, and with it the error of any
        model, for noise.
        """
        return None if np.ptp(self.inputs, axis=1).any() else 1

    @property
    def there(self) -> NDArray[np.bool_] | None:
        """Output samples that were measured, shape (n_y, N), None for all."""
        found = ~np.isnan(self.outputs)
        return None if found.all() else found

    @property
    def n_points(self) -> int:
        """Number of samples."""
        return int(self.inputs.shape[1])


class FrequencyRecord:
    """Answers of measured frequency responses, as those of `TimeRecord`.

    The noise has no memory from frequency to frequency, and no output has a level.
    """

    __slots__ = ()

    in_time: ClassVar[bool] = False
    shortest: ClassVar[int] = 60
    color: ClassVar[int] = 0
    there: ClassVar[None] = None

    @property
    def n_points(self: Any) -> int:
        """Number of frequencies."""
        return int(self.omega.size)
