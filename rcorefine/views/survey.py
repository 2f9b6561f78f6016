"""Text, picture and report of a survey; exercises and the page of a class."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import control as ct
import numpy as np

from ..arguments import as_flag, as_path
from ..exercises.exercise import Exercise, Grades
from ..fleet.comparison import FleetEffect, SurveyRow
from ..fleet.result import Survey
from ..results import chance, counted, with_error
from ..writing import check_target
from .content import Content, content, fields, report
from .figures import BAND, Frame, plain, style, unit_text
from .page import Page, links, paragraphs, write_page
from .tables import TextTable, cells, number

_SHOWN = 12  # rows of the text; the others are counted
_NAMED = 40  # machines up to which each has its name on the axis
_INDEX = "index.html"
_ROWS = ["machine", "record", "verdict", "effect", "coefficient", "probability", "seconds"]


def _row_cells(row: SurveyRow) -> list[str]:
    """Return the cells of one row, as in `_ROWS`."""
    if row.error is not None:
        return [row.machine, row.record, "failed", row.error, "", "", f"{row.seconds:.2g}"]
    size = "" if row.coefficient is None or row.std is None else with_error(row.coefficient, row.std)
    sure = "" if row.probability is None else number(row.probability, 3)
    return [row.machine, row.record, row.verdict or "", row.label, size, sure, f"{row.seconds:.2g}"]


@content.register
def survey_content(found: Survey) -> Content:
    """Return the content of a survey, the most important rows first.

    Failed rows come first, then machines that stand out, then rows with effects.
    """
    out = {machine.machine for _, machine in found.standing_out} | {t.machine for t in found.growing}
    order = sorted(found.rows, key=lambda row: (row.error is None, row.machine not in out, not row.effects))
    said = found.sentences()
    left = len(order) - _SHOWN
    more = [f"... and {counted(left, 'row')} more in `rows` and `to_dataframe()`."] if left > 0 else []
    rows = [_row_cells(row) for row in order[:_SHOWN]]
    return Content(
        title=f"Survey ({found.task}): {said[0]}",
        tables=[TextTable([*_ROWS[:-2], "prob.", "s"], rows, left=4)],
        below=[*more, *said[1:]],
        answer=lambda: (said, not found.finds),
        data=lambda: {**fields(found, "task mode significance rows effects trends"), "summary": said},
        pictures={"plot": plot_survey},
    )


def plot_survey(found: Survey, frame: Frame) -> ct.ControlPlot:
    """Panels, one per coefficient; see `Survey.plot`."""
    shown = [effect for effect in found.effects if effect.sort != "unclear"] or list(found.effects)
    with frame.axes([2.0] * max(len(shown), 1), 1, sharex=False) as (axes, lines):
        labels = frame.labels([effect.label for effect in shown]) if shown else []
        for k, (effect, label) in enumerate(zip(shown, labels, strict=True)):
            lines[k, 0] = _panel(axes[k, 0], effect)
            axes[k, 0].set_title(plain(f"{label}: {effect.sort}"), fontsize="medium")
            axes[k, 0].set_ylabel(unit_text("", effect.unit) if effect.unit else "")
        if not shown:
            axes[0, 0].text(0.5, 0.5, "no coefficient to compare", ha="center", va="center")
        return frame.finish(axes, lines, f"{len(found.machines)} machines")


def _panel(panel: Any, effect: FleetEffect) -> list[Any]:
    machines = effect.machines
    where = np.arange(len(machines))
    panel.axhspan(effect.mean - effect.spread, effect.mean + effect.spread, color=BAND, alpha=0.6, lw=0)
    drawn = [panel.axhline(effect.mean, color="0.3", linewidth=1.2, label="fleet: mean, spread")]
    for out, color, text in ((False, style(0).color, "machine, 95 %"), (True, style(1).color, "stands out")):
        mine = [(k, m.value, 1.96 * m.std) for k, m in enumerate(machines) if m.stands_out == out]
        if mine:
            bars = zip(*mine, strict=True)
            drawn.append(panel.errorbar(*bars, fmt="o", color=color, capsize=2, markersize=3.5, label=text))
    pooled, said = [m.pooled for m in machines], "shrunk toward the fleet mean"
    drawn += panel.plot(where, pooled, "_", color="0.15", markersize=9, label=said)
    if len(machines) <= _NAMED:
        names = [plain(m.machine) for m in machines]
        panel.set_xticks(where, names, rotation=40, ha="right", fontsize="small")
    else:
        panel.set_xlabel(f"machine (of {len(machines)})")
    panel.axhline(0.0, color="black", linewidth=0.6)
    return drawn


@report.register
def report_survey(
    found: Survey, folder: str | PathLike[str], *, title: str | None, code: str | None, overwrite: bool
) -> Path:
    """Write an index page and a page per machine; see `Survey.report`."""
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
    said = (
        "Points: estimates from the records of each machine; dashes: estimates shrunk toward the "
        "fleet mean according to their errors; gray: spread between machines. Machines that "
        "stand out have another color."
    )
    effects = []
    for e in found.effects:
        count = f"{len(e.machines)} of {e.n_machines}"
        figures = cells(e, "mean:.5g std:.2g spread:.2g")
        effects.append([*cells(e, "label unit sort"), count, *figures, chance(e.p_value), chance(e.p_alike)])
    common = TextTable(
        ["effect", "unit", "", "machines", "mean", "std", "spread", "p (mean 0)", "p (all equal)"],
        effects,
        title="Effects over the fleet",
        notes=[
            "Mean and spread are those of the machines that do not stand out. p (mean 0): corrected by Holm."
        ],
        left=3,
    )
    failures = [[r.machine, r.record, r.error or ""] for r in found.failed]
    failed = TextTable([*_ROWS[:2], "why"], failures, "Failed", (), 3)
    about = f"{len(found.rows)} record(s) of {len(found.machines)} machine(s), task {found.task}"
    return Page(
        title or "Survey of a fleet",
        about,
        found.sentences(),
        not found.finds,
        pictures=[("fleet", partial(found.plot, title=""), said)] if found.effects else [],
        tables=[common, failed],
        more={"Machines": [links((_line(found, machine), file) for machine, file in files.items())]},
        code=code or "",
    )


def _line(found: Survey, machine: str) -> str:
    """A machine in a few words."""
    out = [effect.label for effect, one in found.standing_out if one.machine == machine]
    grows = [trend.label for trend in found.growing if trend.machine == machine]
    verdicts = ", ".join(dict.fromkeys(row.verdict or "failed" for row in found.of(machine)))
    words = [f"stands out in {', '.join(out)}"] * bool(out) + [f"{', '.join(grows)} changes"] * bool(grows)
    return f"{machine}: {'; '.join([verdicts, *words])}"


def _machine_page(found: Survey, machine: str) -> Page:
    rows = found.of(machine)
    mine = [(effect, one) for effect in found.effects for one in effect.machines if one.machine == machine]
    trends = [trend for trend in found.trends if trend.machine == machine]
    course = (
        "course",
        partial(_course, found, machine),
        "Coefficients over the records, with 95 % intervals.",
    )
    said = [f"{row.record}: {sentence}" for row in rows for sentence in row.sentences]
    out = any(one.stands_out for _, one in mine) or any(trend.grows for trend in trends)
    return Page(
        machine,
        counted(len(rows), "record"),
        [_line(found, machine)],
        not out,
        pictures=[course] if trends else [],
        tables=_machine_tables(rows, mine, trends),
        more={
            "Findings for each record": [paragraphs(said)] if said else [],
            "The fleet": [links([("all machines", _INDEX)])],
        },
    )


def _machine_tables(rows: Sequence[SurveyRow], mine: Sequence[Any], trends: Sequence[Any]) -> list[TextTable]:
    compared = [
        [e.label, e.unit, *cells(m, "value:.5g std:.2g pooled:.5g"), f"{e.mean:.5g}"]
        + ["-" if v is None else number(v, 3) for v in (m.deviation, m.p_value)]
        for e, m in mine
    ]
    changes = [[*cells(t, "label unit n_records slope:.4g std:.2g per"), chance(t.p_value)] for t in trends]
    return [
        TextTable(_ROWS, [_row_cells(row) for row in rows], "Records", (), 4),
        TextTable(
            ["effect", "unit", "value", "std", "shrunk", "fleet", "deviation", "p"],
            compared,
            title="Coefficients compared with the fleet",
            notes=[
                "shrunk: estimate shrunk toward the fleet mean. deviation: difference from the other "
                "machines, in standard deviations. p: multiplied by their number."
            ],
            left=2,
        ),
        TextTable(
            ["effect", "unit", "records", "slope", "std", "per", "p"], changes, "Change with time", left=2
        ),
    ]


def _course(found: Survey, machine: str) -> ct.ControlPlot:
    """Each coefficient with a trend over the machine's records."""
    keys = [(t.kind, t.place, t.name) for t in found.trends if t.machine == machine]
    frame = Frame()
    with frame.axes([1.2] * len(keys), 1) as (axes, lines):
        for k, key in enumerate(keys):
            axis = axes[k, 0]
            entries = [(row.number, e) for row in found.of(machine) for e in row.estimates if e.key == key]
            points = [(number_of, e.value, 1.96 * e.std) for number_of, e in entries]
            bars = axis.errorbar(*zip(*points, strict=True), fmt="o", color=style(0).color, capsize=2)
            lines[k, 0] = [bars]
            axis.set_ylabel(unit_text(key[0], entries[0][1].unit))
            axis.set_title(plain(f"at {key[1]}"), fontsize="small")
        axes[-1, 0].set_xlabel("record")
        return frame.finish(axes, lines, legends=[])


