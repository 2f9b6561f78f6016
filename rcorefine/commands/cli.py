"""The command `rcorefine`: its options, and its entry."""

from __future__ import annotations

import argparse
import inspect
import os
import sys
import textwrap
import traceback
import warnings
from collections.abc import Sequence
from pkgutil import resolve_name
from typing import Any, NamedTuple

from ..version import __version__

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
        parser = build_parser(next((word for word in words if word in _COMMANDS), ""))
        arguments = parser.parse_args(words, argparse.Namespace(words=words))
        said = f"rcorefine {arguments.command}"
        failed = 1 if arguments.command == "demo" else 2
        with warnings.catch_warnings():
            if argv is None:  # in a process of its own: a warning is a line, not a place in the source
                warnings.showwarning = _say_warning
            return int(arguments.run(arguments))
    except argparse.ArgumentTypeError as error:
        parser.error(str(error))
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


def _message(error: Exception) -> str:
    """Return the error message on one line.

    The error number of the operating system is left out.
    """
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return " ".join(str(error).split())


def _say_warning(message: Any, *_: Any, **__: Any) -> None:
    sys.stderr.write(f"rcorefine: warning: {' '.join(str(message).split())}\n")


def _run(arguments: argparse.Namespace) -> Any:
    """Call the function of a command with what the command line gives."""
    function = resolve_name(_COMMANDS[arguments.command].function)
    parameters = inspect.signature(function).parameters.values()
    known = vars(arguments) | {"arguments": arguments}
    first = [known[one.name] for one in parameters if one.kind is one.POSITIONAL_ONLY]
    named = {one.name for one in parameters if one.kind is one.KEYWORD_ONLY} & known.keys()
    return function(*first, **{name: known[name] for name in named})


_EXIT_CODES = (
    "exit codes: 0 adequate, nothing found; 1 something found; 2 wrong usage, or a file that cannot be used "
    "(the message is on standard error); 3 an internal error"
)
_FILES = "mass_spring_damper.toml mass_spring_damper.csv"
_ANALYZE = "rcorefine.commands.analysis:analyze"
_READ = ("the record", "rcorefine:read_record")
_OUTPUT = ("output", "rcorefine.commands.output:Output")


class _Command(NamedTuple):
    """Command: its functions, whose parameters are its options, and texts."""

    summary: str
    function: str = _ANALYZE
    public: str = ""  #: function of the package that it calls
    more: tuple[tuple[str, str], ...] = (_READ, _OUTPUT)
    without: str = ""  #: parameters that are no options
    keys: str = ""
    example: str = _FILES
    exit_codes: str = _EXIT_CODES


