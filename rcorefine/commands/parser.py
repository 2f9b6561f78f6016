"""The words of the command line."""

from __future__ import annotations

import argparse
import math
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..data.measurement import HOLDS
from ..version import __version__

__all__ = ["build_parser"]

_EXIT_CODES = (
    "exit codes: 0 adequate, nothing found; 1 something found; 2 wrong usage, or a file that cannot be used "
    "(the message is on standard error); 3 a fault of the program"
)
_DEMO_CODES = "exit codes: 0 all went well, 1 the work failed (the message says why), 2 wrong usage"
_MODEL = (
    "model: .toml (matrices, or a builder's parameters; see rcorefine example), or .npz/.mat with A, B, C, D"
)
_DATA = "record: .csv, .tsv, .txt, .lvm, .log (with a header line), .mat, .npz, .h5 or .tdms"
_JSON = {
    "check": "Keys of --json: command, rcorefine, exit_code, answer (a sentence for each row that is not "
    "ok), record, rows (status, what, where, figure, sentence), detectable (effect, coefficient, "
    "smallest, unit).",
    "compare": "Keys of --json: command, rcorefine, exit_code, answer (3 sentences), record (name, "
    "samples, dt, hold, inputs, outputs, sha256_inputs, sha256_outputs), models (name; "
    "outputs: name, unit, fit, rmse, bias; failures: role, dimension, where, measure, "
    "statistic, p_value, share, sentence), report.",
    "diagnose": "Keys of --json: command, rcorefine, exit_code, answer (3 sentences), record, verdict, "
    "ranking (effect: kind and place; coefficients, std, fit_before, fit_after, p_value, "
    "probability), none_of_these, places, ambiguous, parameters (as in improve), tests and "
    "winner_tests (name, statistic, dof, p_value), detectable (effect, coefficient, smallest, unit), "
    "significance, notes, checks (status, what, where, figure, sentence), report.",
    "improve": "Keys of --json: command, rcorefine, exit_code, answer (3 sentences), record, verdict, "
    "message, checks (as in diagnose), steps (action, effect, coefficients, std, train_rmse, choice_rmse, "
    "validation_rmse, rivals), parameters (name, kind, place, role, initial, value, "
    "coefficient, std, unit), hold, system (A, B, C, D, inputs, outputs, states), report.",
}


