"""Result of the experiment design.

It holds every experiment that was judged, and the recommended one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Unpack

import control as ct

from ...results import Options, Result, Row, picture, show
from ...systems.linear import Array

__all__ = ["ExperimentAdvice", "ExperimentOption"]


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentOption(Row):
    """One experiment that could be made.

    Attributes
    ----------
    kind : str
        "repeat", "amplitude", "band", "longer" or "sensor".
    name : str
        What to do, in words.
    cost : float
        In lengths of the present record.
    probability : float
        That the true effect then stands alone.
    wrong : float
        That a wrong one then leads by as much.
    distance : float
        Squared distance, over the noise, between the outputs of the closest two candidates
        after one was refitted to the other.
    reach : float
        Largest motion at any port, or input, over the largest in the present record.
    reach_where : str
        The port or input where that is.
    inputs : ndarray, shape (n_w, N)
        Inputs to apply, sampled and held like those of the present record. The
        probability is that of these: another random input of the same kind can move a
        lightly damped model more, or less.
    failed : str
        Why it cannot be made, empty where it can.
    """

    kind: str
    name: str
    cost: float
    probability: float
    wrong: float
    distance: float
    reach: float
    reach_where: str
    inputs: Array
    failed: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ExperimentAdvice(Result):
    """Recommended next experiment and its alternatives.

    Attributes
    ----------
    chosen : ExperimentOption or None
        The cheapest that reaches the probability, else the most probable; None where
        there is nothing to separate.
    options : tuple of ExperimentOption
        All of them, the cheapest first.
    rivals : tuple of str
        Candidates that the record cannot distinguish.
    probability : float
        Probability that was asked for.
    message : str
        The advice in one sentence.
    notes : tuple of str
        Warnings: what the present record cannot vouch for.
    """

    chosen: ExperimentOption | None
    options: tuple[ExperimentOption, ...]
    rivals: tuple[str, ...]
    probability: float
    message: str
    notes: tuple[str, ...] = ()

    def sentences(self) -> list[str]:
        """The advice, and what the figures mean.

        Returns
        -------
        list of str
        """
        lines = [self.message]
        if self.options:
            lines.append(
                "probability: that the true one then stands alone (twice the log-likelihood 9.2 ahead of "
                "any other candidate); distance: squared, over the noise, between the closest two; cost: in "
                "lengths of this record; reach: largest motion over the largest in this record."
            )
        return [*lines, *self.notes]

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Probability of every option over its cost, the chosen one marked.

        Parameters
        ----------
        ax : Axes, optional
            Where to draw.
        label : str, optional
            Label of the options.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)
