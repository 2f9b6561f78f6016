"""Command `bode`: frequency responses of models, beside that of a record."""

from __future__ import annotations

import csv as text_tables
import io
import textwrap
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import control as ct
import numpy as np

import rcorefine as rco

from ..writing import replacing
from .analysis import read
from .output import check_targets, finish

_COLUMNS = ("curve", "output", "input", "omega", "magnitude", "phase_deg")


def bode(files: Sequence[Path], /, *, arguments: Namespace, csv: Path | None = None) -> int:
    """Draw one model or several as a Bode diagram, and write the points.

    The last file may be a record; the models are then sampled like the record, with its hold.

    Parameters
    ----------
    files : sequence of Path
        Models: .toml, .npz or .mat; a record may be the last.
    arguments : Namespace
        Parsed command line.
    csv : Path, optional
        Write the points: curve, output, input, omega [rad/s], magnitude, phase [deg] (semicolons separate
        them with --decimal ,).

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
    data = None
    paths = files[:-1] if _is_record(files[-1]) else files
    if not paths:
        raise rco.ModelError(f"{files[0]} is a record; give at least one model before it")
    models = [rco.read_model(path) for path in paths]
    if len(paths) < len(files):
        data = read(files[-1], models[0], arguments)
    shown, responses = _responses([path.stem for path in paths], models, data)
    curves = [curve for one in responses for curve in _curves(*one)]
    if csv is not None:
        _write_csv(csv, curves, arguments.decimal or ".")
    text = "\n".join(line for curve in curves for line in textwrap.wrap(_said(curve, curves), 80))
    content = {"curves": [c | {key: c[key].tolist() for key in _COLUMNS[3:]} for c in curves]}
    return finish(arguments, 0, [], None, text=text, data=data, content=content, draw=shown.plot)


def _is_record(path: Path) -> bool:
    """A .toml file is a model; .mat and .npz hold one where they hold an A."""
    if path.suffix.lower() == ".toml":
        return False
    try:
        rco.read_model(path)
    except rco.ModelError:
        return True
    return False


def _responses(names: list[str], models: list[Any], data: Any) -> tuple[Any, list[tuple[str, Any, Any]]]:
    """Return what draws the responses, and each with name and frequencies."""
    if data is None:
        alone = [ct.frequency_response(getattr(model, "system", model)) for model in models]
        return ct.FrequencyResponseList(alone), list(zip(names, alone, alone, strict=True))
    measured = data.frequency_response()
    shown = rco.compare(models, measured)
    known = [(name, measured, one) for name, one in zip(names, shown.responses, strict=True)]
    return shown, [*known, ("measured", measured, measured.response)]


def _curves(name: str, signals: Any, response: Any) -> list[dict[str, Any]]:
    """Return one curve for each output and input of a response."""
    values = np.asarray(getattr(response, "frdata", response))
    found = []
    for i, j in np.ndindex(values.shape[:2]):
        points = {"omega": signals.omega, "magnitude": np.abs(values[i, j])}
        points["phase_deg"] = np.degrees(np.angle(values[i, j]))
        found.append({
            "curve": name, "output": signals.output_labels[i], "input": signals.input_labels[j], **points
        })  # fmt: skip
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
    ratio = curve["magnitude"] / measured["magnitude"]
    off, there = 100 * np.median(np.abs(ratio - 1)), ratio[int(np.argmax(measured["magnitude"]))]
    return (
        f"{text}; differs by {off:.3g} % from the measured response (median), {there:.3g} times it at its "
        "peak"
    )


def _write_csv(path: Path, curves: list[dict[str, Any]], decimal: str) -> None:
    """A line for each point; semicolons where the decimal mark is a comma."""
    text = io.StringIO()
    writer = text_tables.writer(text, delimiter=";" if decimal == "," else ",", lineterminator="\n")
    writer.writerow(_COLUMNS)
    for curve in curves:
        for point in zip(*(curve[name] for name in _COLUMNS[3:]), strict=True):
            figures = [f"{value:.9g}".replace(".", decimal) for value in point]
            writer.writerow([*(curve[name] for name in _COLUMNS[:3]), *figures])
    with replacing(path) as stream:
        stream.write(text.getvalue().encode())
