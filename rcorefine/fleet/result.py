"""Result of a survey: rows, effects of the fleet, and trends.

It can be shown as values, sentences, a plot and a report.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Unpack

import control as ct

from ..arguments import as_text
from ..exceptions import ModelError
from ..results import Options, Result, chance, counted, picture, show, views, with_error
from .comparison import FleetEffect, MachineEffect, SurveyRow, Trend
from .conditions import Breach, breaches


@dataclass(frozen=True, slots=True, eq=False)
class Survey(Result):
    """Many records of many machines, examined one by one and compared.

    Attributes
    ----------
    task : str
        What was asked of each record.
    mode : str
        "common" or "own": whether every effect was estimated in every record.
    significance : float
        Level of the comparisons.
    rows : tuple of SurveyRow
        One per record: machine, verdict, effect, place, coefficient, std, probability, seconds, error.
    effects : tuple of FleetEffect
        Each coefficient over the fleet: "common", "own" or "unclear", mean, spread, the machines.
    trends : tuple of Trend
        Each coefficient over the records of one machine, the surest first.
    notes : tuple of str
        What was left out.
    """

    task: str
    mode: str
    significance: float
    rows: tuple[SurveyRow, ...]
    effects: tuple[FleetEffect, ...]
    trends: tuple[Trend, ...]
    notes: tuple[str, ...] = ()

    @property
    def machines(self) -> tuple[str, ...]:
        """Names, in the order of the records."""
        return tuple(dict.fromkeys(row.machine for row in self.rows))

    @property
    def failed(self) -> tuple[SurveyRow, ...]:
        """Rows that have an error in place of an answer."""
        return tuple(row for row in self.rows if row.error is not None)

    @property
    def standing_out(self) -> tuple[tuple[FleetEffect, MachineEffect], ...]:
        """Return the machines whose coefficient differs from that of the rest.

        Each comes with the effect.
        """
        return tuple((effect, machine) for effect in self.effects for machine in effect.standing_out)

    @property
    def growing(self) -> tuple[Trend, ...]:
        """Coefficients that change with time."""
        return tuple(trend for trend in self.trends if trend.grows)

    @property
    def finds(self) -> bool:
        """Return whether anything was found, or a record failed.

        It determines the exit status of the command.
        """
        fine = ("adequate", "unchanged", "fitted")
        return any(row.verdict not in fine or (row.effects and self.task != "refine") for row in self.rows)

    def of(self, machine: str) -> tuple[SurveyRow, ...]:
        """Rows of one machine.

        Parameters
        ----------
        machine : str
            Name.

        Returns
        -------
        tuple of SurveyRow

        Raises
        ------
        ModelError
            If there is none of that name.
        """
        found = tuple(row for row in self.rows if row.machine == as_text(machine, "machine"))
        if not found:
            raise ModelError(f"no machine is called {machine!r}; there are {', '.join(self.machines[:20])}")
        return found

    def summary(self) -> str:
        """Return the findings as text.

        Returns
        -------
        str
            A sentence per line: how many records, the verdicts, what is common, who stands out, what grows.
        """
        return "\n".join(self.sentences())

    def sentences(self) -> list[str]:
        """The sentences of `summary`.

        Returns
        -------
        list of str
        """
        words = Counter(row.verdict for row in self.rows if row.error is None)
        verdicts = ", ".join(f"{word} {n}" for word, n in words.most_common())
        said = [
            f"{counted(len(self.rows), 'record')} of {counted(len(self.machines), 'machine')}"
            + (f": {verdicts}." if verdicts else ".")
        ]
        if self.failed:
            first = self.failed[0]
            said.append(
                f"{len(self.failed)} failed; the first is {first.record} of {first.machine}: {first.error}"
            )
        said += [_words(effect) for effect in self.effects if effect.sort != "unclear"]
        for effect, machine in self.standing_out:
            assert machine.deviation is not None
            side = "above" if machine.deviation > 0 else "below"
            said.append(
                f"{machine.machine} stands out: {effect.label} "
                f"{with_error(machine.value, machine.std, effect.unit)}, "
                f"{abs(machine.deviation):.3g} standard deviations {side} the others."
            )
        for trend in self.growing:
            slope = with_error(trend.slope, trend.std, f"{trend.unit} per {trend.per}".strip())
            p_value = chance(trend.p_value, "p")
            said.append(f"{trend.label} of {trend.machine} changes with time: {slope} ({p_value}).")
        if self.effects and not self.growing and self.trends:
            said.append("No coefficient changes significantly with time.")
        return said + list(self.notes)

    def breaches(self, conditions: str | PathLike[str] | Mapping[str, Any]) -> tuple[Breach, ...]:
        """Return the conditions that are not kept.

        Parameters
        ----------
        conditions : str, path or mapping
            TOML file, or what it holds: tables ``[[condition]]``, see docs/fleets.md.

        Returns
        -------
        tuple of Breach
            Condition, machine, and a sentence each; empty where all are kept. A condition that cannot be
            judged is not kept.

        Raises
        ------
        DataError
            If the file holds something else; the table is named.
        """
        return breaches(self, conditions)

    @picture
    def plot(self, **options: Unpack[Options]) -> ct.ControlPlot:
        """Plot the coefficients of the machines and of the fleet.

        Each machine is shown with its 95 % interval, the fleet with its mean and spread.

        Parameters
        ----------
        ax : array of Axes, optional
            Axes to draw in, one per coefficient that is common or belongs to some machines.
        label : str or sequence of str, optional
            Titles of the panels.

        Returns
        -------
        ControlPlot
        """
        return show(self, "plot", **options)

    def report(
        self,
        folder: str | PathLike[str],
        *,
        title: str | None = None,
        code: str | None = None,
        overwrite: bool = False,
    ) -> Path:
        """Write an index page and a page per machine.

        Parameters
        ----------
        folder : str or path
            Folder, made if it is absent; an older survey in it is replaced.
        title : str, optional
            Heading.
        code : str, optional
            Code or command that made the survey.
        overwrite : bool
            Write into a folder that holds something else, and replace files there that are no reports.

        Returns
        -------
        Path
            The index page.

        Raises
        ------
        FileExistsError
            If the folder holds something else, or a file there is no report.
        """
        return Path(views().report(self, folder, title=title, code=code, overwrite=overwrite))


def _words(effect: FleetEffect) -> str:
    """Return a sentence about one coefficient of the fleet."""
    held = len(effect.machines)
    if effect.sort == "common":
        differs = f"varies by {effect.spread:.3g} between machines, more than the estimation errors"
        alike = differs if effect.spread > 0 else "is equal in all machines within the estimation errors"
        return (
            f"Common: {effect.label}, {with_error(effect.mean, effect.std, effect.unit)} in {held} of "
            f"{counted(effect.n_machines, 'machine')}; it {alike} ({chance(effect.p_alike, 'p')})."
        )
    some = effect.standing_out or effect.machines
    names = ", ".join(machine.machine for machine in some[:5]) + (", ..." if len(some) > 5 else "")
    return f"Not common: {effect.label} is specific to {names}."