_COMMANDS = {
    "demo": _Command(
        "run the workflow on an example: compare, diagnose, refine, improve",
        "rcorefine.commands.demo:demo",
        more=(),
        example="",
        exit_codes="exit codes: 0 all went well, 1 the work failed (the message says why), 2 wrong usage",
    ),
    "check": _Command(
        "inspect data and model before anything else",
        public="rcorefine:check",
        without="effects",
        keys=" (a sentence for each row that is not ok), record, rows (status, what, where, figure, "
        "sentence), detectable (effect, coefficient, smallest, unit), report.",
    ),
    "compare": _Command(
        "how well one or several models explain a record, and where they fail",
        "rcorefine.commands.analysis:analyze_models",
        "rcorefine:compare",
        keys=" (3 sentences), record (name, samples, dt, hold, inputs, outputs, sha256_inputs, "
        "sha256_outputs), models (name; outputs: name, unit, fit, rmse, bias; failures: role, dimension, "
        "where, measure, statistic, p_value, share, sentence), report.",
        example=f"{_FILES} --report report.html",
    ),
    "diagnose": _Command(
        "which physical effect is missing",
        public="rcorefine:diagnose",
        keys=" (3 sentences), record, verdict, "
        "ranking (effect: kind and place; coefficients, std, fit_before, fit_after, p_value, "
        "probability), none_of_these, places, ambiguous, parameters (as in improve), tests and "
        "winner_tests (name, statistic, dof, p_value), detectable (effect, coefficient, smallest, unit), "
        "significance, notes, checks (status, what, where, figure, sentence), next_step, report.",
        example=f"{_FILES} --picture found.png",
    ),
    "improve": _Command(
        "add one effect after the other until no further one is significant",
        public="rcorefine:improve",
        keys=" (3 sentences), record, verdict, "
        "message, checks (as in diagnose), next_step, steps (action, effect, coefficients, std, "
        "train_rmse, choice_rmse, validation_rmse, rivals), parameters (name, kind, place, role, initial, "
        "value, coefficient, std, unit), hold, system (A, B, C, D, inputs, outputs, states), report.",
        example=f"{_FILES} --report better.html",
    ),
    "refine": _Command(
        "add the effects that you name, and estimate them together with free parameters",
        public="rcorefine:refine",
        keys=" (3 sentences), record, parameters "
        "(as in improve), hold, system, fit, rmse, initial_fit, success, message, warnings, report. The exit "
        "code is 0 where it converged.",
        example=f"{_FILES} --effects coulomb_friction@link2",
    ),
    "localize": _Command(
        "which link of a structure has lost or gained stiffness or damping",
        public="rcorefine:localize_damage",
        keys=" (what has changed), record, name, "
        "rows (name, kind, place, nominal, unit, change, std, percent, percent_std, p_value, limit, "
        "limit_percent, named, ...), the other fields of the result, report. The exit code is 1 where a "
        "place has changed.",
    ),
    "stream": _Command(
        "refine a model while the samples of a record arrive",
        public="rcorefine:RCORefiner",
        without="validation split",
        keys=", record, n_samples, n_learned, system, report. The exit code is 0.",
    ),
    "monitor": _Command(
        "watch a record as a stream: an alarm names the change",
        public="rcorefine:Monitor",
        without="validation split",
        keys=" (the alarm, or the fit), record, n_samples, alarm, rows (effect, coefficients, std, "
        "probability, log_likelihood), report. The exit code is 1 where an alarm is on.",
    ),
    "bode": _Command(
        "frequency responses of models, compared with that of a record",
        "rcorefine.commands.bode:bode",
        without="report overwrite",
        keys=", record (where there is one), curves (curve, output, input, omega, magnitude, phase_deg), "
        "report.",
        example=f"{_FILES} --picture bode.png --csv points.csv",
    ),
    "survey": _Command(
        "many records of many machines: one row each, and what they have in common",
        "rcorefine.commands.many:survey",
        more=(("options of the task", "rcorefine:diagnose"), _READ, _OUTPUT),
        keys=" (sentences), task, mode, significance, "
        "summary, rows (machine, record, number, start, verdict, effect, place, coefficient, std, unit, "
        "probability, seconds, error, estimates, sentences), effects (kind, place, name, unit, sort, "
        "n_machines, mean, std, spread, p_value, p_alike, machines), trends, breaches (condition, machine, "
        "sentence), report. With --conditions the exit code is 1 where one is not kept, and 0 otherwise.",
        example=". --model mass_spring_damper.toml",
    ),
    "explore": _Command(
        "try effects by hand on an interactive page that shows the error",
        "rcorefine.commands.analysis:explore",
        more=(_READ,),
        example="",
        exit_codes="exit codes: 0 ended by Ctrl-C; 2 wrong usage, or a file or port that cannot be used",
    ),
    "example": _Command(
        "examples of the two files that the other commands read",
        "rcorefine.commands.example:example",
        more=(),
        example="",
        exit_codes="exit codes: 0 printed or written; 2 wrong usage, or a file that cannot be written",
    ),
}


def build_parser(wanted: str) -> argparse.ArgumentParser:
    """Parser of `rcorefine`.

    Parameters
    ----------
    wanted : str
        Command whose options are made; to import what the others call would take seconds.

    Returns
    -------
    ArgumentParser
        Subcommands demo, check, compare, diagnose, improve, refine, localize, stream, monitor, bode,
        survey, explore, example.
    """
    parser = argparse.ArgumentParser(
        prog="rcorefine",
        description="Find out why a linear model and a measured record disagree, and correct the model.",
        epilog=_EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, command in _COMMANDS.items():
        one = commands.add_parser(
            name, help=command.summary, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        if name == wanted:
            _describe(one, name, command)
    return parser


def _describe(parser: argparse.ArgumentParser, name: str, command: _Command) -> None:
    """Give a command the options and the help of its functions."""
    from .options import add_options

    function = resolve_name(command.function)
    public = resolve_name(command.public) if command.public else function
    parser.set_defaults(run=_run, public=public)
    prose = (inspect.getdoc(public) or "").partition("\nParameters\n")[0].replace("`", "").split("\n\n")
    parser.description = "\n\n".join(textwrap.fill(" ".join(one.split()), 79) for one in prose)
    add_options(parser, function, "", command.without)
    for title, other in command.more:  # before the others: a stream has the sampling time of its record
        add_options(parser, resolve_name(other), title, command.without)
    add_options(parser, public, f"arguments of rcorefine.{public.__name__}()", command.without)
    below = [command.exit_codes]
    if command.keys:
        below.insert(0, f"Keys of --json: command, rcorefine, exit_code, answer{command.keys}")
    parser.epilog = "\n\n".join(textwrap.fill(text, 79) for text in below)
    if command.example:
        files = "example, with the files of rcorefine example --write .:"
        parser.epilog += f"\n\n{files}\n  rcorefine {name} {command.example}"
