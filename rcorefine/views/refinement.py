"""Table and Bode plot of a `Refinement`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import control as ct
from numpy.typing import ArrayLike

from ..data.measurement import Measurement
from ..inference.refinement import EstimatedParameter, Refinement
from .bode import bode
from .figures import Frame, draws
from .level_bode import level_bode
from .tables import Table, Told, tells

__all__ = ["estimates_table", "plot_bode", "refinement_told"]


@tells(Refinement)
def refinement_told(found: Refinement) -> Told:
    """The parameters, and what the figures mean."""
    title = f"Refinement of {found.physical_model.linear.name}"
    return (
        [f"Refinement of {found.physical_model.linear.name!r}"],
        estimates_table(found.parameters, title, found.sentences()),
        found.sentences(),
    )


def estimates_table(parameters: Sequence[EstimatedParameter], title: str, notes: Sequence[str]) -> Table:
    """Estimated numbers, initial and fitted."""
    headers = ["parameter", "effect", "place", "initial", "value", "std", "unit"]
    return Table(headers, [row.cells for row in parameters], title, notes)


@draws(Refinement, "bode_plot")
def plot_bode(
    found: Refinement,
    frame: Frame,
    measured: Any = None,
    omega: ArrayLike | None = None,
    *,
    levels: Sequence[float] | None = None,
) -> ct.ControlPlot:
    """Draw the initial and refined model beside the measured response.

    See `Refinement.bode_plot`.
    """
    if levels is not None:
        return level_bode(found, levels, measured, omega, frame)
    if isinstance(measured, Measurement):
        measured = measured.frequency_response()
    systems = [("initial", found.physical_model.system), ("refined", found.system)]
    return bode(systems, measured, omega, frame)
