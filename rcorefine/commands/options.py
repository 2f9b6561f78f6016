"""Options of the terminal, from the signatures and texts of functions.

A positional-only parameter is an argument, every other one an option. The annotation gives its type, the
docstring its choices and its help.
"""

from __future__ import annotations

import argparse
import inspect
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rcorefine as rco

#: Options whose name is not that of the parameter: one name of several, and the other word for effects.
_FLAGS = {
    "inputs": ("--input",),
    "outputs": ("--output",),
    "candidates": ("--candidates", "--effects"),
    "effects": ("--effects", "--candidates"),
}


class Names(argparse.Action):
    """Names, repeated or separated by commas."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Add the names to those before."""
        names = [name.strip() for name in str(values).split(",")]
        if not all(names):
            parser.error(f"argument {option_string}: an empty name in {values!r}")
        setattr(namespace, self.dest, [*(getattr(namespace, self.dest) or []), *names])


def _number(zero: bool) -> Callable[[str], float]:
    """Return the reader of a positive number, or of one that may be zero."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or value < 0 or (value == 0 and not zero):
            rule = "a number that is 0 or larger" if zero else "a positive number"
            raise argparse.ArgumentTypeError(f"{text!r} is not {rule}")
        return value

    return parse


def _count(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 0 or larger")
    return int(text)


_LIST = {"action": Names, "metavar": "NAME"}
#: How the terminal takes each type; a parameter of another type has no option.
_TYPES: dict[str, dict[str, Any]] = {
    "str": {"metavar": "NAME"},
    "int": {"type": _count, "metavar": "N"},
    "float": {"metavar": "NUMBER"},
    "float | Sequence[float]": {"action": "append", "metavar": "NUMBER"},
    "Path": {"type": Path, "metavar": "PATH"},
    "Sequence[Path]": {"type": Path, "nargs": "+"},
    **dict.fromkeys(
        ("Sequence[str]", "Sequence[Effect]", "str | Sequence[str]", "str | Sequence[Any]"), _LIST
    ),
}


def parameters_of(function: Any) -> dict[str, tuple[str, str]]:
    """Return the type and the description of each parameter in a docstring.

    "As in `refine`" is replaced by what the docstring of that function says.

    Examples
    --------
    >>> parameters_of(rco.explore)["horizon"]
    ('float, optional', 'Length in s of the free runs, as in refine.')
    """
    section = re.search(r"Parameters\n-+\n(.*?)(\n\n\w[\w ]*\n---|\Z)", inspect.getdoc(function) or "", re.S)
    found = {}
    for names, kind, text in re.findall(
        r"^(\w[\w, ]*?)(?: : (.*))?\n((?:    .*\n?)+)", section[1] if section else "", re.M
    ):
        for name in names.split(", "):
            found[name] = kind, " ".join(text.replace("`", "").split())
            other = re.match(r"As (?:in )?`(\w+)`", text.lstrip())
            if other:
                beside = vars(inspect.getmodule(function))
                theirs = parameters_of(beside.get(other[1]) or getattr(rco, other[1]))
                found[name] = theirs.get(name) or theirs[name.removesuffix("s")]  # one, or several
    return found


def add_options(parser: argparse.ArgumentParser, function: Any, title: str, without: str = "") -> None:
    """Add the parameters of a function to a parser, but those that it has.

    Parameters
    ----------
    parser : ArgumentParser
        Parser of a command.
    function : callable
        Function with a numpydoc docstring.
    title : str
        Title of its options in the help; "" for none.
    without : str
        Names of parameters that are no options.
    """
    group = parser.add_argument_group(title) if title else parser
    there = {action.dest for action in parser._actions} | set(without.split())
    described = parameters_of(function)
    for name, parameter in inspect.signature(function).parameters.items():
        settings = _settings(parameter, *described.get(name, ("", "")))
        required = parameter.default is parameter.empty
        if (
            settings is None
            or name in there
            or (required and parameter.kind is parameter.POSITIONAL_OR_KEYWORD)
        ):
            continue
        if parameter.kind is parameter.POSITIONAL_ONLY:
            parser.add_argument(name, **settings | {"metavar": name.upper()})
        else:
            no = "no-" if settings.get("action") == "store_false" else ""
            flags = _FLAGS.get(name, (f"--{no}{name.replace('_', '-')}",))
            group.add_argument(*flags, dest=name, required=required, **settings)


def _settings(parameter: inspect.Parameter, kind: str, text: str) -> dict[str, Any] | None:
    """Return what argparse needs for a parameter; None if it is no option."""
    annotation = str(parameter.annotation).removesuffix(" | None")
    default = None if parameter.default is parameter.empty else parameter.default
    text = re.split(r"\.(?:\s|$)", text, maxsplit=1)[0].removeprefix("Whether to ").replace("%", "%%")
    if annotation == "bool":
        if default:
            return {"action": "store_false", "help": f"switch off: {text}"}
        return {"action": "store_true", "help": text} if default is False else None
    shown = default not in (None, (), "")
    settings: dict[str, Any] = {"default": default, "help": text + f" (default: {default})" * shown}
    if kind.startswith("{"):
        return settings | {"choices": re.findall(r'"([^"]+)"', kind.partition("}")[0])}
    if annotation not in _TYPES:
        return None
    if _TYPES[annotation] is _LIST:
        words = "kinds (coulomb_friction), places (link2) or kind@place, " if "Effect" in annotation else ""
        settings["help"] += f" ({words}repeated or separated by commas)"
    if "float" in annotation:
        settings["type"] = _number(zero=default == 0)
    if parameter.kind is parameter.POSITIONAL_ONLY and shown:
        settings["nargs"] = "?"
    return settings | _TYPES[annotation]
