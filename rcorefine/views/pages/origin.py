"""Origin of a report: fingerprint of its record, software versions."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from ...data.frequency_response import FrequencyResponse
from ...data.response_record import in_frequency
from ...jit import NUMBA
from ...systems.linear import Array
from ...version import __version__
from ..tables import number

__all__ = ["fingerprint", "record_facts", "response_facts", "version_facts"]

_PACKAGES = ("control", "numpy", "scipy", "matplotlib", "numba")


def fingerprint(values: Array) -> str:
    """SHA-256 of an array's numbers: equal records have equal fingerprints.

    Parameters
    ----------
    values : ndarray
        Numbers.

    Returns
    -------
    str
        Of the bytes of the array as little-endian float64, row by row.

    Examples
    --------
    >>> import hashlib, numpy as np
    >>> fingerprint(np.array([1.0])) == hashlib.sha256(bytes.fromhex("000000000000f03f")).hexdigest()
    True
    """
    return hashlib.sha256(np.ascontiguousarray(values, dtype="<f8").tobytes()).hexdigest()


def record_facts(records: Sequence[Any]) -> list[tuple[str, str]]:
    """Names and values that identify the records.

    Parameters
    ----------
    records : sequence of Measurement, or of FrequencyResponse
        What a result rests on.

    Returns
    -------
    list of (str, str)
    """
    if in_frequency(records):
        return [row for one in records for row in response_facts(one)]
    rows = []
    for data in records:
        rows += [
            ("record", data.name),
            ("samples", f"{data.n_samples}, {number(data.dt, 6)} s apart, hold {data.hold!r}"),
            ("time", f"{number(data.timepts[0], 6)} to {number(data.timepts[-1], 6)} s"),
            ("inputs", _signals(data.input_labels, data.input_units)),
            ("outputs", _signals(data.output_labels, data.output_units)),
            ("sha256 of the inputs", fingerprint(data.inputs)),
            ("sha256 of the outputs", fingerprint(data.outputs)),
        ]
    return rows


def response_facts(measured: FrequencyResponse) -> list[tuple[str, str]]:
    """Names and values that identify a measured response."""
    parts = np.stack([measured.response.real, measured.response.imag])
    return [
        ("response", measured.name),
        (
            "frequencies",
            f"{measured.omega.size}, {number(measured.omega[0])} to {number(measured.omega[-1])} rad/s",
        ),
        ("inputs", _signals(measured.input_labels, measured.input_units)),
        ("outputs", _signals(measured.output_labels, measured.output_units)),
        ("sha256 of the frequencies", fingerprint(measured.omega)),
        ("sha256 of the response", f"{fingerprint(parts)} (real parts, then imaginary parts)"),
    ]


def _signals(labels: Sequence[str], units: Sequence[str]) -> str:
    return ", ".join(
        f"{label} [{unit}]" if unit else label for label, unit in zip(labels, units, strict=True)
    )


def version_facts() -> list[tuple[str, str]]:
    """Versions of what computed the result.

    Returns
    -------
    list of (str, str)
    """
    rows = [("rcorefine", __version__), ("Python", f"{platform.python_version()} on {platform.system()}")]
    for package in _PACKAGES:
        if package == "numba" and not NUMBA:
            rows.append(("numba", "not used"))
            continue
        try:
            rows.append((package, version(package)))
        except PackageNotFoundError:
            rows.append((package, "version unknown"))
    return rows