def build_parser() -> argparse.ArgumentParser:
    """Parser of `rcorefine`.

    Returns
    -------
    ArgumentParser
        Subcommands demo, check, compare, diagnose, improve, example.
    """
    parser = argparse.ArgumentParser(
        prog="rcorefine",
        description="Find out why a linear model and a measured record disagree, and mend the model.",
        epilog=_EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _demo(commands)
    _check(commands)
    _compare(commands)
    _diagnose(commands)
    _improve(commands)
    _example(commands)
    return parser


def _demo(commands: Any) -> None:
    demo = commands.add_parser(
        "demo",
        help="run the loop on an example: compare, refine, compare again",
        description=(
            "Run the loop on a circuit whose model is wrong: compare the model with a noisy record, "
            "refine it sample by sample, and compare again on data that the refinement has not seen. "
            "Takes up to a minute."
        ),
        epilog=_DEMO_CODES,
    )
    demo.add_argument(
        "--output",
        type=Path,
        default=Path("rcorefine-demo"),
        metavar="FOLDER",
        help="folder for the pictures, made if it is absent (default: %(default)s)",
    )
    demo.add_argument(
        "--seed",
        type=_seed,
        default=1,
        metavar="N",
        help="seed of the excitation and the noise, 0 or larger (default: %(default)s)",
    )
    demo.add_argument("--quiet", action="store_true", help="no progress bar")


def _compare(commands: Any) -> None:
    parser = _reading(
        commands,
        "compare",
        "how well one or several models explain a record, and where they fail",
        "Free run of each model over the record, its initial state estimated: fit in percent, typical "
        "error, and where the best of the models fails.",
        several=True,
    )
    parser.add_argument(
        "--x0", choices=("estimate", "zero"), default="estimate", help="initial state (%(default)s)"
    )
    _horizon_option(parser)
    _output_options(parser)


def _check(commands: Any) -> None:
    parser = commands.add_parser(
        "check",
        help="what is odd about a record, before anything else",
        description=textwrap.fill(
            "Look over the record and the model beside it: units, sign and gain, delay, offset, drift, "
            "clipping, sampling, closed loop, and the smallest effects that the record could show.",
            79,
        ),
        epilog=_epilog("check"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help=_MODEL)
    parser.add_argument("data", type=Path, metavar="DATA", help=_DATA)
    _record_options(parser)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    parser.set_defaults(validation=None, split=None, report=None)


def _diagnose(commands: Any) -> None:
    parser = _reading(
        commands,
        "diagnose",
        "which physical effect is missing",
        "Rank the physical effects that the model may lack, and say how sure that is.",
    )
    _search_options(parser)
    _output_options(parser)


def _improve(commands: Any) -> None:
    parser = _reading(
        commands,
        "improve",
        "add one effect after the other and watch the error fall",
        "Diagnose, add the effect, fit all together, test again, until nothing earns its place; the "
        "error is judged on a part of the record that took part in nothing.",
    )
    _search_options(parser)
    parser.add_argument(
        "--max-effects", type=_count, default=4, metavar="N", help="effects at most (default: %(default)s)"
    )
    _output_options(parser)


def _reading(
    commands: Any, name: str, summary: str, description: str, several: bool = False
) -> argparse.ArgumentParser:
    """A command that reads one model or several, and a record."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=textwrap.fill(description, 79),
        epilog=_epilog(name),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if several:
        parser.add_argument("models", nargs="+", type=Path, metavar="MODEL", help=_MODEL)
    else:
        parser.add_argument("model", type=Path, metavar="MODEL", help=_MODEL)
    parser.add_argument("data", type=Path, metavar="DATA", help=_DATA)
    _record_options(parser)
    return parser


def _example(commands: Any) -> None:
    from .example import NAMES

    parser = commands.add_parser(
        "example",
        help="examples of the two files that the other commands read",
        description=(
            "Print an example of a model file and of a record; --write makes both files, whole. The record "
            "hides an effect that the model lacks, so compare and diagnose end with 1."
        ),
        epilog="exit codes: 0 printed or written; 2 wrong usage, or a file that cannot be written",
    )
    parser.add_argument(
        "name", nargs="?", choices=NAMES, default=NAMES[0], metavar="NAME",
        help=f"one of {', '.join(NAMES)} (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--write", type=Path, metavar="DIR", help="write NAME.toml and NAME.csv into this folder"
    )
    parser.add_argument(
        "--seed", type=_seed, default=1, metavar="N", help="seed of the record (default: %(default)s)"
    )
    parser.add_argument(
        "--exact", action="store_true", help="a record that hides nothing, so that the model is adequate"
    )


def _record_options(parser: argparse.ArgumentParser) -> None:
    """What the columns of the record are."""
    group = parser.add_argument_group("the record")
    group.add_argument(
        "--input",
        action=_Names,
        metavar="NAME",
        help="columns of the inputs: by the model's names, or by others in the model's order; repeat it, or "
        "separate names by commas (default: the model's names)",
    )
    group.add_argument("--output", action=_Names, metavar="NAME", help="columns of the outputs, likewise")
    group.add_argument(
        "--time", metavar="NAME", help="column of times in s (default: time, unless --dt is given)"
    )
    group.add_argument("--dt", type=_positive, metavar="SECONDS", help="sampling time, in place of --time")
    group.add_argument(
        "--hold",
        choices=HOLDS,
        default="zoh",
        help="how the input runs between samples (default: %(default)s)",
    )
    apart = group.add_mutually_exclusive_group()
    apart.add_argument("--validation", type=Path, metavar="DATA2", help="another record to judge by")
    apart.add_argument(
        "--split",
        type=_share,
        metavar="SHARE",
        help="fit this share of the record, judge by the rest (compare: only the rest is compared)",
    )


def _horizon_option(parser: Any) -> None:
    parser.add_argument(
        "--horizon",
        type=_positive,
        metavar="SECONDS",
        help="start anew every so many seconds (default: a tenth of the record where the model integrates)",
    )


def _search_options(parser: argparse.ArgumentParser) -> None:
    """What may be missing, and what of the model may move."""
    group = parser.add_argument_group("what may be missing")
    group.add_argument(
        "--candidates",
        "--effects",
        action=_Names,
        metavar="WORD",
        help="kinds (coulomb_friction), places (link2), or kind@place; default: all that are plausible",
    )
    group.add_argument(
        "--free", action=_Names, metavar="NAME", help="parameters that float: linear for all, or names"
    )
    group.add_argument(
        "--tolerance",
        type=_not_negative,
        default=0.0,
        metavar="SHARE",
        help="relative uncertainty of the linear parameters, e.g. 0.02 (default: exact)",
    )
    group.add_argument("--no-offset", dest="offset", action="store_false", help="no nuisance offset")
    group.add_argument(
        "--noise",
        type=_positive,
        action="append",
        metavar="SIZE",
        help="known standard deviation of the sensor noise, once or once per output",
    )
    _horizon_option(group)
    group.add_argument(
        "--significance",
        type=_share,
        default=0.01,
        metavar="LEVEL",
        help="rate of false alarms where nothing is missing (default: %(default)s)",
    )


def _output_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("what comes out")
    group.add_argument("--report", type=Path, metavar="FILE", help="write an HTML report")
    group.add_argument("--overwrite", action="store_true", help="replace FILE even where it is no report")
    group.add_argument("--json", action="store_true", help="print one JSON object in place of the tables")


def _epilog(command: str) -> str:
    """Keys of the JSON object and exit codes, a paragraph each."""
    return "\n\n".join(textwrap.fill(text, 79) for text in (_JSON[command], _EXIT_CODES))


class _Names(argparse.Action):
    """Names, repeated or separated by commas."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
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


def _count(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 0 or larger")
    return int(text)


def _seed(text: str) -> int:
    """Parse a seed; argparse turns the error into exit code 2."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is negative; give 0 or larger")
    return value
