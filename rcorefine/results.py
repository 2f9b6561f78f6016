"""Base classes of results: text, HTML, pictures and reports.

The function that shows a result is looked up, never imported.

The views register themselves when they are loaded, which happens on first use.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypedDict, TypeVar

from .arguments import printable

if TYPE_CHECKING:
    from .data.measurement import Measurement


P = ParamSpec("P")
T = TypeVar("T")

_views: dict[tuple[type, str], Callable[..., Any]] = {}


def shows(kind: type, what: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Register a function as a view of a class.

    It shows results of this class as "text", "html", "plot", ...
    """

    def enter(view: Callable[P, T]) -> Callable[P, T]:
        _views[kind, what] = view
        return view

    return enter


def show(result: object, what: str, *args: Any, **options: Any) -> Any:
    """Show a result by the view that was entered for its class.

    Parameters
    ----------
    result : object
        Result.
    what : str
        "text", "html", or the name of the method that asks.
    *args, **options
        For the view.

    Raises
    ------
    TypeError
        If an option does not exist.
    """
    method = getattr(type(result), what, None)
    unknown = [] if method is None else [name for name in options if name not in _parameters(method)]
    if unknown:
        raise TypeError(f"{type(result).__name__}.{what}() got an unexpected keyword argument {unknown[0]!r}")
    return _view(type(result), what)(result, *args, **options)


def _view(kind: type, what: str) -> Callable[..., Any]:
    """Return the view of a class or of one of its base classes.

    The views are loaded if none is found.
    """
    for loaded in (False, True):
        if loaded:
            import_module(f"{__package__}.views")
        for base in kind.__mro__:
            if (base, what) in _views:
                return _views[base, what]
    raise TypeError(f"nothing shows a {kind.__name__} as {what!r}")


class Data:
    """Result of a computation, as data."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain objects for strict JSON.

        Returns
        -------
        dict
            Lists, dicts, numbers and text; what is not finite is None, a complex number has "re" and "im".
        """
        return dict(show(self, "to_dict"))

    def to_dataframe(self) -> Any:
        """The rows of what was found, or its signals.

        Returns
        -------
        pandas.DataFrame

        Raises
        ------
        MissingExtraError
            If pandas is not installed.
        """
        return show(self, "to_dataframe")


class Row(Data):
    """One line of a result: the same dict as there, and a table of one row."""

    __slots__ = ()


class Result(Data):
    """Result that is shown as text or, in a notebook, as HTML."""

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if "__repr__" not in cls.__dict__:  # a dataclass would write one of all its arrays
            cls.__repr__ = Result.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        first = next((line for line in str(self).splitlines() if line.strip()), "")
        kind = type(self).__name__
        return f"<{first.strip()}>" if first.startswith(kind) else f"<{kind}: {first.strip()}>"

    def __str__(self) -> str:
        return "\n".join(map(printable, str(show(self, "text")).split("\n")))

    def _repr_html_(self) -> str:
        return str(show(self, "html"))


class Reported(Result):
    """A result that writes a report."""

    __slots__ = ()

    def report(
        self,
        path: str | PathLike[str],
        *,
        title: str | None = None,
        code: str | None = None,
        overwrite: bool = False,
    ) -> Path:
        """Write the result to one HTML file.

        It contains the answer, pictures, tables, code and versions.

        Parameters
        ----------
        path : str or path
            File to write; an older report there is replaced.
        title : str, optional
            Heading.
        code : str, optional
            Code or command that made the result, printed above the generated code.
        overwrite : bool
            Replace a file there that is no report, too.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        FileNotFoundError
            If the folder does not exist.
        FileExistsError
            If another file is there.
        """
        return Path(show(self, "report", path, title=title, code=code, overwrite=overwrite))


class ReportedModel(Result):
    """Refined model that writes a report.

    The report compares it with a record if one is given.
    """

    __slots__ = ()

    def report(
        self,
        path: str | PathLike[str],
        *,
        data: Measurement | None = None,
        title: str | None = None,
        code: str | None = None,
        overwrite: bool = False,
    ) -> Path:
        """Write the result to one HTML file.

        It contains the answer, pictures, tables, code and versions.

        Parameters
        ----------
        path : str or path
            File to write; an older report there is replaced.
        data : Measurement, optional
            Record to show the models beside; the result keeps none.
        title : str, optional
            Heading.
        code : str, optional
            Code or command that made the result, printed above the generated code.
        overwrite : bool
            Replace a file there that is no report, too.

        Returns
        -------
        Path
            The file.

        Raises
        ------
        FileNotFoundError
            If the folder does not exist.
        FileExistsError
            If another file is there.
        """
        return Path(show(self, "report", path, data=data, title=title, code=code, overwrite=overwrite))


class Look(TypedDict, total=False):
    """Options for the look of a picture.

    Every picture takes these, as in python-control.
    """

    title: str | None
    legend_loc: str | bool | None
    rcParams: Mapping[str, Any] | None
    show_legend: bool | None


class Options(Look, total=False):
    """... and where it is drawn, and what its curves are called."""

    ax: Any
    label: str | Sequence[str] | None


OPTIONS = ("ax", "label", "title", "legend_loc", "rcParams", "show_legend")

_TEXTS = {
    "title": "str, optional\n    Title of the figure.",
    "legend_loc": "str or False, optional\n    Place of the legend, as in matplotlib; False for none.",
    "rcParams": "dict, optional\n    Matplotlib settings on top of `control.rcParams`.",
    "show_legend": "bool, optional\n    Force the legend on or off.",
}


def picture(draw: Callable[P, T]) -> Callable[P, T]:
    """Add the common options to the signature and docstring of a picture.

    The function takes them as ``**options: Unpack[Options]`` (or `Look`), and documents `ax` and `label`.
    """
    own = inspect.signature(draw)
    *named, options = own.parameters.values()
    hints = Options.__annotations__ if "Options" in str(options.annotation) else Look.__annotations__
    shared = [
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=hints[name].__forward_arg__
        )
        for name in OPTIONS
        if name in hints
    ]
    draw.__dict__["__signature__"] = own.replace(parameters=[*named, *shared])
    doc = inspect.cleandoc(draw.__doc__ or "")
    texts = [f"{name} : {text}\n" for name, text in _TEXTS.items() if f"\n{name} : " not in doc]
    above, returns, below = doc.partition("\nReturns\n-------\n")
    if "\nParameters\n" not in above:
        above += "\nParameters\n----------\n"
    draw.__doc__ = above + "".join(texts) + returns + below
    return draw


def _parameters(method: Any) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(method).parameters
