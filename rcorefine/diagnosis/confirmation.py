"""Result of `confirm`.

It holds the verdict whether the same effects explain every record.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Unpack

import control as ct

from ..inference.f_tests import FTest
from ..results import Options, Result, Row, picture, show
from ..systems.linear import Array

__all__ = ["Confirmation", "RecordEstimate"]


@dataclass(frozen=True, slots=True, eq=False)
class RecordEstimate(Row):
    """The model fitted to one record alone.

    Attributes
    ----------
    name : str
        Name of the record.
    level : float
        Its amplitude over that of the first record: rms of the inputs, in free decays of the outputs.
    coefficients, std : ndarray, shape (p,)
        Of the effects.
    agreement : float
        p-value that they are those of the first record, 1 for the first itself.
    tests : tuple of FTest
        Tests of the residual.
    residual : float
        p-value of all of them together.
    factors : ndarray, shape (p,)
        Ratio of each coefficient to that of the first record if the law is the same; 1 without a condition.
    """

    name: str
    level: float
    coefficients: Array
    std: Array
    agreement: float
    tests: tuple[FTest, ...]
    residual: float
    factors: Array


@dataclass(frozen=True, slots=True, eq=False)
class Confirmation(Result):
    """Agreement of the effects and their coefficients over all records.

    Attributes
    ----------
    verdict : str
        "confirmed" or "refuted".
    p_value : float
        The smallest of agreement and residual over the further records, corrected for
        their number.
    names : tuple of str
        Coefficients that were compared.
    units : tuple of str
        Their units.
    estimates : tuple of RecordEstimate
        One per record.
    significance : float
        Level.
    message : str
        The outcome in a sentence.
    conditions : dict
        For each effect that changes in proportion to a condition (``"kind@place"``) the condition in each
        record.
    """

    verdict: str
    p_value: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    estimates: tuple[RecordEstimate, ...]
    significance: float
    message: str
    conditions: dict[str, tuple[float, ...]] = field(default_factory=dict)

    def sentences(self) -> list[str]:
        """Return the findings, one sentence each.

        Returns
        -------
        list of str
        """
        return [
            self.message,
            "agreement: chance of such a difference from the first record if the law is the same; residual: "
            "p-value of the tests on what the refitted model leaves; level: amplitude over that of "
            "the first.",
        ]

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Coefficients from each record alone, with their 95 % intervals.

        Parameters
        ----------
        ax : Axes or array of Axes, optional
            Where to draw, one per coefficient.
        label : str, optional
            Label of the estimates.
        show_legend : bool, optional
            Force the legend on or off; default: on where a label is given.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)
