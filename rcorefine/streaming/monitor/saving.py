"""A monitor as a tree of plain arrays, and back."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ...engine.structure import Structure
from ..gaps import Block
from .alarm import Alarm, MonitorRow
from .bank import Bank
from .baseline import Healthy
from .checking import check_memory, check_monitor
from .course import Course
from .observer import Observer
from .sequential_test import Watch
from .stream import Stream, Windows

if TYPE_CHECKING:
    from .monitor import Monitor

__all__ = ["content_of", "restored"]

_SETTINGS = (
    "dt", "false_alarms", "learn", "disturbance", "hold", "missing", "windows", "patience", "candidates",
)  # fmt: skip


class _Base:
    """Model with effects at their coefficients, as `as_base` takes it."""

    def __init__(self, content: dict[str, Any]) -> None:
        constants = {int(key): float(value) for key, value in content["constants"].items()}
        self.physical_model = content["physical"]
        self._parts = content["physical"], tuple(content["effects"]), constants
        self._theta, self._substeps = content["theta"], int(content["substeps"])

    def simulation_structure(self) -> tuple[Structure, Any, int]:
        physical, effects, constants = self._parts
        return Structure(physical, effects, constants=constants), self._theta, self._substeps


def _shallow(value: Any) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in fields(value)}


def content_of(monitor: Monitor) -> dict[str, Any]:
    """All of a monitor."""
    s = monitor._structure
    watch = _shallow(monitor._watch)
    watch["found"] = None if watch["found"] is None else _shallow(watch["found"])
    watch["past"] = [_shallow(alarm) for alarm in watch["past"]]
    watch["rows"] = [_shallow(row) for row in watch["rows"]]
    stream = monitor._stream
    return {
        "what": "monitor",
        "base": {
            "physical": s.model,
            "effects": s.effects,
            "constants": s.constants,
            "theta": monitor._theta,
            "substeps": monitor._substeps,
        },
        "settings": {name: getattr(monitor, name) for name in _SETTINGS},
        "count": monitor._count,
        "latest": monitor._latest,
        "remarks": monitor.remarks,
        "waiting": [block._asdict() for block in monitor._waiting],
        "watch": watch,
        "course": monitor._course.content(),
        "stream": None
        if stream is None
        else {
            "healthy": _shallow(stream.healthy),
            "bank": _shallow(stream.bank),
            "windows": asdict(stream.windows),
            "memory": {key: value.copy() for key, value in stream.memory.items()},
        },
    }


def restored(cls: type[Monitor], content: Any) -> Monitor:
    """The monitor that `content` was taken from, every part held against what a fresh one would be."""
    settings = dict(content["settings"])
    monitor = cls(_Base(content["base"]), settings.pop("candidates"), **settings)
    check_monitor(monitor, content)
    monitor._count, monitor._latest = content["count"], content["latest"]
    monitor._waiting = [Block(**block) for block in content["waiting"]]
    monitor.remarks = tuple(content["remarks"])
    watch = dict(content["watch"])
    watch["found"] = None if watch["found"] is None else Alarm(**watch["found"])
    watch["past"] = [Alarm(**alarm) for alarm in watch["past"]]
    watch["rows"] = [MonitorRow(**row) for row in watch["rows"]]
    monitor._watch = Watch(**watch)
    monitor._course = Course.restored(content["course"])
    if content["stream"] is not None:
        parts = content["stream"]
        healthy, bank = Healthy(**parts["healthy"]), Bank(**parts["bank"])
        windows = Windows(**parts["windows"])
        observer = Observer(
            monitor._structure, monitor._theta, monitor.dt, monitor.hold, monitor._substeps, healthy.gain
        )
        stream = Stream(observer, healthy, bank, windows, monitor.learn)
        check_memory(parts["memory"], stream, monitor._count)
        stream.memory = {key: np.array(value) for key, value in parts["memory"].items()}
        monitor._stream = stream
    return monitor
