"""Removal of the text that a serial monitor writes around the numbers.

This text is its clock before an arrow, and the names in ``name:value`` pairs.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from ..exceptions import DataError

__all__ = ["unwrapped"]

_CLOCK = re.compile(r"\s*\d\d:\d\d:\d\d[.,]\d+ -> ?")
_LABEL = re.compile(r"([^\s,;:]+)\s*:\s*(?=[-+.\d])")
_HEAD = 100  # lines in which the form of a log shows


def unwrapped(lines: list[str], names: Sequence[str], path: object) -> tuple[list[str], tuple[str, ...]]:
    """Convert the lines of a serial log to those of a plain table.

    The notes list what was removed.

    Parameters
    ----------
    lines : list of str
        The file.
    names : sequence of str
        Columns asked for.
    path : str or path
        For messages.

    Returns
    -------
    lines : list of str
        As many; the first that is labeled in full becomes the header's line before it.
    notes : tuple of str

    Raises
    ------
    DataError
        If labels change from line to line.

    Examples
    --------
    >>> unwrapped(["12:00:01.250 -> u:1 y:2", "12:00:01.260 -> u:3 y:4"], ["u", "y"], "a.log")[0]
    ['u y', '1 2', '3 4']
    """
    notes: tuple[str, ...] = ()
    some = [line for line in lines[:_HEAD] if line.strip()]
    if some and 2 * sum(bool(_CLOCK.match(line)) for line in some) > len(some):
        lines = [_CLOCK.sub("", line, count=1) for line in lines]
        notes = ("the serial monitor's clock before '->' was not read",)
    head = enumerate(lines[:_HEAD])
    start = next((k for k, line in head if ":" in line and set(names) <= set(_LABEL.findall(line))), None)
    if start is None:
        return lines, notes
    labels = _LABEL.findall(lines[start])
    separator = re.search(r"[,;\t]", lines[start])
    joined = (separator[0] if separator else " ").join(labels)
    body = []
    for number, line in enumerate(lines[start:], start=start + 1):
        if line.strip() and _LABEL.findall(line) != labels:
            raise DataError(f"{path}, line {number} is not labeled {', '.join(labels)} like those before it")
        body.append(_LABEL.sub("", line))
    # the header takes the place of what stood before the first full line, so that lines keep their numbers
    return [*[""] * (start - 1), joined, *body], (*notes, "every value had its label before it")
