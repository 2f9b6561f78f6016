"""Parts that several reports share: pictures, parameters, code, origin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import control as ct
import numpy as np

from ...inference.refinement import EstimatedParameter, Refinement
from ..figures import Frame, unit_text
from ..tables import Table
from .origin import record_facts, version_facts
from .page import Facts, Listing, Paragraphs, Section
from .pictures import Picture, draw

__all__ = [
    "Parts",
    "Wanted",
    "code_section",
    "estimates",
    "origin_section",
    "parameter_plot",
    "parameter_table",
    "pictures",
]

#: Kind of a picture, how to draw it, what is to be seen, what it means.
Wanted = tuple[str, Callable[[], ct.ControlPlot], str, str]
Parts = list[Table | Paragraphs | Listing | Facts | Picture]


def pictures(wanted: Sequence[Wanted]) -> Parts:
    """Return the pictures of a report.

    If the record does not allow a picture, the reason takes its place.
    """
    parts: Parts = []
    for kind, plot, alt, caption in wanted:
        drawn = draw(plot, alt, caption)
        parts.append(drawn if isinstance(drawn, Picture) else Paragraphs([f"No picture {kind!r}: {drawn}."]))
    return parts


def parameter_table(refinement: Refinement, title: str) -> Table:
    """Estimates of a refinement, with intervals."""
    rows = [
        [
            row.name,
            row.kind,
            row.place,
            row.role,
            f"{row.initial:.5g}",
            f"{row.value:.6g}",
            f"{row.std:.2g}",
            f"{row.interval[0]:.5g} ... {row.interval[1]:.5g}",
            row.unit,
        ]
        for row in refinement.parameters
    ]
    return Table(
        ["parameter", "effect", "place", "role", "initial", "value", "std", "95 % interval", "unit"],
        rows,
        title=title,
        notes=["std: standard deviation of the estimate over repeated records."],
        left=4,
    )


def estimates(refinement: Refinement) -> list[EstimatedParameter]:
    """Return the estimated parameters without nuisance offsets.

    An offset has no scale on which to draw it.
    """
    return [row for row in refinement.parameters if row.role != "offset" and np.isfinite(row.std)]


def parameter_plot(refinement: Refinement) -> ct.ControlPlot:
    """Estimates with intervals, one row each, relative to the initial model."""
    rows = estimates(refinement)
    frame = Frame()
    with frame.axes([max(1.0, 0.3 * len(rows))], 1) as (axes, lines):
        axis = axes[0, 0]
        names = []
        for i, row in enumerate(rows):
            size = abs(row.initial) or abs(row.value) or 1.0
            start, value, spread = row.initial / size, row.value / size, 1.96 * row.std / size
            axis.errorbar(value, i, xerr=min(spread, 1e3), fmt="o", color="#1f4e9c", capsize=3, markersize=4)
            axis.plot(start, i, marker="|", markersize=14, color="0.15")
            axis.annotate(
                f"{row.value:.4g} {row.unit}", (value, i), xytext=(0, 6), textcoords="offset points",
                ha="center", fontsize="x-small",
            )  # fmt: skip
            names.append(unit_text(row.name if row.name != row.kind else f"{row.kind} {row.place}", ""))
        axis.set_yticks(range(len(rows)), names)
        axis.set_ylim(len(rows) - 0.4, -0.6)
        axis.margins(x=0.08)
        axis.set_xlabel("Estimate over initial value")
        axis.grid(True, axis="x", alpha=0.3)
        lines[0, 0] = list(axis.lines)
        return frame.finish(axes, lines, [])


def code_section(generated: str, given: str | None) -> Section:
    """The code, under a heading: what the user gave, then what was generated."""
    lines = "Save the record as an .npz file (or read your own), give its name below, and run it with Python."
    code = generated if given is None else f"{given.rstrip()}\n\n{generated}"
    parts: Parts = [
        Paragraphs([lines if "record.npz" in generated else "Run it with Python."]),
        Listing(code),
    ]
    return Section("Code to reproduce this result", parts)


def origin_section(records: Sequence[Any]) -> Section:
    """Fingerprints of the records and versions of the programs."""
    parts: Parts = []
    if records:
        parts += [
            Facts(record_facts(records)),
            Paragraphs(
                ["The fingerprints are those of the arrays as little-endian float64, signal by signal."]
            ),
        ]
    parts.append(Facts(version_facts()))
    return Section("Record and versions", parts)
