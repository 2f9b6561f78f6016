"""The report of a survey: an index page, and a page per machine."""

from __future__ import annotations

import hashlib
import re
from os import PathLike
from pathlib import Path

import control as ct

from ...arguments import as_flag, as_path
from ...fleet.result import Survey
from ...results import shows
from ...words import chance, counted
from ..figures import Frame, plain, style, unit_text
from ..survey import row_cells
from ..tables import Table, number
from .origin import version_facts
from .page import Facts, Links, Listing, Page, Paragraphs, Section, check_target, write_page
from .parts import Parts, pictures

__all__ = ["report_survey"]

_INDEX = "index.html"
_ROWS = ["machine", "record", "verdict", "effect", "coefficient", "probability", "seconds"]


@shows(Survey, "report")
def report_survey(
    found: Survey, folder: str | PathLike[str], *, title: str | None, code: str | None, overwrite: bool
) -> Path:
    """See `Survey.report`."""
    home = as_path(folder, "folder").expanduser().absolute()
    as_flag(overwrite, "overwrite")
    home.mkdir(exist_ok=True)
    if not (overwrite or (home / _INDEX).is_file()) and any(home.iterdir()):
        raise FileExistsError(f"{home} holds other files; choose another folder or say overwrite=True")
    files = _files(found.machines)
    for name in (_INDEX, *files.values()):  # before anything is written
        check_target(home / name, title=title, code=code, overwrite=overwrite)
    for machine, name in files.items():
        write_page(_machine_page(found, machine), home / name, overwrite=overwrite)
    return write_page(_index(found, files, title, code), home / _INDEX, overwrite=overwrite)


def _files(machines: tuple[str, ...]) -> dict[str, str]:
    """Return the file name of each machine.

    Characters that a file name may not have are replaced; a hash then keeps the names distinct.
    """
    found = {}
    for machine in machines:
        word = re.sub(r"[^A-Za-z0-9_.-]+", "_", machine)[:60]
        if word != machine:
            word += "-" + hashlib.sha256(machine.encode("utf-8", "replace")).hexdigest()[:8]
        found[machine] = f"machine-{word}.html"
    return found


def _index(found: Survey, files: dict[str, str], title: str | None, code: str | None) -> Page:
    said = found.sentences()
    drawn = pictures(
        [
            (
                "fleet",
                lambda: found.plot(title=""),
                "Coefficient of each machine with its 95 % interval, and mean and spread of the fleet.",
                "Points: estimates from the records of each machine; dashes: estimates shrunk toward the "
                "fleet mean according to their errors; gray: spread between machines. Machines that "
                "stand out have another color.",
            )
        ]
        if found.effects
        else []
    )
    fleet = Table(
        ["effect", "unit", "", "machines", "mean", "std", "spread", "p (mean 0)", "p (all equal)"],
        [
            [
                e.label,
                e.unit,
                e.sort,
                f"{len(e.machines)} of {e.n_machines}",
                f"{e.mean:.5g}",
                f"{e.std:.2g}",
                f"{e.spread:.2g}",
                chance(e.p_value),
                chance(e.p_alike),
            ]
            for e in found.effects
        ],
        title="Effects over the fleet",
        notes=[
            "Mean and spread are those of the machines that do not stand out. p (mean 0): corrected by Holm."
        ],
        left=3,
    )
    failed = Table(
        [*_ROWS[:2], "why"], [[r.machine, r.record, r.error or ""] for r in found.failed], "Failed", (), 3
    )
    sections = [
        Section("Pictures", drawn),
        Section("Tables", [table for table in (fleet, failed) if table.rows]),
        Section("Machines", [Links([(_line(found, machine), file) for machine, file in files.items()])]),
        *([] if code is None else [Section("Code to reproduce this result", [Listing(code)])]),
        Section("Versions", [Facts(version_facts())]),
    ]
    about = f"{len(found.rows)} record(s) of {len(found.machines)} machine(s), task {found.task}"
    return Page(title or "Survey of a fleet", about, said, not found.finds, sections)


