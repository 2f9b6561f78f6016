"""The command `rcorefine`: the loop from the terminal."""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from argparse import Namespace
from collections.abc import Sequence
from importlib import import_module
from typing import Any

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
        from .parser import build_parser

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
    homes = {"demo": "demo", "example": "example", "survey": "survey"}
    homes |= dict.fromkeys(("check", "compare", "diagnose", "improve"), "analysis")
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
