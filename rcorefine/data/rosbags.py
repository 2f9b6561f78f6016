"""Signals of ROS bags (ROS 1, ROS 2, MCAP).

Each topic has messages, fields and a clock of its own.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..exceptions import DataError
from ..extras import needed
from ..systems.linear import Array
from .apart import damaged

__all__ = ["read_rosbag"]

_PART = re.compile(r"(\w+)(?:\[([^\]]+)\])?")


def read_rosbag(
    path: Any, names: Sequence[str], by_header: bool
) -> tuple[dict[str, tuple[Array, Array]], tuple[str, ...]]:
    """Read times and values of signals of a ROS bag.

    A signal is named "/topic/field/part[2]".

    Parameters
    ----------
    path : str or path
        File or folder.
    names : sequence of str
        Signals.
    by_header : bool
        Whether messages count at the time that they bear, or at that of the recorder.

    Returns
    -------
    signals : dict of tuple
        Times in s from the beginning of the bag, and values, both of shape (N,).
    said : tuple of str
        Which topics bear no time.

    Raises
    ------
    DataError
        No such topic or field, or no bag.
    """
    needed("rosbags", "formats", "from_rosbag")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not Path(path).is_dir():
        with open(path, "rb"):  # whether it is there is the system's message
            pass
    with damaged(path, "is no ROS bag that rosbags can read, or it is damaged"):
        with AnyReader([Path(path)], default_typestore=get_typestore(Stores.LATEST)) as bag:
            wanted = _by_topic(path, names, {c.topic: c.msgtype for c in bag.connections})
            found: dict[str, tuple[Array, Array]] = {}
            logged = []
            for topic, fields in wanted.items():
                chosen = bag.messages(connections=[c for c in bag.connections if c.topic == topic])
                messages = ((stamp, bag.deserialize(raw, c.msgtype)) for c, stamp, raw in chosen)
                times, columns, own = _signals(path, fields, messages, by_header)
                found |= {name: ((times - bag.start_time) / 1e9, column) for name, column in columns.items()}
                logged += [] if own or not by_header else [topic]
    said = f"{', '.join(logged)}: messages bear no time of their own and count when they were recorded"
    return found, (said,) if logged else ()


def _by_topic(path: Any, names: Sequence[str], topics: dict[str, str]) -> dict[str, dict[str, str]]:
    """Fields by topic and name: the longest topic that a name begins with."""
    found: dict[str, dict[str, str]] = {}
    for name in names:
        held = [t for t in topics if name.startswith((f"{t}/", f"{t}."))]
        if not held:
            listed = ", ".join(f"{t} ({kind})" for t, kind in sorted(topics.items())) or "none"
            raise DataError(
                f"{path} has no topic of {name!r}; name a signal as TOPIC/FIELD. Topics: {listed}"
            )
        topic = max(held, key=len)
        found.setdefault(topic, {})[name] = name[len(topic) + 1 :].replace("/", ".")
    return found


def _signals(
    path: Any, fields: dict[str, str], messages: Iterator[tuple[int, Any]], by_header: bool
) -> tuple[Array, dict[str, Array], bool]:
    """Read times in ns and values of one topic.

    The flag is True if all messages of the topic contain their time.
    """
    stamps: list[tuple[int, int | None]] = []
    columns: dict[str, list[float]] = {name: [] for name in fields}
    for count, (logged, message) in enumerate(messages):
        own = getattr(getattr(message, "header", None), "stamp", None)
        stamps.append((logged, None if own is None else own.sec * 10**9 + own.nanosec))
        for name, field in fields.items():
            columns[name].append(_value(path, message, name, field, count))
    borne = bool(stamps) and all(own for _, own in stamps)  # a stamp of 0 was never filled in
    # whole numbers, of which floats would lose the last digits
    times: Any = np.array([own if by_header and borne else logged for logged, own in stamps], dtype=np.int64)
    return times, {name: np.array(column) for name, column in columns.items()}, borne


def _value(path: Any, message: Any, name: str, field: str, count: int) -> float:
    """Return one value of a message.

    An entry is given by its index, or by its name in the list `name` of the same message.
    """
    value: Any = message
    where = f"{path}: message {count} of {name!r}"
    for part in field.split("."):
        match, owner = _PART.fullmatch(part), value
        known = [k for k in getattr(owner, "__dataclass_fields__", {}) if not k.startswith("_")]
        if match is None or match[1] not in known:
            raise DataError(f"{where} has no field {part!r}; there are: {', '.join(known) or 'none'}")
        value, key = getattr(owner, match[1]), match[2]
        if key is None:
            continue
        labels = [str(label) for label in getattr(owner, "name", [])]
        index = labels.index(key) if key in labels else int(key) if key.isdecimal() else -1
        if not 0 <= index < np.size(value):
            raise DataError(
                f"{where} has no entry {key!r} in {match[1]!r}; it has {np.size(value)}"
                + (f": {', '.join(labels)}" if labels else "")
            )
        value = value[index]
    if isinstance(value, bool | int | float | np.number | np.bool_):
        return float(value)
    if np.size(value) == 1 and np.asarray(value).dtype.kind in "fiub":
        return float(np.asarray(value).ravel()[0])
    raise DataError(f"{where} is {type(value).__name__}, no number; name a part of it (x, [0], ...)")
