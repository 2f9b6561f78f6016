"""Base classes of results, and numbers as text.

What shows a result is looked up, never imported: `views` is loaded on first use.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypedDict, TypeVar

import control as ct
import numpy as np

from .arguments import printable

if TYPE_CHECKING:
    from .data.measurement import Measurement


P = ParamSpec("P")
T = TypeVar("T")


def views() -> Any:
    """Return the package that shows results, which is loaded on first use."""
    return import_module(f"{__package__}.views")


def show(result: object, what: str, *args: Any, **options: Any) -> Any:
    """Draw the picture that a method of a result asks for.

    Parameters
    ----------
    result : object
        Result.
    what : str
        Name of the method.
    *args, **options
        Its arguments.

    Raises
    ------
    TypeError
        If an option does not exist.
    """
    known = inspect.signature(getattr(type(result), what)).parameters
    if unknown := [name for name in options if name not in known]:
        raise TypeError(f"{type(result).__name__}.{what}() got an unexpected keyword argument {unknown[0]!r}")
    return views().draw(result, what, *args, **options)


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
        return dict(views().as_dict(self))

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
        return views().as_frame(self)


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
        first, kind = str(self).strip().partition("\n")[0].rstrip(), type(self).__name__
        return f"<{first}>" if first.startswith(kind) else f"<{kind}: {first}>"

    def __str__(self) -> str:
        return "\n".join(map(printable, views().as_text(self).split("\n")))

    def _repr_html_(self) -> str:
        return str(views().as_html(self))

    def answer(self) -> tuple[list[str], bool]:
        """Return the answer in a few sentences, and whether all is well.

        Returns
        -------
        sentences : list of str
            The answer, its reason, and what to do; empty for a result that answers no question.
        fine : bool
            False where something was found, or an estimate did not converge: the exit code of the terminal.
        """
        sentences, fine = views().content(self).answer()
        return list(sentences), bool(fine)

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
        return Path(views().report(self, path, title=title, code=code, overwrite=overwrite))


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
            Record to show the models beside; default the first that was fitted.
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
        return Path(views().report(self, path, data=data, title=title, code=code, overwrite=overwrite))


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


OPTIONS = ("ax", "label", *Look.__annotations__)

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


_SURE = 0.995  # where two digits would make it a certainty
_MOST = 6  # significant digits of an estimate, however well it is known
_ULPS = 10  # units in the last place of a value, below which its standard deviation is that of arithmetic


def chance(p_value: float, symbol: str = "") -> str:
    """A p-value with two digits; what is smaller than any number is not zero.

    Parameters
    ----------
    p_value : float
        Probability.
    symbol : str
        What it is called in a sentence; none in a table.

    Returns
    -------
    str

    Examples
    --------
    >>> chance(0.01234), chance(0.0), chance(0.01234, "p"), chance(0.9998, "p")
    ('0.012', '< 1e-300', 'p = 0.012', 'p > 0.99')
    """
    if p_value <= 0:
        return f"{symbol} < 1e-300".strip()
    if p_value >= _SURE:
        return f"{symbol} > 0.99".strip()
    return f"{symbol} = {p_value:.2g}" if symbol else f"{p_value:.2g}"


def counted(number: int, what: str, several: str = "") -> str:
    """A number of things, in the singular where it is one.

    Parameters
    ----------
    number : int
        How many.
    what : str
        One of them.
    several : str
        More of them, where an s behind it will not do.

    Returns
    -------
    str

    Examples
    --------
    >>> counted(1, "step"), counted(3, "step"), counted(0, "frequency", "frequencies")
    ('1 step', '3 steps', '0 frequencies')
    """
    return f"{number} {what if number == 1 else several or what + 's'}"


def frequency_text(*omega: float) -> str:
    """Frequencies, given in rad/s, in the unit of python-control's plots.

    Parameters
    ----------
    *omega : float
        One, or several, which are listed.

    Returns
    -------
    str
        In Hz where ``control.config.defaults["freqplot.Hz"]`` says so, else in rad/s.

    Examples
    --------
    >>> frequency_text(6.2832)
    '6.283 rad/s'
    >>> import control as ct
    >>> ct.config.defaults["freqplot.Hz"] = True
    >>> frequency_text(6.2832, 12.566)
    '1, 2 Hz'
    >>> ct.config.defaults["freqplot.Hz"] = False
    """
    size, unit = (2 * np.pi, "Hz") if ct.config.defaults["freqplot.Hz"] else (1.0, "rad/s")
    return f"{', '.join(f'{one / size:.4g}' for one in omega)} {unit}"


def phase_text(angle: float) -> str:
    """A phase, given in rad, in whole degrees and without a sign.

    Parameters
    ----------
    angle : float
        Of the response over what it is compared with.

    Returns
    -------
    str

    Examples
    --------
    >>> phase_text(-2.1), phase_text(0.35)
    ('120 deg behind', '20 deg ahead of')
    """
    return f"{abs(math.degrees(angle)):.0f} deg {'behind' if angle < 0 else 'ahead of'}"


def estimate(value: float, std: float) -> tuple[str, str]:
    """Return a value and its standard deviation as rounded text.

    The standard deviation has two digits; the value is rounded to match it.

    Parameters
    ----------
    value, std : float
        What was estimated, and how well; four digits where that is not known. A standard deviation below
        the rounding of the value is "exact".

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> estimate(0.00028725, 0.00048), estimate(29.9942, 1.0), estimate(203517.0, 1234.0)
    (('0.00029', '0.00048'), ('30.0', '1.0'), ('203500', '1200'))
    >>> estimate(-43.2123, float("inf")), estimate(10.0, 7.1e-18)
    (('-43.21', 'inf'), ('10.0000', 'exact'))
    """
    if not (math.isfinite(value) and math.isfinite(std) and std > 0):
        return f"{value:.4g}", f"{std:.2g}"
    last = _place(float(f"{std:.1e}")) - 1  # decimal place of its second digit
    if value:
        last = max(last, _place(value) + 1 - _MOST)
    if std < _ULPS * math.ulp(value):
        return _to(value, last), "exact"
    return _to(value, last), _to(float(f"{std:.1e}"), _place(std) - 1)


def with_error(value: float, std: float, unit: str = "") -> str:
    """An estimate with its standard deviation, as a sentence has it.

    Parameters
    ----------
    value, std : float
        As for `estimate`.
    unit : str
        Behind them.

    Returns
    -------
    str

    Examples
    --------
    >>> with_error(0.24961, 0.0003, "N")
    '0.24961 +/- 0.00030 N'
    >>> with_error(10.0, 7.1e-18, "N")
    '10.0000 (exact to rounding) N'
    """
    return f"{' +/- '.join(estimate(value, std)).replace('+/- exact', '(exact to rounding)')} {unit}".rstrip()


def _to(value: float, last: int) -> str:
    """Return a value rounded to the power of ten `last`, as text.

    Only very small and very large values have an exponent.
    """
    rounded = float(f"{value:.{max(_place(value) - last, 0)}e}") if value and _place(value) >= last else 0.0
    if not rounded:
        return f"{0.0:.{min(max(-last, 0), _MOST)}f}"
    if 1e-4 <= abs(rounded) < 1e7:
        return f"{rounded:.{max(-last, 0)}f}"
    return f"{rounded:.{_place(rounded) - last}e}"


def _place(value: float) -> int:
    return math.floor(math.log10(abs(value)))
