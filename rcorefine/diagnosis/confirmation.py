"""Whether the same effects explain every record: what `confirm` returns."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Any

import control as ct

from ..inference.whitening import FTest
from ..systems.linear import Array

__all__ = ["Confirmation", "RecordEstimate"]


@dataclass(frozen=True, slots=True, eq=False)
class RecordEstimate:
    """The model fitted to one record alone.

    Attributes
    ----------
    name : str
        Name of the record.
    level : float
        Rms of its inputs over that of the first record.
    coefficients, std : ndarray, shape (p,)
        Of the effects.
    agreement : float
        p-value that they are those of the first record, 1 for the first itself.
    tests : tuple of FTest
        Tests of the residual.
    residual : float
        p-value of all of them together.
    """

    name: str
    level: float
    coefficients: Array
    std: Array
    agreement: float
    tests: tuple[FTest, ...]
    residual: float


@dataclass(frozen=True, slots=True, eq=False)
class Confirmation:
    """Whether the same effects, with the same coefficients, explain every record.

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
    """

    verdict: str
    p_value: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    estimates: tuple[RecordEstimate, ...]
    significance: float
    message: str

    def sentences(self) -> list[str]:
        """What was found, one sentence each.

        Returns
        -------
        list of str
        """
        return [
            self.message,
            "agreement: chance of such a difference from the first record if the law is the same; residual: "
            "p-value of the tests on what the refitted model leaves; input: rms over that of the first.",
        ]

    def _rows(self) -> list[list[str]]:
        rows = []
        for estimate in self.estimates:
            for i, name in enumerate(self.names):
                first = i == 0
                rows.append(
                    [
                        estimate.name if first else "",
                        name,
                        f"{estimate.coefficients[i]:.4g}",
                        f"{estimate.std[i]:.2g}",
                        f"{estimate.level:.3g}" if first else "",
                        f"{estimate.agreement:.2g}" if first and estimate is not self.estimates[0] else "",
                        f"{estimate.residual:.2g}" if first else "",
                    ]
                )
        return rows

    def __str__(self) -> str:
        from ..views.tables import text_table

        parts = [f"Further records: {self.verdict.upper()}", *textwrap.wrap(self.message, 80)]
        parts.append(text_table(_HEADER, self._rows(), left=2))
        parts += textwrap.wrap(self.sentences()[1], 80)
        return "\n".join(parts)

    def _repr_html_(self) -> str:
        from ..views.tables import html_table

        title = f"Further records: {self.verdict}"
        return html_table(_HEADER, self._rows(), title=title, notes=self.sentences(), left=2)

    def plot(
        self,
        *,
        ax: Any = None,
        label: str | None = None,
        title: str | None = None,
        legend_loc: str | bool | None = None,
        rcParams: dict[str, Any] | None = None,
        show_legend: bool | None = None,
    ) -> ct.ControlPlot:
        """Coefficients from each record alone, with their 95 % intervals.

        Parameters
        ----------
        ax : Axes or array of Axes, optional
            Where to draw, one per coefficient.
        label : str, optional
            Label of the estimates.
        title : str, optional
            Title.
        legend_loc : str or bool, optional
            Place of the legend, False for none.
        rcParams : dict, optional
            Matplotlib settings for this plot.
        show_legend : bool, optional
            Whether to show a legend; default only where a label is given.

        Returns
        -------
        ControlPlot
        """
        from ..views.experiment import confirmation_plot

        return confirmation_plot(
            self,
            ax=ax,
            label=label,
            title=title,
            legend_loc=legend_loc,
            rcParams=rcParams,
            show_legend=show_legend,
        )


_HEADER = ["record", "coefficient", "alone", "std", "input", "agreement", "residual"]
