"""The words of the command line."""

from __future__ import annotations

import argparse
import textwrap
from pathlib import Path
from typing import Any

from ..version import __version__
from .options import (
    EXAMPLES,
    Names,
    columns_options,
    count,
    fit_options,
    free_option,
    horizon_option,
    json_option,
    output_options,
    picture_option,
    record_options,
    search_options,
    seed_option,
)

__all__ = ["build_parser"]

_EXIT_CODES = (
    "exit codes: 0 adequate, nothing found; 1 something found; 2 wrong usage, or a file that cannot be used "
    "(the message is on standard error); 3 an internal error"
)
_DEMO_CODES = "exit codes: 0 all went well, 1 the work failed (the message says why), 2 wrong usage"
_MODEL = (
    "model: .toml (matrices, or a builder's parameters; see rcorefine example), or .npz/.mat with A, B, C, D"
)
_DATA = "record: .csv, .tsv, .txt, .lvm, .log (with a header), .mat, .npz, .h5, .tdms, .bag, .mcap or .db3"
_KEYS = "Keys of --json: command, rcorefine, exit_code, answer"
_JSON = {
    "check": " (a sentence for each row that is not ok), record, rows (status, what, where, figure, "
    "sentence), detectable (effect, coefficient, smallest, unit).",
    "compare": " (3 sentences), record (name, samples, dt, hold, inputs, outputs, sha256_inputs, "
    "sha256_outputs), models (name; outputs: name, unit, fit, rmse, bias; failures: role, dimension, "
    "where, measure, statistic, p_value, share, sentence), report.",
    "diagnose": " (3 sentences), record, verdict, "
    "ranking (effect: kind and place; coefficients, std, fit_before, fit_after, p_value, "
    "probability), none_of_these, places, ambiguous, parameters (as in improve), tests and "
    "winner_tests (name, statistic, dof, p_value), detectable (effect, coefficient, smallest, unit), "
    "significance, notes, checks (status, what, where, figure, sentence), next_step, report.",
    "improve": " (3 sentences), record, verdict, "
    "message, checks (as in diagnose), next_step, steps (action, effect, coefficients, std, "
    "train_rmse, choice_rmse, validation_rmse, rivals), parameters (name, kind, place, role, initial, value, "
    "coefficient, std, unit), hold, system (A, B, C, D, inputs, outputs, states), report.",
    "refine": " (3 sentences), record, parameters "
    "(as in improve), hold, system, fit, rmse, initial_fit, success, message, warnings, report. The exit "
    "code is 0 where it converged.",
    "localize": " (what has changed), record, name, "
    "rows (name, kind, place, nominal, unit, change, std, percent, percent_std, p_value, limit, "
    "limit_percent, named, ...), and the other fields of the result. The exit code is 1 where a place "
    "has changed.",
    "bode": ", record (where there is one), curves "
    "(curve, output, input, omega, magnitude, phase_deg), report.",
    "survey": " (sentences), task, mode, significance, "
    "summary, rows (machine, record, number, start, verdict, effect, place, coefficient, std, unit, "
    "probability, seconds, error, estimates, sentences), effects (kind, place, name, unit, sort, "
    "n_machines, mean, std, spread, p_value, p_alike, machines), trends, breaches (condition, machine, "
    "sentence), report. With --conditions the exit code is 1 where one is not kept, and 0 otherwise.",
}


_FILES = "mass_spring_damper.toml mass_spring_damper.csv"
_SHOWN = {
    "check": _FILES,
    "compare": f"{_FILES} --report report.html",
    "diagnose": f"{_FILES} --picture found.png",
    "improve": f"{_FILES} --report better.html",
    "refine": f"{_FILES} --effects coulomb_friction@link2",
    "localize": _FILES,
    "bode": f"{_FILES} --picture bode.png --csv points.csv",
    "survey": ". --model mass_spring_damper.toml",
}


