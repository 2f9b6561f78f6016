"""The command `rcorefine`: its options, and its entry."""

from __future__ import annotations

import argparse
import math
import os
import sys
import textwrap
import traceback
import warnings
from argparse import Namespace
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from ..data import HOLDS
from ..version import __version__
from . import EXAMPLES

# Nothing is imported before main, where Ctrl-C is understood: python-control takes a second.
_FAULT, _INTERRUPTED = 3, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the name of the program; default those of the
        process.

    Returns
    -------
    int
        0 where nothing was found, 1 where something was (for ``demo``: where
        the work failed), 2 where a file or the record cannot be used; the
        message is on standard error. Wrong usage ends the process with 2; 3 is a
        fault of the program itself, with its traceback on standard error; 130 is Ctrl-C.

    Examples
    --------
    >>> from rcorefine.commands.cli import main
    >>> main(["--version"])
    Traceback (most recent call last):
    SystemExit: 0
    """
    words = list(sys.argv[1:] if argv is None else argv)
    said, failed = "rcorefine", 2
    try:
        arguments = build_parser().parse_args(words)
        arguments.words = words
        said = f"rcorefine {arguments.command}"
        failed = 1 if arguments.command == "demo" else 2
        with warnings.catch_warnings():
            if argv is None:  # in a process of its own: a warning is a line, not a place in the source
                warnings.showwarning = _say_warning
            return _run(arguments)
    except BrokenPipeError:
        # the reader left (rcorefine demo | head); keep the interpreter from complaining once more on exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return failed
    except KeyboardInterrupt:
        sys.stderr.write(f"{said}: interrupted\n")
        return _INTERRUPTED
    except Exception as error:
        import control as ct

        from ..exceptions import RCOError

        if isinstance(error, RCOError | OSError | ct.ControlDimension | ct.ControlArgument):
            sys.stderr.write(f"{said}: {_message(error)}\n")
            return failed
        # a fault of the program must not pass for an answer: Python would end with 1
        traceback.print_exc()
        return _FAULT


def _run(arguments: Namespace) -> int:
    """Run a command.

    Its module is imported late, so that --help and wrong usage answer at once.
    """
    homes = {"demo": "demo", "example": "example"}
    homes |= dict.fromkeys(("check", "compare", "diagnose", "improve", "survey"), "analysis")
    home = import_module(f".{homes.get(arguments.command, 'questions')}", __package__)
    return int(getattr(home, f"run_{arguments.command}")(arguments))


def _message(error: Exception) -> str:
    """Return the error message on one line.

    The error number of the operating system is left out.
    """
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split())


def _say_warning(message: Any, *_: Any, **__: Any) -> None:
    sys.stderr.write(f"rcorefine: warning: {' '.join(str(message).split())}\n")


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


def _count(text: str) -> int:
    if not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 0 or larger")
    return int(text)


_EXIT_CODES = (
    "exit codes: 0 adequate, nothing found; 1 something found; 2 wrong usage, or a file that cannot be used "
    "(the message is on standard error); 3 an internal error"
)
_MODEL = (
    "model: .toml (matrices, or a builder's parameters; see rcorefine example), or .npz/.mat with A, B, C, D"
)
_DATA = "record: .csv, .tsv, .txt, .lvm, .log (with a header), .mat, .npz or .h5"

_FILE = {"type": Path, "metavar": "FILE"}
_NAMES = {"action": Names, "metavar": "NAME"}
_FLAG = {"action": "store_true"}
_NUMBER = {"type": _count, "metavar": "N"}
_EFFECTS = "kinds (coulomb_friction), places (link2), or kind@place"

#: Options and files by name; behind a stroke the command where they mean something else.
_OPTIONS: dict[str, dict[str, Any]] = {
    "model": {"type": Path, "metavar": "MODEL", "help": _MODEL},
    "models": {"type": Path, "metavar": "MODEL", "nargs": "+", "help": _MODEL},
    "files": {"type": Path, "metavar": "MODEL", "nargs": "+", "help": f"{_MODEL}; a record may be the last"},
    "data": {"type": Path, "metavar": "DATA", "help": _DATA},
    "folder": {
        "type": Path,
        "metavar": "FOLDER",
        "help": "each file in it is the record of a machine of that name, each folder a machine with its "
        "records in order of their names",
    },
    "name": {
        "nargs": "?",
        "choices": EXAMPLES,
        "default": EXAMPLES[0],
        "metavar": "NAME",
        "help": f"one of {', '.join(EXAMPLES)} (default: %(default)s)",
    },
    "--input": {
        **_NAMES,
        "help": "columns of the inputs: the model's names, or other names in the model's order; repeat the "
        "option, or separate names by commas (default: the model's names)",
    },
    "--output": {**_NAMES, "help": "columns of the outputs, likewise"},
    "--time": {"metavar": "NAME", "help": "column of times in s (default: time, unless --dt is given)"},
    "--dt": {"type": _positive, "metavar": "SECONDS", "help": "sampling time in s, in place of --time"},
    "--decimal": {
        "choices": (".", ","),
        "help": "decimal mark of a text file (default: what its columns show)",
    },
    "--hold": {
        "choices": HOLDS,
        "default": "zoh",
        "help": "course of the input between samples: constant, straight lines, or smooth (default: "
        "%(default)s)",
    },
    "--validation": {"type": Path, "metavar": "DATA2", "help": "another record for validation"},
    "--split": {
        "type": _share,
        "metavar": "SHARE",
        "help": "fit this share of the record and validate on the rest (compare: only the rest is compared)",
    },
    "--x0": {"choices": ("estimate", "zero"), "default": "estimate", "help": "initial state (%(default)s)"},
    "--horizon": {
        "type": _positive,
        "metavar": "SECONDS",
        "help": "restart the simulation every so many seconds (default: a tenth of the record if the model "
        "integrates)",
    },
    "--candidates": {
        **_NAMES,
        "also": "--effects",
        "metavar": "WORD",
        "help": f"{_EFFECTS}; default: all that are plausible",
    },
    "--candidates/localize": {
        **_NAMES,
        "also": "--effects",
        "metavar": "WORD",
        "help": "names of links; default: all that are plausible",
    },
    "--effects/refine": {
        **_NAMES,
        "also": "--candidates",
        "dest": "candidates",
        "metavar": "KIND@PLACE",
        "help": "effects to add, such as coulomb_friction@link2",
    },
    "--free": {
        **_NAMES,
        "help": "parameters to re-estimate together with the effect: linear for all of them, or their names",
    },
    "--tolerance": {
        "type": _not_negative,
        "default": 0.0,
        "metavar": "SHARE",
        "help": "relative uncertainty of the parameters, such as 0.02 (default: they are exact)",
    },
    "--no-offset": {
        "dest": "offset",
        "action": "store_false",
        "help": "do not estimate constant sensor offsets",
    },
    "--noise": {
        "type": _positive,
        "action": "append",
        "metavar": "SIZE",
        "help": "known standard deviation of the sensor noise, once or once per output",
    },
    "--significance": {
        "type": _share,
        "default": 0.01,
        "metavar": "LEVEL",
        "help": "rate of false alarms if nothing is missing (default: %(default)s)",
    },
    "--matters": {
        "type": _share,
        "metavar": "SHARE",
        "help": "share of the spread of an output below which an error of the model does not matter "
        "(default: 0.01)",
    },
    "--max-effects": {**_NUMBER, "default": 4, "help": "maximum number of effects (default: %(default)s)"},
    "--model/survey": {
        "type": Path,
        "required": True,
        "metavar": "MODEL",
        "help": f"{_MODEL}; or a folder with one per machine",
    },
    "--task": {
        "choices": ("diagnose", "improve", "localize", "refine"),
        "default": "diagnose",
        "help": "task for each record; refine needs --candidates (default: %(default)s)",
    },
    "--compare": {
        "choices": ("common", "own"),
        "default": "common",
        "help": "common: each effect that is found in any record is estimated in all (default: %(default)s)",
    },
    "--scheduler": {"metavar": "ADDRESS", "help": "dask scheduler, such as tcp://10.0.0.1:8786"},
    "--jobs": {**_NUMBER, "default": 1, "help": "processes on this machine (default: %(default)s)"},
    "--conditions": {**_FILE, "help": "TOML: conditions to keep; the exit code is 1 if one is not kept"},
    "--picture": {"type": _picture, "metavar": "FILE", "help": "draw the result (.png, .svg or .pdf)"},
    "--json": {**_FLAG, "help": "print one JSON object in place of the tables"},
    "--report": {**_FILE, "help": "write an HTML report"},
    "--report/survey": {"type": Path, "metavar": "DIR", "help": "write an index page and one per machine"},
    "--overwrite": {**_FLAG, "help": "replace FILE even if it is not a report"},
    "--overwrite/survey": {**_FLAG, "help": "replace files in DIR that are not reports"},
    "--csv": {**_FILE, "help": "write the points (semicolons separate them with --decimal ,)"},
    "--port": {**_NUMBER, "default": 0, "help": "port of the page (default: any that is free)"},
    "--no-browser": {"dest": "browser", "action": "store_false", "help": "do not open the browser"},
    "--output/demo": {
        "type": Path,
        "default": Path("rcorefine-demo"),
        "metavar": "FOLDER",
        "help": "folder for the pictures, created if absent (default: %(default)s)",
    },
    "--seed/demo": {
        **_NUMBER,
        "default": 1,
        "help": "seed of the excitation and the noise, 0 or larger (default: %(default)s)",
    },
    "--seed": {**_NUMBER, "default": 1, "help": "seed of the record (default: %(default)s)"},
    "--quiet": {**_FLAG, "help": "no progress bar"},
    "--write": {"type": Path, "metavar": "DIR", "help": "write NAME.toml and NAME.csv into this folder"},
    "--exact": {**_FLAG, "help": "a record without a missing effect, so that the model is adequate"},
}

#: A group of options: its title, and their names; a stroke joins two that exclude each other.
_Group = tuple[str, str]
_COLUMNS: _Group = ("the record", "--input --output --time --dt --decimal --hold")
_RECORD: _Group = ("the record", f"{_COLUMNS[1]} --validation|--split")
_FIT = "--tolerance --no-offset --noise --horizon"
_SEARCH: _Group = ("candidate effects", f"--candidates --free {_FIT} --significance --matters")
_PRINTED: _Group = ("output", "--picture --json")
_OUTPUT: _Group = ("output", "--picture --json --report --overwrite")
_FILES = "mass_spring_damper.toml mass_spring_damper.csv"


class _Command(NamedTuple):
    """Command: what it does and takes, the keys of its JSON, an example."""

    summary: str
    description: str
    groups: Sequence[_Group]
    keys: str = ""
    example: str = ""
    exit_codes: str = _EXIT_CODES


_COMMANDS = {
    "demo": _Command(
        "run the workflow on an example: compare, diagnose, refine, improve",
        "Run the workflow on a structure whose model lacks friction: compare the model with a noisy "
        "record, diagnose, refine, and compare again on held-out data. Then do the same with two "
        "effects, step by step. Takes up to a minute.",
        [("", "--output/demo --seed/demo --quiet")],
        exit_codes="exit codes: 0 all went well, 1 the work failed (the message says why), 2 wrong usage",
    ),
    "check": _Command(
        "inspect data and model before anything else",
        "Check the record and the model: units, sign and gain, delay, offset, drift, clipping, sampling "
        "and closed loop. Print the smallest effects that the record could show. The picture shows the "
        "signals of the record.",
        [("", "model data"), _RECORD, _PRINTED],
        " (a sentence for each row that is not ok), record, rows (status, what, where, figure, "
        "sentence), detectable (effect, coefficient, smallest, unit).",
        _FILES,
    ),
    "compare": _Command(
        "how well one or several models explain a record, and where they fail",
        "Simulate each model over the record from its estimated initial state (free run). Print the fit in "
        "percent, the typical error, and where the best model fails.",
        [("", "models data"), _RECORD, ("", "--x0 --horizon"), _OUTPUT],
        " (3 sentences), record (name, samples, dt, hold, inputs, outputs, sha256_inputs, "
        "sha256_outputs), models (name; outputs: name, unit, fit, rmse, bias; failures: role, dimension, "
        "where, measure, statistic, p_value, share, sentence), report.",
        f"{_FILES} --report report.html",
    ),
    "diagnose": _Command(
        "which physical effect is missing",
        "Rank the physical effects that may be missing in the model, with their probabilities.",
        [("", "model data"), _RECORD, _SEARCH, _OUTPUT],
        " (3 sentences), record, verdict, "
        "ranking (effect: kind and place; coefficients, std, fit_before, fit_after, p_value, "
        "probability), none_of_these, places, ambiguous, parameters (as in improve), tests and "
        "winner_tests (name, statistic, dof, p_value), detectable (effect, coefficient, smallest, unit), "
        "significance, notes, checks (status, what, where, figure, sentence), next_step, report.",
        f"{_FILES} --picture found.png",
    ),
    "improve": _Command(
        "add one effect after the other until no further one is significant",
        "Diagnose, add the effect, fit all parameters together and test again, until no further effect is "
        "significant. The error is computed on held-out data.",
        [("", "model data"), _RECORD, _SEARCH, ("", "--max-effects"), _OUTPUT],
        " (3 sentences), record, verdict, "
        "message, checks (as in diagnose), next_step, steps (action, effect, coefficients, std, "
        "train_rmse, choice_rmse, validation_rmse, rivals), parameters (name, kind, place, role, initial, "
        "value, coefficient, std, unit), hold, system (A, B, C, D, inputs, outputs, states), report.",
        f"{_FILES} --report better.html",
    ),
    "refine": _Command(
        "add the effects that you name, and estimate them together with free parameters",
        "Estimate the effects of --effects and the parameters of --free together from the record, with "
        "their standard deviations. Validated by --validation or --split if given.",
        [("", "model data"), _RECORD, ("what is estimated", f"--effects/refine --free {_FIT}"), _OUTPUT],
        " (3 sentences), record, parameters "
        "(as in improve), hold, system, fit, rmse, initial_fit, success, message, warnings, report. The exit "
        "code is 0 where it converged.",
        f"{_FILES} --effects coulomb_friction@link2",
    ),
    "localize": _Command(
        "which link of a structure has lost or gained stiffness or damping",
        "Estimate the change of every link, and name those with a significant change.",
        [
            ("", "model data"),
            _RECORD,
            ("candidate effects", f"--candidates/localize {_FIT} --significance"),
            _PRINTED,
        ],
        " (what has changed), record, name, "
        "rows (name, kind, place, nominal, unit, change, std, percent, percent_std, p_value, limit, "
        "limit_percent, named, ...), and the other fields of the result. The exit code is 1 where a place "
        "has changed.",
        _FILES,
    ),
    "bode": _Command(
        "frequency responses of models, compared with that of a record",
        "Draw one model or several as a Bode diagram with --picture, and write the points with --csv "
        "(curve, output, input, omega [rad/s], magnitude, phase [deg]). The last file may be a record; the "
        "models are then sampled like the record, with its hold.",
        [("", "files"), _COLUMNS, ("output", "--picture --json --csv")],
        ", record (where there is one), curves (curve, output, input, omega, magnitude, phase_deg), report.",
        f"{_FILES} --picture bode.png --csv points.csv",
    ),
    "survey": _Command(
        "many records of many machines: one row each, and what they have in common",
        "Examine every record of a folder, on one or several processes or on a cluster. Compare the "
        "machines: which effects are common, which belong to one machine, which grow with time. A record "
        "that fails does not stop the survey.",
        [
            ("", "folder --model/survey --task --compare --scheduler|--jobs --conditions"),
            _COLUMNS,
            _SEARCH,
            ("output", "--report/survey --overwrite/survey --picture --json"),
        ],
        " (sentences), task, mode, significance, "
        "summary, rows (machine, record, number, start, verdict, effect, place, coefficient, std, unit, "
        "probability, seconds, error, estimates, sentences), effects (kind, place, name, unit, sort, "
        "n_machines, mean, std, spread, p_value, p_alike, machines), trends, breaches (condition, machine, "
        "sentence), report. With --conditions the exit code is 1 where one is not kept, and 0 otherwise.",
        ". --model mass_spring_damper.toml",
    ),
    "explore": _Command(
        "try effects by hand on an interactive page that shows the error",
        "Serve an interactive page of a model and a record at 127.0.0.1, to this machine alone, until "
        "Ctrl-C. Needs the extra explore.",
        [("", "model data"), _COLUMNS, ("", "--horizon --port --no-browser")],
        exit_codes="exit codes: 0 ended by Ctrl-C; 2 wrong usage, or a file or port that cannot be used",
    ),
    "example": _Command(
        "examples of the two files that the other commands read",
        "Print an example of a model file and of a record; --write writes both complete files. The "
        "record contains an effect that is missing in the model, so compare and diagnose end with exit "
        "code 1.",
        [("", "name --write --seed --exact")],
        exit_codes="exit codes: 0 printed or written; 2 wrong usage, or a file that cannot be written",
    ),
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
    for name, command in _COMMANDS.items():
        below = [command.exit_codes]
        if command.keys:
            below.insert(0, f"Keys of --json: command, rcorefine, exit_code, answer{command.keys}")
        epilog = "\n\n".join(textwrap.fill(text, 79) for text in below)
        if command.example:
            files = "example, with the files of rcorefine example --write .:"
            epilog += f"\n\n{files}\n  rcorefine {name} {command.example}"
        one = commands.add_parser(
            name,
            help=command.summary,
            description=textwrap.fill(command.description, 79),
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        for title, options in command.groups:
            group = one.add_argument_group(title) if title else one
            for option in options.split():
                either = option.split("|")  # what a command does not offer is None
                where = group if len(either) == 1 else group.add_mutually_exclusive_group()
                for key in either:
                    settings = dict(_OPTIONS[key])
                    flags = [key.partition("/")[0], *settings.pop("also", "").split()]
                    where.add_argument(*flags, **settings)
        one.set_defaults(**{key: None for key in ("free", "picture", "csv", "report")})
    return parser
