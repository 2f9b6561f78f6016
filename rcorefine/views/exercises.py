"""Text of an exercise, and the page of a class."""

from __future__ import annotations

from ..exercises.exercise import Exercise
from ..exercises.grading import Grades
from .pages.page import Page, Section, reports
from .tables import Table, Told, number, tabulates, tells

__all__ = ["exercise_told", "grades_table", "report_grades"]


@tells(Exercise)
def exercise_told(exercise: Exercise) -> Told:
    """Return the text of an exercise: what is given and what is asked."""
    head = [
        f"Exercise {exercise.ident}: {exercise.plant}, level {exercise.level}",
        "One effect of the plant is missing in the model. Which one, where, and how large is it?",
    ]
    rows = [[effect.kind, effect.place, ", ".join(effect.coefficients)] for effect in exercise.candidates]
    notes = [
        f"Find it with .train ({exercise.train.n_samples} samples of {exercise.train.dt:g} s) and validate "
        "it with .test.",
        "check(kind, place, coefficient) grades an answer."
        if exercise.has_answer
        else "hand_in(path, student, kind, place, coefficient) writes your answer.",
    ]
    return head, Table(["kind", "place", "coefficients"], rows, head[0], notes, 3), notes


@tabulates(Grades)
def grades_table(found: Grades) -> Table:
    """A row for each answer."""
    headers = ["student", "plant", "level", "answer", "effect", "coefficient", "points", "remark"]
    rows = [
        [row.student, row.plant, str(row.level or "-"), row.answer, row.effect, row.coefficient,
         number(row.points), row.remark]
        for row in found.rows
    ]  # fmt: skip
    # remarks are text, and stand where there are any
    if not any(row.remark for row in found.rows):
        headers, rows = headers[:-1], [row[:-1] for row in rows]
    return Table(
        headers,
        rows,
        "Answers",
        ["Points: 0.6 for the effect, 0.3 for its place alone, 0.4 for the coefficient."],
        6,
    )


@reports(Grades)
def report_grades(found: Grades, *, title: str | None, code: str | None) -> Page:
    """The page of a class; see `Grades.report`."""
    graded = [row for row in found.rows if not row.remark]
    right = sum(row.effect in ("right", "tied") for row in graded)
    near = sum(row.coefficient == "near enough" for row in graded)
    left = len(found.rows) - len(graded)
    answer = [
        f"{right} of {len(graded)} answers name the effect, {near} of them with the right coefficient.",
        f"{left} could not be graded; the table shows why." if left else "Every answer could be graded.",
    ]
    students = len({row.student for row in graded})
    about = f"{len(found.rows)} answers of {students} students"
    by_plant = [
        [plant, str(len(rows)), str(sum(row.effect in ("right", "tied") for row in rows)), number(mean, 2)]
        for plant in sorted({row.plant for row in graded})
        for rows in [[row for row in graded if row.plant == plant]]
        for mean in [sum(row.points for row in rows) / len(rows)]
    ]
    tables = [
        grades_table(found),
        Table(["plant", "answers", "right", "mean points"], by_plant, "By plant", [], 1),
    ]
    return Page(
        title or "Hidden effects: results of the class", about, answer, not left, [Section("Tables", tables)]
    )