def build_parser() -> argparse.ArgumentParser:
    """Parser of `rcorefine`.

    Returns
    -------
    ArgumentParser
        Subcommands demo, check, compare, diagnose, improve, refine, localize, bode, survey, explore, example.
    """
    parser = argparse.ArgumentParser(
        prog="rcorefine",
        description="Find out why a linear model and a measured record disagree, and correct the model.",
        epilog=_EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _demo(commands)
    _check(commands)
    _compare(commands)
    _diagnose(commands)
    _improve(commands)
    _refine(commands)
    _localize(commands)
    _bode(commands)
    _survey(commands)
    _explore(commands)
    _example(commands)
    return parser


def _demo(commands: Any) -> None:
    demo = commands.add_parser(
        "demo",
        help="run the workflow on an example: compare, diagnose, refine, improve",
        description=(
            "Run the workflow on a structure whose model lacks friction: compare the model with a noisy "
            "record, diagnose, refine, and compare again on held-out data. Then do the same with two "
            "effects, step by step. Takes up to a minute."
        ),
        epilog=_DEMO_CODES,
    )
    demo.add_argument(
        "--output",
        type=Path,
        default=Path("rcorefine-demo"),
        metavar="FOLDER",
        help="folder for the pictures, created if absent (default: %(default)s)",
    )
    seed_option(demo, "the excitation and the noise, 0 or larger")
    demo.add_argument("--quiet", action="store_true", help="no progress bar")


def _compare(commands: Any) -> None:
    parser = _reading(
        commands,
        "compare",
        "how well one or several models explain a record, and where they fail",
        "Simulate each model over the record from its estimated initial state (free run). Print the fit in "
        "percent, the typical error, and where the best model fails.",
        several=True,
    )
    parser.add_argument(
        "--x0", choices=("estimate", "zero"), default="estimate", help="initial state (%(default)s)"
    )
    horizon_option(parser)
    output_options(parser)


def _check(commands: Any) -> None:
    parser = _reading(
        commands,
        "check",
        "inspect data and model before anything else",
        "Check the record and the model: units, sign and gain, delay, offset, drift, clipping, sampling "
        "and closed loop. Print the smallest effects that the record could show. The picture shows the "
        "signals of the record.",
    )
    output_options(parser, report=False)


def _diagnose(commands: Any) -> None:
    parser = _reading(
        commands,
        "diagnose",
        "which physical effect is missing",
        "Rank the physical effects that may be missing in the model, with their probabilities.",
    )
    search_options(parser)
    output_options(parser)


def _improve(commands: Any) -> None:
    parser = _reading(
        commands,
        "improve",
        "add one effect after the other until no further one is significant",
        "Diagnose, add the effect, fit all parameters together and test again, until no further effect is "
        "significant. The error is computed on held-out data.",
    )
    search_options(parser)
    parser.add_argument(
        "--max-effects",
        type=count,
        default=4,
        metavar="N",
        help="maximum number of effects (default: %(default)s)",
    )
    output_options(parser)


def _refine(commands: Any) -> None:
    parser = _reading(
        commands,
        "refine",
        "add the effects that you name, and estimate them together with free parameters",
        "Estimate the effects of --effects and the parameters of --free together from the record, with "
        "their standard deviations. Validated by --validation or --split if given.",
    )
    group = parser.add_argument_group("what is estimated")
    group.add_argument(
        "--effects", "--candidates", dest="candidates", action=Names, metavar="KIND@PLACE",
        help="effects to add, such as coulomb_friction@link2",
    )  # fmt: skip
    free_option(group)
    fit_options(group)
    output_options(parser)


def _localize(commands: Any) -> None:
    parser = _reading(
        commands,
        "localize",
        "which link of a structure has lost or gained stiffness or damping",
        "Estimate the change of every link, and name those with a significant change.",
    )
    search_options(parser, places=True)
    output_options(parser, report=False)


def _bode(commands: Any) -> None:
    parser = _command(
        commands,
        "bode",
        "frequency responses of models, compared with that of a record",
        "Draw one model or several as a Bode diagram with --picture, and write the points with --csv "
        "(curve, output, input, omega [rad/s], magnitude, phase [deg]). The last file may be a record; the "
        "models are then sampled like the record, with its hold.",
    )
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="MODEL", help=f"{_MODEL}; a record may be the last"
    )
    columns_options(parser)
    group = output_options(parser, report=False)
    group.add_argument(
        "--csv",
        type=Path,
        metavar="FILE",
        help="write the points (semicolons separate them with --decimal ,)",
    )


