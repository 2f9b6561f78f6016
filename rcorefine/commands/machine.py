"""Results as one machine-readable object, for ``--json``."""

from __future__ import annotations

import json
from typing import Any

from ..data.measurement import Measurement
from ..views.data import plain
from ..views.pages.origin import fingerprint

__all__ = ["json_text", "record_object"]


def json_text(content: dict[str, Any]) -> str:
    """Strict JSON: what is not finite becomes null.

    Parameters
    ----------
    content : dict
        Numbers, arrays, text and sequences.

    Returns
    -------
    str

    Examples
    --------
    >>> json_text({"fit": np.array([1.0, np.nan])})
    '{"fit": [1.0, null]}'
    """
    return json.dumps(plain(content), allow_nan=False, ensure_ascii=True)


def record_object(data: Measurement) -> dict[str, Any]:
    """Name, size and fingerprint of a record."""
    return {
        "name": data.name,
        "samples": data.n_samples,
        "dt": data.dt,
        "hold": data.hold,
        "inputs": data.input_labels,
        "outputs": data.output_labels,
        "sha256_inputs": fingerprint(data.inputs),
        "sha256_outputs": fingerprint(data.outputs),
    }
