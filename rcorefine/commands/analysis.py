"""Commands that ask a public function about the files of one record."""

from __future__ import annotations

import inspect
import re
import sys
import threading
from argparse import ArgumentTypeError, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import control as ct

import rcorefine as rco

from .output import check_targets, finish


def analyze(
    model: Path,
    data: Path,
    /,
    *,
    arguments: Namespace,
    validation: Path | None = None,
    split: float | None = None,
) -> int:
    """Ask a public function about a model and a record.

    Parameters
    ----------
    model : Path
        Model: .toml (matrices, or a builder's parameters; see rcorefine example), or .npz/.mat with A, B,
        C, D.
    data : Path
        Record: .csv, .tsv, .txt, .lvm, .log (with a header), .mat, .npz or .h5.
    arguments : Namespace
        Parsed command line.
    validation : Path, optional
        Another record for validation.
    split : float, optional
        Fit this share of the record and validate on the rest (compare: only the rest is compared).

    Returns
    -------
    int
        1 where something was found, otherwise 0.
    """
    return analyze_models([model], data, arguments=arguments, validation=validation, split=split)


def analyze_models(
    models: Sequence[Path],
    data: Path,
    /,
    *,
    arguments: Namespace,
    validation: Path | None = None,
    split: float | None = None,
) -> int:
    """Ask a public function about one or several models and a record.

    Parameters
    ----------
    models, data, arguments, validation, split
        As in `analyze`.

    Returns
    -------
    int
        1 where something was found, otherwise 0.
    """
    check_targets(arguments)
    known = [rco.read_model(path) for path in models]
    record, held_out = _records(data, known[0], arguments, validation, split)
    shown = record if held_out is None else held_out
    function, given = arguments.public, taken(arguments.public, arguments, known[0])
    if "validation" in inspect.signature(function).parameters:
        given["validation"] = held_out
    if function is rco.compare:
        record = shown
    if isinstance(function, type):  # it takes the record as a stream
        result = function(known[0], **given | {"dt": record.dt, "hold": record.hold}).run(record)
    else:
        result = function(known[0] if len(known) == 1 else known, record, **given)
    # what is printed, where that is not the result's own
    sentences, fine = result.answer()
    text = str(result)
    if function is rco.improve:
        text += f"\n{result.refinement}"
    elif function is rco.compare:  # one model fails where another may not
        failures = result.failures[result.best] if result.several else result.failures
        text, fine = f"{text}\n{failures}", not failures
    return finish(arguments, not fine, sentences, result, text=text, data=record, beside=shown)


def _records(
    data: Path, model: Any, arguments: Namespace, validation: Path | None, split: float | None
) -> tuple[rco.Measurement, rco.Measurement | None]:
    """Return the record to fit and the held-out one, if any."""
    if validation is not None and split is not None:
        raise ArgumentTypeError("argument --split: not allowed with argument --validation")
    if split is not None and split >= 1:
        raise ArgumentTypeError("argument --split: a share lies between 0 and 1")
    record = read(data, model, arguments)
    if split is not None:
        return record.split(split)
    return record, None if validation is None else read(validation, model, arguments)


def explore(
    model: Path,
    data: Path,
    /,
    *,
    arguments: Namespace,
    horizon: float | None = None,
    port: int = 0,
    browser: bool = True,
) -> int:
    """Serve an interactive page of a model and a record, until Ctrl-C.

    The page is at 127.0.0.1, for this machine alone. It needs the extra explore.

    Parameters
    ----------
    model, data
        As in `analyze`.
    horizon
        As in `refine`.
    arguments : Namespace
        Parsed command line.
    port : int
        Port of the page; 0 for any that is free.
    browser : bool
        Open the browser.

    Returns
    -------
    int
        0.
    """
    first = rco.read_model(model)
    page = rco.explore(first, read(data, first, arguments), horizon=horizon)
    try:  # from the first thread on: one that serves would outlive this one
        address = page.show(port, browser=browser)
        sys.stdout.write(f"Explorer at {address} (Ctrl-C ends it)\n")
        sys.stdout.flush()
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        page.close()
    return 0


def read(path: Path, model: Any, arguments: Namespace) -> rco.Measurement:
    """Read the record for a model; errors name the option that would help."""
    given = reading(arguments)
    try:
        return rco.read_record(path, model, **given)
    except rco.DataError as error:
        hint = ""
        if given["time"] is given["dt"] is None and re.search("no (column|variable) 'time'", str(error)):
            hint = " (name the column of times with --time, or give the sampling time with --dt)"
        elif "a record is a " not in str(error) and None in (given["inputs"], given["outputs"]):
            hint = " (name the columns with --input and --output, in the order of the model's signals)"
        raise rco.DataError(f"{error}{hint}") from error


def reading(arguments: Namespace) -> dict[str, Any]:
    """Return what the command line gives for the reader of records."""
    given = taken(rco.read_record, arguments)
    return {name: value for name, value in given.items() if name != "model"}  # a model, not its file


def taken(function: Any, arguments: Namespace, model: Any = None) -> dict[str, Any]:
    """Return what the command line gives for the options of a function.

    Words for effects become effects of the model.
    """
    given: dict[str, Any] = {}
    for name, parameter in inspect.signature(function).parameters.items():
        value = getattr(arguments, name, None)
        if name == "progress":
            given[name] = sys.stderr.isatty() and not arguments.json
        elif parameter.default is parameter.empty or not hasattr(arguments, name):
            continue
        elif "Effect" in str(parameter.annotation):
            given[name] = parameter.default if value is None else wanted_candidates(model, value)
        elif value == ["linear"] or (name == "noise" and value is not None and len(value) == 1):
            given[name] = value[0]
        else:
            given[name] = value
    return given


def wanted_candidates(model: Any, wanted: Sequence[str] | None) -> list[rco.Effect] | None:
    """Effects that the command line names.

    Parameters
    ----------
    model : StateSpace or PhysicalModel
        Model.
    wanted : sequence of str or None
        Kinds, places, or ``kind@place``; None for all that are plausible.

    Returns
    -------
    list of Effect or None

    Raises
    ------
    ModelError
        If a word is neither kind nor place.

    Examples
    --------
    >>> chain = rco.mass_spring_damper([1.0, 1.0], [1.0, 1.0], [50.0, 50.0])
    >>> [effect.label for effect in wanted_candidates(chain, ["coulomb_friction@link2", "hysteresis@link1"])]
    ['coulomb_friction at link2', 'hysteresis at link1']
    """
    if not wanted:
        return None
    library = rco.effect_library(model)
    places = dict.fromkeys(effect.place for effect in library)
    found: list[rco.Effect] = []
    for word in wanted:
        kind, at, place = word.partition("@")
        if not at and word in places:
            found += [effect for effect in library if effect.place == word]
            continue
        try:
            found += rco.effect_library(model, kinds=kind, places=place or None)
        except ct.ControlArgument as error:
            raise rco.ModelError(
                f"no candidate {word!r}: {error}. Or give places ({', '.join(places)}) or kind@place"
            ) from None
    return list(dict.fromkeys(found))
