"""Options that several commands share, and parsers of their values."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..data import HOLDS

#: Examples of `rcorefine example`, the default first.
EXAMPLES = (
    "mass_spring_damper", "state_space", "mechanical", "series_rlc", "dc_motor", "two_tanks",
    "thermal_network", "quarter_car",
)  # fmt: skip

__all__ = [
    "EXAMPLES",
    "Names",
    "columns_options",
    "count",
    "fit_options",
    "free_option",
    "horizon_option",
    "json_option",
    "output_options",
    "picture_option",
    "record_options",
    "search_options",
    "seed_option",
]


def record_options(parser: argparse.ArgumentParser) -> None:
    """Add the options for the columns of the record and held-out data."""
    apart = columns_options(parser).add_mutually_exclusive_group()
    apart.add_argument("--validation", type=Path, metavar="DATA2", help="another record for validation")
    apart.add_argument(
        "--split",
        type=_share,
        metavar="SHARE",
        help="fit this share of the record and validate on the rest (compare: only the rest is compared)",
    )


def columns_options(parser: argparse.ArgumentParser) -> Any:
    """Add the options for the columns of a record."""
    group = parser.add_argument_group("the record")
    group.add_argument(
        "--input",
        action=Names,
        metavar="NAME",
        help="columns of the inputs: the model's names, or other names in the model's order; repeat the "
        "option, or separate names by commas (default: the model's names)",
    )
    group.add_argument("--output", action=Names, metavar="NAME", help="columns of the outputs, likewise")
    group.add_argument(
        "--time", metavar="NAME", help="column of times in s (default: time, unless --dt is given)"
    )
    group.add_argument(
        "--dt", type=_positive, metavar="SECONDS", help="sampling time in s, in place of --time"
    )
    group.add_argument(
        "--decimal",
        choices=(".", ","),
        help="decimal mark of a text file (default: what its columns show)",
    )
    group.add_argument(
        "--hold",
        choices=HOLDS,
        default="zoh",
        help="course of the input between samples: constant, straight lines, or smooth (default: "
        "%(default)s)",
    )
    return group


def horizon_option(parser: Any) -> None:
    """Add the option for the length of the free runs."""
    parser.add_argument(
        "--horizon",
        type=_positive,
        metavar="SECONDS",
        help="restart the simulation every so many seconds (default: a tenth of the record if the model "
        "integrates)",
    )


def search_options(parser: argparse.ArgumentParser, *, places: bool = False) -> None:
    """Add the options for candidate effects and free parameters."""
    group = parser.add_argument_group("candidate effects")
    words = "names of links" if places else "kinds (coulomb_friction), places (link2), or kind@place"
    group.add_argument(
        "--candidates",
        "--effects",
        action=Names,
        metavar="WORD",
        help=f"{words}; default: all that are plausible",
    )
    if not places:
        free_option(group)
    fit_options(group)
    group.add_argument(
        "--significance",
        type=_share,
        default=0.01,
        metavar="LEVEL",
        help="rate of false alarms if nothing is missing (default: %(default)s)",
    )


def free_option(group: Any) -> None:
    """Add the option that names the parameters to re-estimate."""
    group.add_argument(
        "--free",
        action=Names,
        metavar="NAME",
        help="parameters to re-estimate together with the effect: linear for all of them, or their names",
    )


def fit_options(group: Any) -> None:
    """Add the options for the fit of a model to a record."""
    group.add_argument(
        "--tolerance",
        type=_not_negative,
        default=0.0,
        metavar="SHARE",
        help="relative uncertainty of the parameters, such as 0.02 (default: they are exact)",
    )
    group.add_argument(
        "--no-offset",
        dest="offset",
        action="store_false",
        help="do not estimate constant sensor offsets",
    )
    group.add_argument(
        "--noise",
        type=_positive,
        action="append",
        metavar="SIZE",
        help="known standard deviation of the sensor noise, once or once per output",
    )
    horizon_option(group)


def output_options(parser: argparse.ArgumentParser, *, report: bool = True) -> Any:
    """Report, picture and JSON."""
    group = parser.add_argument_group("output")
    picture_option(group)
    json_option(group)
    if report:
        group.add_argument("--report", type=Path, metavar="FILE", help="write an HTML report")
        group.add_argument("--overwrite", action="store_true", help="replace FILE even if it is not a report")
    return group


def picture_option(parser: Any) -> None:
    """Add the option for the file of the picture."""
    parser.add_argument(
        "--picture", type=_picture, metavar="FILE", help="draw the result (.png, .svg or .pdf)"
    )


def json_option(parser: Any) -> None:
    """Add the option to print the result as JSON."""
    parser.add_argument("--json", action="store_true", help="print one JSON object in place of the tables")


def seed_option(parser: Any, of: str) -> None:
    """Seed of what is drawn."""
    parser.add_argument(
        "--seed", type=_seed, default=1, metavar="N", help=f"seed of {of} (default: %(default)s)"
    )


class Names(argparse.Action):
    """Names, repeated or separated by commas."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        """Add the names to those before."""
        names = [name.strip() for name in str(values).split(",")]
        if not all(names):
            parser.error(f"argument {option_string}: an empty name in {values!r}")
        setattr(namespace, self.dest, [*(getattr(namespace, self.dest) or []), *names])


def _number(check: Callable[[float], bool], what: str) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and check(value)):
            raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
        return value

    return parse


_positive = _number(lambda value: value > 0, "a positive number")
_not_negative = _number(lambda value: value >= 0, "a number that is 0 or larger")
_share = _number(lambda value: 0 < value < 1, "a number between 0 and 1")


def _picture(text: str) -> Path:
    if Path(text).suffix.lower() not in (".png", ".svg", ".pdf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not named .png, .svg or .pdf")
    return Path(text)


def count(text: str) -> int:
    """Parse a whole number."""
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 0 or larger")
    return int(text)


def _seed(text: str) -> int:
    """Parse a seed; argparse turns the error into exit code 2."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is negative; give 0 or larger")
    return value
