"""A monitor as a tree of plain arrays, and back."""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ...engine.structure import Structure
from ..gaps import Block
from ..restoring import check_like
from .adequacy import Adequacy
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
    "dt", "false_alarms", "learn", "disturbance", "hold", "missing", "windows", "patience", "tolerance",
    "candidates",
)  # fmt: skip


class _Base:
    """Model with effects at their coefficients, as `as_base` takes it."""

    def __init__(self, content: dict[str, Any]) -> None:
        constants = {int(key): float(value) for key, value in content["constants"].items()}
        self.physical_model = content["physical"]
        self._parts = content["physical"], tuple(content["effects"]), constants
        self._theta, self._substeps = content["theta"], int(content["substeps"])
        self.covariance = content.get("covariance")

    def simulation_structure(self) -> tuple[Structure, Any, int]:
        physical, effects, constants = self._parts
        return Structure(physical, effects, constants=constants), self._theta, self._substeps


def _shallow(value: Any) -> dict[str, Any]:
    return {field.name: getattr(value, field.name) for field in fields(value)}


def _of_today(parts: dict[str, Any], base: dict[str, Any]) -> dict[str, Any]:
    """What a monitor learned, in today's parts: earlier versions knew no doubt of the model's numbers."""
    if "numbers" in parts:
        return parts
    n_outputs, k, M = (
        len(parts["healthy"]["mean"]),
        len(parts["bank"]["owner"]),
        len(parts["windows"]["keep"]),
    )
    noise, ones, old = np.eye(1, 3).repeat(n_outputs, 0), np.ones(n_outputs), parts["memory"]
    memory = {
        "power": np.zeros(n_outputs), "cross": np.zeros((k, 0)), "shared": np.zeros((M, k, 0)),
        "doubt": np.zeros((M, k)), "ring_scale": np.ones_like(old["ring_y"]),
    }  # fmt: skip
    healthy = {"noise": noise, "least": ones, "pace": 1.0, "power": np.zeros(n_outputs)}
    bank = {"watched": k, "numbers": np.zeros(0, dtype=np.int64), "root": np.zeros((0, 0))}
    return {
        "numbers": {"effects": base["effects"], "theta": base["theta"]},
        "healthy": parts["healthy"] | healthy,
        "bank": parts["bank"] | bank,
        "windows": parts["windows"],
        "memory": old | memory,
    }


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
            "covariance": monitor._covariance,
            "substeps": monitor._substeps,
        },
        "settings": {name: getattr(monitor, name) for name in _SETTINGS},
        "count": monitor._count,
        "latest": monitor._latest,
        "remarks": monitor.remarks,
        "adequacy": None if monitor.adequacy is None else _shallow(monitor.adequacy),
        "waiting": [block._asdict() for block in monitor._waiting],
        "watch": watch,
        "course": monitor._course.content(),
        "stream": None
        if stream is None
        else {
            "numbers": {"effects": stream.observer.structure.effects, "theta": stream.observer.theta},
            "healthy": _shallow(stream.healthy),
            "bank": _shallow(stream.bank),
            "windows": asdict(stream.windows),
            "memory": {key: value.copy() for key, value in stream.memory.items()},
        },
    }


def restored(cls: type[Monitor], content: Any) -> Monitor:
    """The monitor that `content` was taken from, every part held against what a fresh one would be."""
    settings, base = dict(content["settings"]), content["base"]
    if content["stream"] is not None:
        content = content | {"stream": _of_today(content["stream"], base)}
    monitor = cls(_Base(base), settings.pop("candidates"), **settings)
    check_monitor(monitor, content)
    monitor._count, monitor._latest = content["count"], content["latest"]
    monitor._waiting = [Block(**block) for block in content["waiting"]]
    monitor.remarks = tuple(content["remarks"])
    said = content.get("adequacy")
    monitor.adequacy = None if said is None else Adequacy(**said)
    watch = dict(content["watch"])
    watch["found"] = None if watch["found"] is None else Alarm(**watch["found"])
    watch["past"] = [Alarm(**alarm) for alarm in watch["past"]]
    watch["rows"] = [MonitorRow(**row) for row in watch["rows"]]
    monitor._watch = Watch(**watch)
    monitor._course = Course.restored(content["course"])
    if content["stream"] is not None:
        parts = content["stream"]
        learned = parts["numbers"]
        structure = Structure(
            base["physical"], tuple(learned["effects"]), constants=monitor._structure.constants
        )
        check_like(learned["theta"], np.zeros(structure.n_parameters), "numbers of the model")
        healthy, bank = Healthy(**parts["healthy"]), Bank(**parts["bank"])
        windows = Windows(**parts["windows"])
        observer = Observer(
            structure, learned["theta"], monitor.dt, monitor.hold, monitor._substeps, healthy.gain
        )
        stream = Stream(observer, healthy, bank, windows, monitor.learn)
        check_memory(parts["memory"], stream, monitor._count)
        stream.memory = {key: np.array(value) for key, value in parts["memory"].items()}
        monitor._stream = stream
    return monitor