def _survey(commands: Any) -> None:
    parser = _command(
        commands,
        "survey",
        "many records of many machines: one row each, and what they have in common",
        "Examine every record of a folder, on one or several processes or on a cluster. Compare the "
        "machines: which effects are common, which belong to one machine, which grow with time. A record "
        "that fails does not stop the survey.",
    )
    parser.add_argument(
        "folder",
        type=Path,
        metavar="FOLDER",
        help="each file in it is the record of a machine of that name, each folder a machine with its "
        "records in order of their names",
    )
    parser.add_argument(
        "--model",
        type=Path,
        required=True,
        metavar="MODEL",
        help=f"{_MODEL}; or a folder with one per machine",
    )
    parser.add_argument(
        "--task",
        choices=("diagnose", "improve", "localize", "refine"),
        default="diagnose",
        help="task for each record; refine needs --candidates (default: %(default)s)",
    )
    parser.add_argument(
        "--compare",
        choices=("common", "own"),
        default="common",
        help="common: each effect that is found in any record is estimated in all (default: %(default)s)",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--scheduler", metavar="ADDRESS", help="dask scheduler, such as tcp://10.0.0.1:8786")
    where.add_argument(
        "--jobs", type=count, default=1, metavar="N", help="processes on this machine (default: %(default)s)"
    )
    parser.add_argument(
        "--conditions",
        type=Path,
        metavar="FILE",
        help="TOML: conditions to keep; the exit code is 1 if one is not kept",
    )
    columns_options(parser)
    search_options(parser)
    group = parser.add_argument_group("output")
    group.add_argument("--report", type=Path, metavar="DIR", help="write an index page and one per machine")
    group.add_argument("--overwrite", action="store_true", help="replace files in DIR that are not reports")
    picture_option(group)
    json_option(group)


def _command(commands: Any, name: str, summary: str, description: str) -> argparse.ArgumentParser:
    """A command whose answer may be JSON; what it does not offer is None."""
    parser: argparse.ArgumentParser = commands.add_parser(
        name,
        help=summary,
        description=textwrap.fill(description, 79),
        epilog="\n\n".join(textwrap.fill(text, 79) for text in (_KEYS + _JSON[name], _EXIT_CODES))
        + f"\n\nexample, with the files of rcorefine example --write .:\n  rcorefine {name} {_SHOWN[name]}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(free=None, picture=None, csv=None, report=None)
    return parser


def _explore(commands: Any) -> None:
    parser = commands.add_parser(
        "explore",
        help="try effects by hand on an interactive page that shows the error",
        description=textwrap.fill(
            "Serve an interactive page of a model and a record at 127.0.0.1, to this machine alone, until "
            "Ctrl-C. Needs the extra explore.",
            79,
        ),
        epilog="exit codes: 0 ended by Ctrl-C; 2 wrong usage, or a file or port that cannot be used",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("model", type=Path, metavar="MODEL", help=_MODEL)
    parser.add_argument("data", type=Path, metavar="DATA", help=_DATA)
    columns_options(parser)
    horizon_option(parser)
    parser.add_argument(
        "--port", type=count, default=0, metavar="N", help="port of the page (default: any that is free)"
    )
    parser.add_argument("--no-browser", dest="browser", action="store_false", help="do not open the browser")


def _reading(
    commands: Any, name: str, summary: str, description: str, several: bool = False
) -> argparse.ArgumentParser:
    """A command that reads one model or several, and a record."""
    parser = _command(commands, name, summary, description)
    if several:
        parser.add_argument("models", nargs="+", type=Path, metavar="MODEL", help=_MODEL)
    else:
        parser.add_argument("model", type=Path, metavar="MODEL", help=_MODEL)
    parser.add_argument("data", type=Path, metavar="DATA", help=_DATA)
    record_options(parser)
    return parser


def _example(commands: Any) -> None:
    parser = commands.add_parser(
        "example",
        help="examples of the two files that the other commands read",
        description=(
            "Print an example of a model file and of a record; --write writes both complete files. The "
            "record contains an effect that is missing in the model, so compare and diagnose end with exit "
            "code 1."
        ),
        epilog="exit codes: 0 printed or written; 2 wrong usage, or a file that cannot be written",
    )
    parser.add_argument(
        "name", nargs="?", choices=EXAMPLES, default=EXAMPLES[0], metavar="NAME",
        help=f"one of {', '.join(EXAMPLES)} (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--write", type=Path, metavar="DIR", help="write NAME.toml and NAME.csv into this folder"
    )
    seed_option(parser, "the record")
    parser.add_argument(
        "--exact",
        action="store_true",
        help="a record without a missing effect, so that the model is adequate",
    )
