"""The command `rcorefine`: the loop from the terminal."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from . import __version__
from .exceptions import RCOError

__all__ = ["main"]

_EXIT_CODES = "exit codes: 0 all went well, 1 the work failed (the message says why), 2 wrong usage"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="rcorefine",
        description="Find out why a linear model and a measured record disagree, and mend the model.",
        epilog=_EXIT_CODES,
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    demo = commands.add_parser(
        "demo",
        help="run the loop on an example: compare, refine, compare again",
        description=(
            "Run the loop on a circuit whose model is wrong: compare the model with a noisy record, "
            "refine it sample by sample, and compare again on data that the refinement has not seen. "
            "Takes up to a minute."
        ),
        epilog=_EXIT_CODES,
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
    return parser


def _seed(text: str) -> int:
    """Parse a seed; argparse turns the error into exit code 2."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{value} is negative; give 0 or larger")
    return value


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
        0 where all went well, 1 where the work failed (the message is on
        standard error). Wrong usage ends the process with 2.

    Examples
    --------
    >>> from rcorefine.cli import main
    >>> main(["--version"])
    Traceback (most recent call last):
    SystemExit: 0
    """
    arguments = _parser().parse_args(argv)
    try:
        # late, so that --help and wrong usage answer at once
        from .demo import run_demo

        run_demo(arguments.output, seed=arguments.seed, progress=not arguments.quiet)
    except BrokenPipeError:
        # the reader left (rcorefine demo | head); keep the interpreter from complaining once more on exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (RCOError, OSError) as error:
        sys.stderr.write(f"rcorefine {arguments.command}: {error}\n")
        return 1
    return 0
