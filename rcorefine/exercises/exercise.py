"""Exercise with sealed answers, and its grades.

An exercise has a model and two records of a plant.

The plant has an effect that the model lacks.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import control as ct
import numpy as np

from rcorefine import Effect, Measurement, PhysicalModel

from ..arguments import as_choice, as_flag, as_number, as_path, as_text, as_whole, printable
from ..exceptions import DataError, ModelError
from ..results import Result, Row
from ..writing import check_target, damaged, read_archive, replacing
from .hiding import LEVELS, TRAINING, Accepted, hide
from .plants import PLANTS, record_of

_ROUNDS = 5_000  # of the key derivation: a millisecond for each comparison
_GRID = 0.01  # of the logarithm of a coefficient


def sealed(accepted: Iterable[Accepted], salt: str) -> frozenset[str]:
    """Return the seals of all accepted answers.

    They cover effects, places, and the coefficients within their tolerance.
    """
    found = set()
    for one in accepted:
        kind, place = one.effect.kind, one.effect.place
        found.add(_seal(salt, "tied" if one.tied else "right", kind, place))
        found.add(_seal(salt, "place", place))
        first, last = (_cell(one.coefficient * (1 + s * one.tolerance)) for s in (-1.0, 1.0))
        found |= {
            _seal(salt, "value", kind, place, str(math.copysign(1, one.coefficient)), str(cell))
            for cell in range(first, last + 1)
        }
    return frozenset(found)


def is_sealed(seals: frozenset[str], salt: str, what: str, *words: str, value: float | None = None) -> bool:
    """Return whether an answer counts in the given way.

    The ways are "right", "tied", "place" and "value".
    """
    if value is not None:
        if not math.isfinite(value) or value == 0.0:
            return False
        words = (*words, str(math.copysign(1, value)), str(_cell(value)))
    return _seal(salt, what, *words) in seals


def _cell(value: float) -> int:
    return math.floor(math.log(abs(value)) / _GRID)


def _seal(salt: str, *words: str) -> str:
    return hashlib.pbkdf2_hmac("sha256", "|".join(words).encode(), salt.encode(), _ROUNDS).hex()[:32]


class _Answer(NamedTuple):
    kind: str
    place: str
    coefficient: float | None


_COEFFICIENT = 0.4  # points for the coefficient; those for the effect, and what is said of it:
_MARKS = {
    "right": (0.6, "Right: this effect, at this place."),
    "tied": (0.6, "This counts as right: the record cannot distinguish it from the hidden effect."),
    "place": (0.3, "The place is right, but the effect is another one."),
    "wrong": (0.0, "Neither this effect nor this place."),
}


@dataclass(frozen=True, slots=True)
class Mark(Row):
    """Mark of an answer.

    Attributes
    ----------
    effect : str
        "right", "tied" (the record cannot distinguish it from the right one, so it counts), "place"
        (the place is right, the law is not) or "wrong".
    coefficient : bool or None
        Whether it is near enough: within 10 %, or four standard deviations where the record shows less.
        None where none was given, or the effect is wrong.
    """

    effect: str
    coefficient: bool | None

    @property
    def points(self) -> float:
        """Return the points of the answer, from 0 to 1.

        The effect gives 0.6 (the place alone 0.3), and the coefficient 0.4.
        """
        return _MARKS[self.effect][0] + (_COEFFICIENT if self.coefficient else 0.0)

    def __str__(self) -> str:
        _, said = _MARKS[self.effect]
        if self.coefficient is None:
            return said
        return f"{said} The coefficient is {'near enough' if self.coefficient else 'not near enough'}."


@dataclass(frozen=True, slots=True, eq=False)
class Exercise(Result):
    """A model, and records of a plant that does something the model does not.

    Attributes
    ----------
    plant : str
        Name of the plant.
    level : int
        1 to 3: how little the effect does, and how much noise there is.
    model : PhysicalModel
        The linear model.
    train, test : Measurement
        Records to find the effect in, and to judge by.
    candidates : tuple of Effect
        What may be hidden; one of them is.
    ident : str
        Name of the exercise, by which `grade` finds it.
    """

    plant: str
    level: int
    model: PhysicalModel
    train: Measurement
    test: Measurement
    candidates: tuple[Effect, ...]
    ident: str
    _seals: frozenset[str] = field(repr=False)

    @property
    def has_answer(self) -> bool:
        """Return whether this copy can check answers."""
        return bool(self._seals)

    def check(self, kind: str, place: str, coefficient: float | None = None) -> Mark:
        """Return the mark of an answer.

        Parameters
        ----------
        kind, place : str
            The effect: of one of the `candidates`.
        coefficient : float, optional
            Its coefficient, in the model's units.

        Returns
        -------
        Mark

        Raises
        ------
        control.ControlArgument
            If no candidate is of this kind at this place.
        ModelError
            If this copy was saved without its answer.
        """
        kind, place, value = self._answer(kind, place, coefficient)
        if not self.has_answer:
            raise ModelError("this copy holds no answer: hand in what you found with hand_in()")
        effect = next(
            (
                word
                for word, words in (("right", (kind, place)), ("tied", (kind, place)), ("place", (place,)))
                if is_sealed(self._seals, self.ident, word, *words)
            ),
            "wrong",
        )
        if value is None or effect not in ("right", "tied"):
            return Mark(effect, None)
        return Mark(effect, is_sealed(self._seals, self.ident, "value", kind, place, value=value))

    def hand_in(
        self,
        path: str | PathLike[str],
        student: str,
        kind: str,
        place: str,
        coefficient: float | None = None,
    ) -> Path:
        """Write an answer as a file for `grade`.

        The answer is not checked.

        Parameters
        ----------
        path : str or path
            File, ``.json``.
        student : str
            Who answers.
        kind, place : str
            The effect: of one of the `candidates`.
        coefficient : float, optional
            Its coefficient, in the model's units.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        control.ControlArgument
            If no candidate is of this kind at this place.
        """
        about = {"exercise": self.ident, "student": as_text(student, "student")}
        answer = about | self._answer(kind, place, coefficient)._asdict()
        target = as_path(path)
        with replacing(target) as stream:
            stream.write(json.dumps(answer, indent=1).encode())
        return target

    def save(self, path: str | PathLike[str], *, answer: bool = True) -> Path:
        """Write the exercise as one file, for `load_exercise`.

        Parameters
        ----------
        path : str or path
            File, ``.npz``.
        answer : bool
            Whether it can check answers; copies for students of graded work cannot.

        Returns
        -------
        Path
            The file.
        """
        target, answer = as_path(path), as_flag(answer, "answer")
        whole = [
            np.hstack([getattr(r, what) for r in (self.train, self.test)]) for what in ("inputs", "outputs")
        ]
        seals = sorted(self._seals) if answer else []
        about = json.dumps({"plant": self.plant, "level": self.level, "seals": seals})
        with replacing(target) as stream:
            np.savez_compressed(stream, inputs=whole[0], outputs=whole[1], about=np.array(about))
        return target

    def _answer(self, kind: str, place: str, coefficient: float | None) -> _Answer:
        wanted = Effect(kind, place)
        if wanted.key not in [effect.key for effect in self.candidates]:
            known = ", ".join(f"{effect.kind} at {effect.place}" for effect in self.candidates)
            raise ct.ControlArgument(f"no candidate {wanted.kind!r} at {place!r}; the candidates are {known}")
        value = None if coefficient is None else as_number(coefficient, "coefficient")
        return _Answer(wanted.kind, wanted.place, value)


def hidden_effect(seed: int, plant: str = "motor", level: int = 1) -> Exercise:
    """Make an exercise: a plant with one effect that its model lacks.

    Each seed gives another exercise.

    Parameters
    ----------
    seed : int
        0 or larger. The same seed makes the same exercise.
    plant : {"rc_circuit", "motor", "servo", "thermal", "car", "pendulum", "crane", "frame"}
        What the record is of.
    level : {1, 2, 3}
        The model misses 30, 15 or 8 % of the outputs, and the noise is 1, 2 or 3 % of them.

    Returns
    -------
    Exercise
        The effect can be found: ``diagnose(model, train, candidates=candidates)`` names it, or
        names it among several that the record cannot distinguish, all of which count.

    Raises
    ------
    control.ControlArgument
        If there is no such plant or level.
    ModelError
        If what this seed hides could not be found again; take another.

    Notes
    -----
    The size of every candidate is searched so that the model misses the stated share. What is hidden is
    at least 10 standard deviations away from every other candidate of one coefficient, at any size of
    that; then a diagnosis must name it or tie it, with the coefficient within its tolerance.

    The exercise holds neither seed nor answer, only salted digests of what counts. Who knows the
    seed can make the exercise again and read its source: for graded work hand out files
    (`Exercise.save` with ``answer=False``) made from seeds that you keep.

    Examples
    --------
    >>> from rcorefine import exercises
    >>> exercise = exercises.hidden_effect(3, "motor")
    >>> exercise.train.n_samples, exercise.test.n_samples
    (2000, 1000)
    >>> print(exercise.check("input_gain", "voltage"))
    Neither this effect nor this place.
    """
    seed = as_whole(seed, "seed", least=0, most=2**63)
    chosen = PLANTS[as_choice(plant, "plant", tuple(PLANTS))]
    level = as_whole(level, "level", least=min(LEVELS), most=max(LEVELS))
    model = chosen.make()
    candidates = chosen.candidates(model)
    hidden = hide(chosen, model, candidates, level, [seed, level, *plant.encode()])
    ident = _ident(plant, level, hidden.train, hidden.test)
    seals = sealed(hidden.accepted, ident)
    return Exercise(plant, level, model, hidden.train, hidden.test, candidates, ident, seals)


def load_exercise(path: str | PathLike[str]) -> Exercise:
    """Read an exercise that `Exercise.save` wrote.

    Parameters
    ----------
    path : str or path
        File.

    Returns
    -------
    Exercise

    Raises
    ------
    DataError
        If it is another file, or damaged.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from rcorefine import exercises
    >>> exercise = exercises.hidden_effect(3, "motor")
    >>> path = exercise.save(pathlib.Path(tempfile.mkdtemp()) / "ada.npz", answer=False)
    >>> exercises.load_exercise(path).ident == exercise.ident
    True
    """
    arrays = read_archive(as_path(path))
    with damaged(path, "is no exercise that Exercise.save wrote, or it is damaged"):
        about: dict[str, Any] = json.loads(str(arrays["about"]))
        plant, level, seals = about["plant"], int(about["level"]), frozenset(map(str, about["seals"]))
        chosen = PLANTS[plant]
        model = chosen.make()
        train, test = record_of(model, arrays["inputs"], arrays["outputs"], dt=chosen.dt).split(TRAINING)
    ident = _ident(plant, level, train, test)
    return Exercise(plant, level, model, train, test, chosen.candidates(model), ident, seals)


def _ident(plant: str, level: int, *records: Measurement) -> str:
    digest = hashlib.sha256(f"{plant} {level}".encode())
    for record in records:
        digest.update(record.inputs.tobytes() + record.outputs.tobytes())
    return digest.hexdigest()[:16]


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
class Grades(Result):
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
        writer.writerows([_as_text(getattr(row, name)) for name in _COLUMNS] for row in self.rows)
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
        If ``class.html`` or ``class.csv`` is another file than `grade` writes; neither is then written.

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
    rows = [_graded(path, printable(str(path.relative_to(at))), known) for path in sorted(at.rglob("*.json"))]
    found = Grades(tuple(sorted(rows, key=lambda row: (row.student.casefold(), row.file))))
    check_target(at / "class.html")
    with replacing(check_target(at / "class.csv", ours=",".join(_COLUMNS))) as stream:
        stream.write(found.csv().encode())
    found.report(at / "class.html")
    return found


def _graded(path: Path, file: str, known: dict[str, Exercise]) -> Grade:
    try:
        with damaged(path, "is no answer that hand_in() wrote"):
            answer: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            student, ident, kind, place = (
                printable(str(answer[name])) for name in ("student", "exercise", "kind", "place")
            )
            value = answer["coefficient"]
            text = f"{kind} at {place}" + ("" if value is None else f": {printable(str(value))}")
            exercise = known.get(ident)
            if exercise is None:
                return Grade(student, file, answer=text, remark="belongs to none of the exercises")
            try:
                mark = exercise.check(kind, place, value)
            except (ModelError, ct.ControlArgument) as error:
                return Grade(student, file, exercise.plant, exercise.level, text, remark=str(error))
    except (DataError, OSError) as error:
        return Grade("", file, remark=printable(str(error)))
    near = {None: "", True: "near enough", False: "off"}[mark.coefficient]
    return Grade(student, file, exercise.plant, exercise.level, text, mark.effect, near, mark.points)


def _as_text(value: Any) -> Any:
    """A cell that no spreadsheet takes for a formula, also split at ';'."""
    return re.sub(r"(^|;)(?=[=+@\t\r\n-])", r"\1'", value) if isinstance(value, str) else value
