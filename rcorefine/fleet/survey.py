"""Many records of many machines: one row each, and what they say together."""

from __future__ import annotations

import inspect
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import control as ct

from rcorefine import Effect, diagnose, improve, localize_damage, read_record, refine

from ..arguments import as_choice, as_mapping, as_share
from ..progress import Progress
from .comparison import SurveyRow, fleet_effects, trends
from .executing import as_submitter, work_off
from .pieces import Piece, again, examine, pieces_of
from .result import Survey
from .tasks import TASKS

_MODES = ("common", "own")
_MOST = 6  # effects of a fleet that one record is asked for together
#: The function behind each task, which says what options there are.
ASKED: dict[str, Callable[..., Any]] = {
    "diagnose": diagnose,
    "improve": improve,
    "localize": localize_damage,
    "refine": refine,
}
_OURS = ("model", "data", "executor", "progress")


def survey(
    models: Any,
    records: Any,
    task: str = "diagnose",
    *,
    executor: Any = None,
    effects: str = "common",
    options: Mapping[str, Any] | None = None,
    reading: Mapping[str, Any] | None = None,
    significance: float = 0.01,
    progress: bool | None = None,
) -> Survey:
    """Examine many records of many machines, and compare the machines.

    Every record is examined alone, here or on an executor, and gives one row; one that fails gives a
    row with the reason and stops nothing. Then the coefficients of the machines are compared:
    which effects are common to the fleet, which belong to one machine, which grow with time.

    Parameters
    ----------
    models : model, path or mapping
        One model for all (StateSpace, PhysicalModel, Refinement, or the path of a file that `rcorefine`
        reads), or a mapping from each machine to its own, or a folder with a file per machine.
    records : mapping or path
        From each machine to its record or a list of records in order of time; a record is a Measurement
        or a path, which is read by the worker that needs it. Or a folder: each file in it is the record of
        a machine of that name, each folder in it a machine whose files are its records in order of
        their names (run2 before run10).
    task : {"diagnose", "improve", "localize", "refine"}
        What is asked of each record.
    executor : concurrent.futures.Executor or dask.distributed.Client, optional
        Where the records are examined; here, in order, by default. The answer is the same to the
        last bit on processors of one kind.
    effects : {"common", "own"}
        "common": each effect that any record names is then estimated in every record, together with the
        others named (six at most), so that the comparison of the machines does not rest on
        those alone that had enough of it to be named. "own": each record is asked for its own effects only.
    options : dict, optional
        Of the task, by name: ``{"candidates": [...], "tolerance": 0.02}``; "refine" asks for its "effects".
    reading : dict, optional
        How files are read: ``inputs``, ``outputs``, ``time``, ``dt``, ``hold``, as the command line has
        them; by default columns are named like the model's signals, with a column "time".
    significance : float
        Rate of false claims of each sort about the fleet: a common effect, a machine that stands out,
        a change with time.
    progress : bool, optional
        Whether to show a bar on standard error. By default in a terminal and in a notebook.

    Returns
    -------
    Survey
        `rows`, `effects`, `trends`; `summary()` in words, `plot`, `report(folder)`, `breaches(conditions)`.

    Raises
    ------
    ModelError
        If a machine has no model.
    DataError
        If there is no record.
    KeyboardInterrupt
        On Ctrl-C; its attribute ``survey`` is the `Survey` of the rows that were done.

    Notes
    -----
    A machine's coefficient is the mean over its records. Between machines it is taken for normally
    distributed with an unknown variance (DerSimonian and Laird); each machine's value is
    drawn toward the mean as far as its error asks for it. A machine stands out where its difference to
    the others is more than the errors and that variance explain, allowing for their number: at
    least three others are needed. A change with time is the slope of a weighted line through the records of
    one machine, three or more, their scatter beyond the errors taken alike in all machines; its p-value
    allows for the number of machines and coefficients (Holm). Records whose verdict is "ambiguous" or
    "unexplained" enter no comparison of their own naming, the latter none at all.

    Examples
    --------
    >>> import numpy as np, rcorefine as rco
    >>> model = rco.mass_spring_damper([1.0], [0.4], [100.0], sensors="displacement")
    >>> laws = [rco.Effect(kind, "link1") for kind in ("stiffness", "damping")]
    >>> def record(k, seed):
    ...     rng = np.random.default_rng(seed)
    ...     force = 10 * rng.standard_normal(600)
    ...     plant = rco.mass_spring_damper([1.0], [0.4], [k], sensors="displacement")
    ...     y = rco.simulate(plant, rco.Measurement(force, np.zeros(600), dt=0.02), "zero").outputs[0]
    ...     return rco.Measurement(force, y + 0.03 * y.std() * rng.standard_normal(600), dt=0.02)
    >>> fleet = {f"pump{i}": record(k, i) for i, k in enumerate([89.0, 90.0, 91.0, 90.5, 70.0])}
    >>> found = rco.survey(model, fleet, "refine", options={"effects": laws[:1]})
    >>> [(effect.label, machine.machine) for effect, machine in found.standing_out]
    [('stiffness at link1 (k1)', 'pump4')]
    """
    as_choice(task, "task", TASKS)
    as_choice(effects, "effects", _MODES)
    significance = as_share(significance, "significance")
    asked = _known(options, "options", ASKED[task])
    pieces = pieces_of(models, records, task, asked, _known(reading, "reading", read_record))
    submitter = as_submitter(executor)
    rows: dict[int, SurveyRow] = {}

    def lost(piece: Piece, error: BaseException) -> SurveyRow:
        return piece.failed(f"the worker was lost, {type(error).__name__}: {error}")

    def so_far(notes: Sequence[str] = ()) -> Survey:
        found = tuple(rows[i] for i in sorted(rows))
        fleet, courses = fleet_effects(found, significance), trends(found, significance)
        return Survey(task, effects, significance, found, fleet, courses, tuple(notes))

    try:
        with Progress(progress) as bar, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with bar.counted(len(pieces), "records") as done:
                work_off(examine, pieces, submitter, rows, lost, done)
            notes: list[str] = []
            if effects == "common" and task in ("diagnose", "improve"):
                wanted, notes = _of_the_fleet([rows[i] for i in sorted(rows)])
                lacking = {i: (pieces[i], rows[i], wanted) for i in _lacking(rows, wanted)}
                compared: dict[int, SurveyRow] = {}
                with bar.counted(len(lacking), "comparing the same effects") as done:
                    work_off(
                        again, list(lacking.values()), submitter, compared, lambda task, _: task[1], done
                    )
                rows |= {i: compared[k] for k, i in enumerate(lacking)}
        return so_far(notes)
    except KeyboardInterrupt as stop:
        left = f"Interrupted: {len(pieces) - len(rows)} of {len(pieces)} record(s) were not examined."
        stop.survey = so_far([left])  # type: ignore[attr-defined]
        stop.add_note(f"{left} The results so far are in the attribute `survey` of this exception.")
        raise


