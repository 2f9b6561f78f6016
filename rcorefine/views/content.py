"""Content of a result, from which every form of it is made.

`content` returns it by the class of the result: text, HTML, data, pictures and report all come from it.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial, singledispatch
from pathlib import Path
from typing import Any

import control as ct

from ..comparison.failure_map.search import Failure
from ..diagnosis.result import RankedEffect, Step
from ..inference.f_tests import FTest
from ..inference.parameters import EstimatedParameter
from ..results import OPTIONS
from ..writing import check_target
from .figures import Frame, spell_out
from .page import Page, write_page
from .tables import TextTable, wrapped


@dataclass(frozen=True, kw_only=True, slots=True)
class Content:
    """Everything that a result shows; what takes long is a function.

    Parameters
    ----------
    title, verdict : str
        First line, in text with the verdict in capitals.
    above, below : sequence of str
        Sentences above and below the tables.
    tables : sequence of TextTable
        Tables.
    following : str
        Next step, as a line of Python.
    answer : callable
        Returns the answer in three sentences, and whether nothing was found.
    data : callable, optional
        Returns what was found, by name; where that is not in the public fields.
    columns : callable, optional
        Returns the arguments of a pandas table, where its rows are not those of `data`.
    pictures : dict
        Function for each method of the result that draws; it takes the result, the `Frame` and the method's
        arguments.
    records : sequence of Measurement, or of FrequencyResponse
        Records of the report.
    code : callable
        Returns the code of the report.
    page : callable, optional
        Returns the report of the result, where that holds more than its text and its pictures.
    """

    title: str = ""
    verdict: str = ""
    above: Sequence[str] = ()
    tables: Sequence[TextTable] = ()
    below: Sequence[str] = ()
    following: str = ""
    answer: Callable[[], tuple[Sequence[str], bool]] = lambda: ((), True)
    data: Callable[[], Mapping[str, Any]] | None = None
    columns: Callable[[], tuple[Any, ...]] | None = None
    pictures: Mapping[str, Callable[..., ct.ControlPlot]] = field(default_factory=dict)
    records: Sequence[Any] = ()
    code: Callable[[], str] = str
    page: Callable[..., Page] | None = None


#: Fields that rows of a class show, where the others hold more than the findings.
_FIELDS: dict[type, str] = {
    Failure: "role dimension where measure statistic p_value share sentence",
    FTest: "name statistic dof p_value",
    RankedEffect: "effect beside same coefficients std fit_before fit_after p_value probability",
    EstimatedParameter: "name kind place role initial prior value coefficient std lower upper unit",
    Step: "action effect coefficients std train_rmse choice_rmse validation_rmse rivals",
}


@singledispatch
def content(result: Any) -> Content:
    """Return the content of a result; a row is its fields alone."""
    return Content()


def fields(value: Any, names: str = "") -> dict[str, Any]:
    """Return the fields named in a text; without names, all public ones."""
    asked = (names or _FIELDS.get(type(value), "")).split() or [
        f.name for f in dataclasses.fields(value) if not f.name.startswith("_")
    ]
    return {name: getattr(value, name) for name in asked}


# ------------------------------------------------------------------ text, HTML, pictures, report
def as_text(result: Any) -> str:
    """Return a result as text of at most 80 columns."""
    shown = content(result)
    tables = [table.text() for table in shown.tables]
    head = _head(shown, shown.verdict.upper())
    return "\n".join([*wrapped([head, *shown.above]), *filter(None, tables), *wrapped(_below(shown))])


def as_html(result: Any) -> str:
    """Return a result as HTML tables; the sentences stand below the first."""
    shown = content(result)
    first, *more = shown.tables
    notes = [*shown.above, *first.notes, *_below(shown)]
    first = replace(first, title=_head(shown, shown.verdict) or first.title, notes=notes)
    return "".join(table.html() for table in (first, *more))


def _head(shown: Content, verdict: str) -> str:
    return f"{shown.title}: {verdict}" if verdict else shown.title


def _below(shown: Content) -> list[str]:
    return [*shown.below, *([f"Next: {shown.following}"] if shown.following else [])]


def draw(result: Any, what: str, *args: Any, **options: Any) -> ct.ControlPlot:
    """Draw the picture that a method of a result asks for.

    Parameters
    ----------
    result : object
        Result.
    what : str
        Name of the method.
    *args, **options
        Arguments of the method; those that all pictures share make the `Frame`.
    """
    shared = {name: options.pop(name) for name in OPTIONS if name in options}
    drawn = content(result).pictures[what](result, Frame(**shared), *args, **options)
    spell_out(drawn.figure)
    return drawn


@singledispatch
def report(
    result: Any, path: Any, *, title: str | None, code: str | None, overwrite: bool, **more: Any
) -> Path:
    """Write the report of a result, if the file may be written.

    Parameters
    ----------
    result : Result
        Result.
    path, title, code, overwrite, **more
        Arguments of its method `report`.
    """
    target = check_target(path, title=title, code=code, overwrite=overwrite)
    page = (content(result).page or _plain_page)(result, **more)
    own = page.code if code is None else f"{code.rstrip()}\n\n{page.code}"
    return write_page(replace(page, title=title or page.title, code=own), target, overwrite=overwrite)


def _plain_page(result: Any) -> Page:
    """Return the page of a result: its text with its pictures."""
    shown = content(result)
    first = shown.tables[0]
    sentences, fine = shown.answer()
    pictures = []
    for name in shown.pictures:
        method = getattr(result, name)
        said = str(inspect.getdoc(method)).partition("\n")[0]
        pictures.append((name, partial(method, title=""), said))
    return Page(
        _head(shown, shown.verdict) or first.title or type(result).__name__,
        "",
        sentences or [*shown.above, *first.notes][:1],
        fine,
        pictures,
        [shown.above, *shown.tables, _below(shown)],
        code=shown.code(),
        records=shown.records,
    )
