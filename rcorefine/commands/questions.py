"""Commands `rcorefine bode`, `explore`, `refine` and `localize`."""

from __future__ import annotations

import csv
import io
import sys
import threading
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..data.channels import SUFFIXES
from ..data.frequency_response import FrequencyResponse
from ..exceptions import ModelError
from ..explorer.serving import explore
from ..localization.localize import localize_damage
from ..models.reading import read_model
from ..refinement.refine import refine
from ..systems.linear import Array, LinearModel
from ..systems.response import as_sampled, frequency_response
from ..views.bode import bode_comparison, bode_grid
from ..views.content import content
from ..views.tables import wrapped
from ..writing import replacing
from .analysis import check_targets, finish, fit_options, opened, read_record, wanted_candidates

_COLUMNS = ("curve", "output", "input", "omega", "magnitude", "phase_deg")


def run_refine(arguments: Namespace) -> int:
    """Add effects, estimate them and what floats; 0 where it converged."""
    model, data, held_out = opened(arguments)
    effects = wanted_candidates(model, arguments.candidates) or []
    found = refine(model, data, effects, **fit_options(arguments))
    sentences, fine = content(found).answer()
    shown = data if held_out is None else held_out
    draw = partial(found.bode_plot, shown)
    return finish(arguments, not fine, sentences, found, data, draw=draw, beside=shown)


def run_localize(arguments: Namespace) -> int:
    """Find which links of a structure have changed; 1 where one has."""
    model, data, _ = opened(arguments)
    options = fit_options(arguments)
    del options["free"]
    found = localize_damage(
        model, data, candidates=arguments.candidates, significance=arguments.significance, **options
    )
    named = [f"{row.kind} at {row.place}: {row.percent:.3g} %" for row in found.named] + [found.message]
    return finish(arguments, bool(found.named), named, found, data)


def run_explore(arguments: Namespace) -> int:
    """Serve the page until Ctrl-C; 0."""
    model = read_model(arguments.model)
    data = read_record(arguments.data, model, arguments)
    page = explore(model, data, horizon=arguments.horizon)
    try:  # from the first thread on: one that serves would outlive this one
        address = page.show(arguments.port, browser=arguments.browser)
        sys.stdout.write(f"Explorer at {address} (Ctrl-C ends it)\n")
        sys.stdout.flush()
        threading.Event().wait()
    except KeyboardInterrupt:
        pass
    finally:
        page.close()
    return 0


def run_bode(arguments: Namespace) -> int:
    """Draw models, and a record if there is one, as a Bode diagram.

    The last file may be the record. The data of the diagram are written on request.

    Parameters
    ----------
    arguments : Namespace
        Parsed command line.

    Returns
    -------
    int
        0.

    Raises
    ------
    ModelError
        If there is no model among the files.
    """
    check_targets(arguments)
    paths: list[Path] = arguments.files
    record = paths[-1] if _is_record(paths[-1]) else None
    paths = paths[:-1] if record else paths
    if not paths:
        raise ModelError(f"{record} is a record; give at least one model before it")
    models = [read_model(path) for path in paths]
    systems = [
        (path.stem, LinearModel.from_statespace(getattr(model, "system", model)))
        for path, model in zip(paths, models, strict=True)
    ]
    data = None if record is None else read_record(record, models[0], arguments)
    measured = None if data is None else data.frequency_response()
    curves = _curves(systems, measured)
    if arguments.csv is not None:
        _write_csv(arguments.csv, curves, arguments.decimal)
    text = "\n".join(wrapped([_said(curve, curves) for curve in curves]))
    draw = partial(bode_comparison, systems, measured)
    return finish(arguments, 0, [], None, data, text=text, content={"curves": curves}, draw=draw)


def _is_record(path: Path) -> bool:
    """By its suffix; .mat and .npz hold a model where they hold an A."""
    if path.suffix.lower() not in (".mat", ".npz"):
        return path.suffix.lower() in SUFFIXES
    try:
        read_model(path)
    except ModelError:
        return True
    return False


def _curves(
    systems: list[tuple[str, LinearModel]], measured: FrequencyResponse | None
) -> list[dict[str, Any]]:
    """Return the responses of all models and the measured response.

    Each model is sampled as the record is. There is one curve for each input and output.
    """
    found = []
    for name, model in systems:
        seen = model if measured is None else as_sampled(model, measured.dt, measured.hold)
        omega = bode_grid(seen, measured, None)
        labels = model.output_labels, model.input_labels
        found += _rows(name, *labels, omega, frequency_response(seen, omega))
    if measured is not None:
        labels = tuple(measured.output_labels), tuple(measured.input_labels)
        found += _rows("measured", *labels, measured.omega, measured.frdata)
    return found


def _rows(
    name: str, outputs: tuple[str, ...], inputs: tuple[str, ...], omega: Array, response: Any
) -> list[dict[str, Any]]:
    found = []
    for i, j in np.ndindex(len(outputs), len(inputs)):
        G = response[i, j]
        points = {"omega": omega, "magnitude": np.abs(G), "phase_deg": np.degrees(np.angle(G))}
        found.append({"curve": name, "output": outputs[i], "input": inputs[j], **points})
    return found


def _said(curve: dict[str, Any], curves: list[dict[str, Any]]) -> str:
    """A curve in a line: its peak, and how far it is from what was measured."""
    peak = int(np.argmax(curve["magnitude"]))
    text = (
        f"{curve['curve']}, {curve['input']} to {curve['output']}: largest {curve['magnitude'][peak]:.4g} "
        f"at {curve['omega'][peak]:.4g} rad/s"
    )
    same = ("measured", curve["output"], curve["input"])
    measured = next((c for c in curves if (c["curve"], c["output"], c["input"]) == same), curve)
    if measured is curve:
        return text
    ratio = np.interp(measured["omega"], curve["omega"], curve["magnitude"]) / measured["magnitude"]
    there = ratio[int(np.argmax(measured["magnitude"]))]
    off = 100 * np.median(np.abs(ratio - 1))
    return (
        f"{text}; differs by {off:.3g} % from the measured response (median), {there:.3g} times it at its "
        "peak"
    )


def _write_csv(path: Path, curves: list[dict[str, Any]], decimal: str | None) -> None:
    """A line for each point; semicolons where the decimal mark is a comma."""
    text = io.StringIO()
    writer = csv.writer(text, delimiter=";" if decimal == "," else ",", lineterminator="\n")
    writer.writerow(_COLUMNS)
    for curve in curves:
        for point in zip(*(curve[name] for name in _COLUMNS[3:]), strict=True):
            figures = [f"{value:.9g}".replace(".", decimal or ".") for value in point]
            writer.writerow([*(curve[name] for name in _COLUMNS[:3]), *figures])
    with replacing(path) as stream:
        stream.write(text.getvalue().encode())