def _known(given: Mapping[str, Any] | None, name: str, function: Any) -> dict[str, Any]:
    """Return the options after a check that the function accepts them.

    Options that the survey sets itself are not accepted.
    """
    options = as_mapping(given, name, "values")
    takes = [key for key in inspect.signature(function).parameters if key not in (*_OURS, "path")]
    unknown = [key for key in options if key not in takes]
    if unknown:
        raise ct.ControlArgument(f"{name} has no {unknown[0]!r}; there are {', '.join(takes)}")
    return options


def _of_the_fleet(rows: Sequence[SurveyRow]) -> tuple[tuple[Effect, ...], list[str]]:
    """Return the effects found in any record, the most frequent first.

    The second result holds a note on effects that are left out.
    """
    found = [effect for row in rows for effect in row.effects]
    first = {effect.key: effect for effect in reversed(found)}
    named = [first[key] for key, _ in Counter(effect.key for effect in found).most_common()]
    rest = ", ".join(effect.label for effect in named[_MOST:])
    notes = [f"Compared only in the records in which they were found: {rest}."] if rest else []
    return tuple(named[:_MOST]), notes


def _lacking(rows: Mapping[int, SurveyRow], wanted: Sequence[Effect]) -> list[int]:
    """Records that were fitted with other effects than all of the fleet's."""
    keys = {effect.key for effect in wanted}
    return [
        i
        for i, row in sorted(rows.items())
        if keys and row.error is None and row.verdict != "unexplained"
        and {effect.key for effect in row.effects} != keys
    ]  # fmt: skip
