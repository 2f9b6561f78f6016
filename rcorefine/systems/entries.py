"""Entries of the matrices of a model by name."""

from __future__ import annotations

import re
from collections.abc import Sequence

from ..arguments import as_text
from ..exceptions import ModelError
from .linear import LinearModel

__all__ = ["entry_of"]


def entry_of(linear: LinearModel, place: str) -> tuple[int, int]:
    """Return row and column of a matrix entry such as ``"A[1,0]"``.

    They refer to the matrix [A B; C D]. Labels are accepted, too, as in ``"B[v1,force]"``.

    Parameters
    ----------
    linear : LinearModel
        Model.
    place : str
        Row and column in its matrix, counted from 0 or by label.

    Returns
    -------
    row, column : int

    Raises
    ------
    ModelError
        If the text is not of this form or the entry does not exist.
    """
    match = re.fullmatch(r"([ABCD])\[(.+)\]", as_text(place, "place").strip())
    states, inputs, outputs = linear.state_labels, linear.input_labels, linear.output_labels
    if match:
        below, right = match[1] in "CD", match[1] in "BD"
        pieces = match[2].split(",")
        for cut in range(1, len(pieces)):  # a label may hold a comma itself
            row = _index(outputs if below else states, ",".join(pieces[:cut]).strip())
            column = _index(inputs if right else states, ",".join(pieces[cut:]).strip())
            if row is not None and column is not None:
                return row + len(states) * below, column + len(states) * right
    named = (", ".join(labels) or "none" for labels in (states, inputs, outputs))
    raise ModelError(
        f"{place!r} is no entry of the model: write 'A[i,j]' (or B, C, D) with numbers from 0, or labels "
        "of states ({}), inputs ({}) and outputs ({})".format(*named)
    )


def _index(labels: Sequence[str], text: str) -> int | None:
    """Which of the labels a text names, itself or by its number."""
    if text in labels:
        return labels.index(text)
    return int(text) if text.isdecimal() and int(text) < len(labels) else None