def _line(found: Survey, machine: str) -> str:
    """A machine in a few words."""
    rows = found.of(machine)
    out = [effect.label for effect, one in found.standing_out if one.machine == machine]
    grows = [trend.label for trend in found.growing if trend.machine == machine]
    verdicts = ", ".join(dict.fromkeys(row.verdict or "failed" for row in rows))
    words = [f"stands out in {', '.join(out)}"] * bool(out) + [f"{', '.join(grows)} changes"] * bool(grows)
    return f"{machine}: {'; '.join([verdicts, *words])}"


def _machine_page(found: Survey, machine: str) -> Page:
    rows = found.of(machine)
    mine = [(effect, one) for effect in found.effects for one in effect.machines if one.machine == machine]
    trends = [trend for trend in found.trends if trend.machine == machine]
    tables: Parts = [
        Table(_ROWS, [row_cells(row) for row in rows], "Records", (), 4),
        Table(
            ["effect", "unit", "value", "std", "shrunk", "fleet", "deviation", "p"],
            [
                [e.label, e.unit, f"{m.value:.5g}", f"{m.std:.2g}", f"{m.pooled:.5g}", f"{e.mean:.5g}"]
                + ["-" if v is None else number(v, 3) for v in (m.deviation, m.p_value)]
                for e, m in mine
            ],
            title="Coefficients compared with the fleet",
            notes=[
                "shrunk: estimate shrunk toward the fleet mean. deviation: difference from the other "
                "machines, in standard deviations. p: multiplied by their number."
            ],
            left=2,
        ),
        Table(
            ["effect", "unit", "records", "slope", "std", "per", "p"],
            [
                [
                    t.label,
                    t.unit,
                    str(t.n_records),
                    f"{t.slope:.4g}",
                    f"{t.std:.2g}",
                    t.per,
                    chance(t.p_value),
                ]
                for t in trends
            ],
            title="Change with time",
            left=2,
        ),
    ]
    drawn = pictures(
        [
            (
                "course",
                lambda: _course(found, machine),
                "Coefficients over the records.",
                "With 95 % intervals.",
            )
        ]
        if trends
        else []
    )
    said = [f"{row.record}: {sentence}" for row in rows for sentence in row.sentences]
    sections = [
        Section("Pictures", drawn),
        Section("Tables", [table for table in tables if isinstance(table, Table) and table.rows]),
        Section("Findings for each record", [Paragraphs(said)] if said else []),
        Section("The fleet", [Links([("all machines", _INDEX)])]),
    ]
    out = any(one.stands_out for _, one in mine) or any(trend.grows for trend in trends)
    return Page(machine, counted(len(rows), "record"), [_line(found, machine)], not out, sections)


def _course(found: Survey, machine: str) -> ct.ControlPlot:
    """Each coefficient with a trend over the machine's records."""
    keys = [(t.kind, t.place, t.name) for t in found.trends if t.machine == machine]
    frame = Frame()
    with frame.axes([1.2] * len(keys), 1) as (axes, lines):
        for k, key in enumerate(keys):
            entries = [(row.number, e) for row in found.of(machine) for e in row.estimates if e.key == key]
            lines[k, 0] = [
                axes[k, 0].errorbar(
                    [n for n, _ in entries],
                    [e.value for _, e in entries],
                    [1.96 * e.std for _, e in entries],
                    fmt="o", color=style(0).color, capsize=2,
                )
            ]  # fmt: skip
            axes[k, 0].set_ylabel(unit_text(plain(key[0]), entries[0][1].unit))
            axes[k, 0].set_title(plain(f"at {key[1]}"), fontsize="small")
            axes[k, 0].grid(True, alpha=0.3)
        axes[-1, 0].set_xlabel("record")
        return frame.finish(axes, lines, [])
