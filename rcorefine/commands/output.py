"""Pictures, reports and the printed text or JSON of a command."""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import re
import shlex
import sys
from argparse import ArgumentTypeError, Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import rcorefine as rco

from ..arguments import printable
from ..writing import check_target, replacing

#: Options of one command alone: the next one does not take them over. True: a value follows.
_OWN = dict.fromkeys(
    ("--picture", "--report", "--csv", "--candidates", "--effects", "--significance", "--matters",
     "--max-effects", "--x0", "--free", "--validation", "--split", "--effort"), True
) | {"--json": False, "--overwrite": False, "--no-information": False}  # fmt: skip
#: What follows each verdict of a diagnosis, and its options; else the named effects are refined.
_NEXT = {
    "adequate": ("compare", "--picture", "compare.png"),
    "parameters": ("refine", "--free", "linear"),
    "unexplained": ("improve",),
}


@dataclass(frozen=True)
class Output:
    """Files and form of the output.

    Parameters
    ----------
    picture : Path, optional
        Draw the result (.png, .svg or .pdf).
    json : bool
        Print one JSON object in place of the tables.
    report : Path, optional
        Write an HTML report; for a survey a folder with an index page and one per machine.
    overwrite : bool
        Replace files even if they are not reports.
    """

    picture: Path | None = None
    json: bool = False
    report: Path | None = None
    overwrite: bool = False


def check_targets(arguments: Namespace) -> None:
    """Check before the work that report, picture and table can be written."""
    picture, report = arguments.picture, getattr(arguments, "report", None)
    if picture is not None and picture.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise ArgumentTypeError(f"argument --picture: {str(picture)!r} is not named .png, .svg or .pdf")
    if report is not None and arguments.command != "survey":
        check_target(report, overwrite=arguments.overwrite)
    for path in (picture, getattr(arguments, "csv", None)):
        if path is not None and not path.absolute().parent.is_dir():
            raise FileNotFoundError(f"the folder {path.absolute().parent} does not exist; make it first")


def finish(
    arguments: Namespace,
    code: bool | int,
    sentences: Sequence[str],
    result: Any,
    *,
    text: str,
    data: rco.Measurement | None = None,
    content: dict[str, Any] | None = None,
    draw: Callable[[], Any] | None = None,
    beside: rco.Measurement | None = None,
) -> int:
    """Write the report and the picture, then say what was found.

    Parameters
    ----------
    arguments : Namespace
        Parsed command line.
    code : int
        Exit code.
    sentences : sequence of str
        The answer, for JSON.
    result : Result
        What was found.
    text : str
        What is printed.
    data : Measurement, optional
        Record that it rests on.
    content, draw : dict, callable, optional
        What JSON holds, and what draws, where these are not the result's own.
    beside : Measurement, optional
        Record of the report.

    Returns
    -------
    int
        The exit code.
    """
    written: dict[str, Path] = {}
    command = f"rcorefine {shlex.join(arguments.words)}"
    if getattr(arguments, "report", None) is not None:
        more = {"data": beside} if "data" in inspect.signature(result.report).parameters else {}
        code_line = f"# in a terminal:\n# {printable(command)}"
        written["Report"] = result.report(
            arguments.report, code=code_line, overwrite=arguments.overwrite, **more
        )
    if arguments.picture is not None:
        written["Picture"] = arguments.picture
        _write_picture((draw or result.plot)().figure, arguments.picture)
    if arguments.json:
        head: dict[str, Any] = {"command": arguments.command, "rcorefine": rco.__version__}
        head |= {"exit_code": int(code), "answer": list(sentences)}
        head |= {} if data is None else {"record": _identity(data)}
        head |= result.to_dict() if content is None else content
        said = json.dumps(head | {"report": str(written["Report"]) if "Report" in written else None})
    else:
        following = result.to_dict().get("next_step") if hasattr(result, "verdict") else None
        if following:  # a line of Python; here a command follows
            text = re.sub(r"\s+".join(map(re.escape, f"\nNext: {following}".split(" "))), "", text)
        words = _next_words(arguments, result)
        said = "\n".join([
            text,
            *([f"Next: rcorefine {printable(shlex.join(words))}"] if words else []),
            *(f"{what}: {path}" for what, path in written.items()),
        ])  # fmt: skip
    try:
        sys.stdout.write(said + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        # the reader left (rcorefine compare ... | head); what was found is still in the exit code
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return int(code)


def _identity(data: rco.Measurement) -> dict[str, Any]:
    """Return name, size, signals and fingerprints of a record."""
    signals = {"inputs": data.inputs, "outputs": data.outputs}
    known = {"name": data.name, "samples": data.n_samples, "dt": data.dt, "hold": data.hold}
    known |= {"inputs": list(data.input_labels), "outputs": list(data.output_labels)}
    for side, values in signals.items():
        known[f"sha256_{side}"] = hashlib.sha256(np.ascontiguousarray(values, "<f8").tobytes()).hexdigest()
    return known


def _next_words(arguments: Namespace, result: Any) -> list[str]:
    """Return the words of the next command, with files and record options."""
    following: tuple[str, ...] = ()
    if arguments.command == "diagnose":
        named = ",".join(f"{effect.kind}@{effect.place}" for effect in result.effects)
        following = _NEXT.get(result.verdict, ("refine", "--effects", named))
    elif arguments.command in ("check", "compare"):
        if not getattr(result, "stops", False) and not getattr(result, "several", False):
            following = ("diagnose",)
    if not following:
        return []
    kept, words = [], iter(arguments.words[1:])
    for word in words:
        option = word.partition("=")[0]
        if option not in _OWN:
            kept.append(word)
        elif _OWN[option] and "=" not in word:
            next(words, None)
    return [following[0], *kept, *following[1:]]


def _write_picture(figure: Any, path: Path) -> None:
    """Write a figure as PNG, SVG or PDF, by the suffix."""
    import matplotlib.pyplot as plt

    with replacing(path) as stream:
        figure.savefig(stream, format=path.suffix.lower()[1:], dpi=120)
    plt.close(figure)
