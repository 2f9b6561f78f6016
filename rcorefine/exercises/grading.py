"""A folder of answers, graded."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import control as ct

from ..arguments import as_path
from ..exceptions import DataError, ModelError
from ..results import Reported, Row
from ..writing import replacing
from .exercise import Exercise, load_exercise

_COLUMNS = ("student", "file", "plant", "level", "answer", "effect", "coefficient", "points", "remark")


@dataclass(frozen=True, slots=True)
class Grade(Row):
    """One answer: a row of the class page.

    Attributes
    ----------
    student, file : str
        Who, and in which file.
    plant : str
        Of the exercise, "" where the exercise is unknown.
    level : int
        Likewise, 0.
    answer : str
        What was handed in.
    effect, coefficient : str
        As in `Mark`; the coefficient "near enough", "off" or "".
    points : float
        0 to 1.
    remark : str
        Why it could not be graded.
    """

    student: str
    file: str
    plant: str = ""
    level: int = 0
    answer: str = ""
    effect: str = ""
    coefficient: str = ""
    points: float = 0.0
    remark: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Grades(Reported):
    """The answers of a class.

    Attributes
    ----------
    rows : tuple of Grade
        By student.
    """

    rows: tuple[Grade, ...]

    def csv(self) -> str:
        """The rows as comma-separated text with a header line.

        Returns
        -------
        str
        """
        text = io.StringIO()
        writer = csv.writer(text)
        writer.writerow(_COLUMNS)
        writer.writerows([_cell(getattr(row, name)) for name in _COLUMNS] for row in self.rows)
        return text.getvalue()


def grade(
    folder: str | PathLike[str],
    exercises: str | PathLike[str] | None = None,
) -> Grades:
    """Grade the answers in a folder, and write a report into it.

    The report consists of ``class.html`` and ``class.csv``.

    Parameters
    ----------
    folder : str or path
        Answers that `Exercise.hand_in` wrote, ``*.json``, in subfolders too.
    exercises : str or path, optional
        Folder of the exercises, ``*.npz``, saved with their answers; default the same one. Keep
        it apart from what students can write to: their own copy proves nothing.

    Returns
    -------
    Grades
        A row for each answer. What cannot be read or belongs to no exercise has 0 points and a remark.

    Raises
    ------
    NotADirectoryError
        If a folder does not exist.
    FileExistsError
        If ``class.html`` is no report of rcorefine.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from rcorefine import exercises
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> exercise = exercises.hidden_effect(3, "motor")
    >>> path = exercise.save(folder / "ada.npz")
    >>> path = exercise.hand_in(folder / "ada.json", "Ada", "input_gain", "voltage", 0.1)
    >>> exercises.grade(folder).rows[0].effect
    'wrong'
    """
    at = as_path(folder)
    own = at if exercises is None else as_path(exercises)
    for one in (at, own):
        if not one.is_dir():
            raise NotADirectoryError(f"{one} is no folder")
    known: dict[str, Exercise] = {}
    for path in sorted(own.rglob("*.npz")):
        try:
            exercise = load_exercise(path)
        except DataError:  # a record, or anything else
            continue
        if exercise.ident not in known or exercise.has_answer:
            known[exercise.ident] = exercise
    rows = [_graded(path, str(path.relative_to(at)), known) for path in sorted(at.rglob("*.json"))]
    found = Grades(tuple(sorted(rows, key=lambda row: (row.student.casefold(), row.file))))
    with replacing(at / "class.csv") as stream:
        stream.write(found.csv().encode())
    found.report(at / "class.html")
    return found


def _graded(path: Path, file: str, known: dict[str, Exercise]) -> Grade:
    try:
        answer: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        student, ident = str(answer["student"]), str(answer["exercise"])
        kind, place, value = str(answer["kind"]), str(answer["place"]), answer["coefficient"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        return Grade("", file, remark=f"no answer that hand_in() wrote: {error or type(error).__name__}")
    text = f"{kind} at {place}" + (
        "" if value is None else f": {value:g}" if _is_number(value) else f": {value}"
    )
    exercise = known.get(ident)
    if exercise is None:
        return Grade(student, file, answer=text, remark="belongs to none of the exercises")
    try:
        mark = exercise.check(kind, place, value)
    except (ModelError, ct.ControlArgument) as error:
        return Grade(student, file, exercise.plant, exercise.level, text, remark=str(error))
    near = {None: "", True: "near enough", False: "off"}[mark.coefficient]
    return Grade(student, file, exercise.plant, exercise.level, text, mark.effect, near, mark.points)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _cell(value: Any) -> Any:
    """A cell that no spreadsheet takes for a formula."""
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t")) else value