@content.register
def exercise_content(exercise: Exercise) -> Content:
    """Return the content of an exercise: what is given and what is asked."""
    rows = [[effect.kind, effect.place, ", ".join(effect.coefficients)] for effect in exercise.candidates]
    return Content(
        title=f"Exercise {exercise.ident}: {exercise.plant}, level {exercise.level}",
        above=["One effect of the plant is missing in the model. Which one, where, and how large is it?"],
        tables=[TextTable(["kind", "place", "coefficients"], rows, left=3)],
        below=[
            f"Find it with .train ({exercise.train.n_samples} samples of {exercise.train.dt:g} s) and "
            "validate it with .test.",
            "check(kind, place, coefficient) grades an answer."
            if exercise.has_answer
            else "hand_in(path, student, kind, place, coefficient) writes your answer.",
        ],
    )


@content.register
def grades_content(found: Grades) -> Content:
    """Return the content of grades: a row for each answer, with remarks."""
    headers = "student plant level answer effect coefficient points remark".split()
    shown = slice(None if any(row.remark for row in found.rows) else -1)
    rows = []
    for row in found.rows:
        figures = cells(row, "answer effect coefficient points:.4g remark")
        rows.append([row.student, row.plant, str(row.level or "-"), *figures][shown])
    note = "Points: 0.6 for the effect, 0.3 for its place alone, 0.4 for the coefficient."
    table = TextTable(headers[shown], rows, "Answers", [note], 6)
    return Content(tables=[table], page=partial(_class_page, table))


def _right(rows: Sequence[Any]) -> int:
    return sum(row.effect in ("right", "tied") for row in rows)


def _class_page(table: TextTable, found: Grades) -> Page:
    graded = [row for row in found.rows if not row.remark]
    near = sum(row.coefficient == "near enough" for row in graded)
    left = len(found.rows) - len(graded)
    answer = [
        f"{_right(graded)} of {len(graded)} answers name the effect, {near} of them with the right "
        "coefficient.",
        f"{left} could not be graded; the table shows why." if left else "Every answer could be graded.",
    ]
    by_plant = []
    for plant in sorted({row.plant for row in graded}):
        rows = [row for row in graded if row.plant == plant]
        mean = number(sum(row.points for row in rows) / len(rows), 2)
        by_plant.append([plant, str(len(rows)), str(_right(rows)), mean])
    plants = TextTable(["plant", "answers", "right", "mean points"], by_plant, "By plant")
    about = f"{len(found.rows)} answers of {len({row.student for row in graded})} students"
    return Page("Hidden effects: results of the class", about, answer, not left, tables=[table, plants])
