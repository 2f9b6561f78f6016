"""A monitor as a tree of what files hold, and back."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from ...engine.engine import MOST_SUBSTEPS
from ...engine.structure import Structure
from ...exceptions import DataError
from ..gaps import Block
from ..persistence import storable
from ..restoring import check_like, check_range
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
_LAYOUT = 3  # of the content; raised when what a monitor learned changes its form
storable(Adequacy, Alarm, Bank, Block, Healthy, MonitorRow, Watch, Windows)


class _Base:
    """Model with effects at their coefficients, as `as_base` takes it."""

    def __init__(self, content: dict[str, Any]) -> None:
        constants = {int(key): float(value) for key, value in content["constants"].items()}
        self.physical_model = content["physical"]
        self._parts = content["physical"], tuple(content["effects"]), constants
        self._theta, self._substeps = content["theta"], int(content["substeps"])
        self.covariance = content["covariance"]

    def simulation_structure(self) -> tuple[Structure, Any, int]:
        physical, effects, constants = self._parts
        return Structure(physical, effects, constants=constants), self._theta, self._substeps


def content_of(monitor: Monitor) -> dict[str, Any]:
    """All of a monitor."""
    s = monitor._structure
    stream = monitor._stream
    return {
        "what": "monitor",
        "layout": _LAYOUT,
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
        "adequacy": monitor.adequacy,
        "waiting": list(monitor._waiting),
        "watch": copy(monitor._watch),
        "course": monitor._course.content(),
        "stream": None
        if stream is None
        else {
            "numbers": {"effects": stream.observer.structure.effects, "theta": stream.observer.theta},
            "healthy": stream.healthy,
            "bank": stream.bank,
            "windows": stream.windows,
            "memory": {key: value.copy() for key, value in stream.memory.items()},
        },
    }


def restored(cls: type[Monitor], content: Any) -> Monitor:
    """The monitor that `content` was taken from, every part held against what a fresh one would be."""
    if content.get("layout") != _LAYOUT:
        raise DataError(
            "this monitor was saved by another version of rcorefine (one without number: before 0.2), which "
            "learned other numbers: make it anew and let it learn, or load it with that version"
        )
    settings, base = dict(content["settings"]), content["base"]
    check_like(base["substeps"], 1, "substeps of the model")
    check_range(base["substeps"], 1, MOST_SUBSTEPS, "substeps of the model")
    monitor = cls(_Base(base), settings.pop("candidates"), **settings)
    check_monitor(monitor, content)
    monitor._count, monitor._latest = content["count"], content["latest"]
    monitor._waiting = list(content["waiting"])
    monitor.remarks = tuple(content["remarks"])
    monitor.adequacy = content["adequacy"]
    monitor._watch = copy(content["watch"])
    monitor._course = Course.restored(content["course"])
    if content["stream"] is not None:
        parts = content["stream"]
        learned = parts["numbers"]
        structure = Structure(
            base["physical"], tuple(learned["effects"]), constants=monitor._structure.constants
        )
        check_like(learned["theta"], np.zeros(structure.n_parameters), "numbers of the model")
        healthy = parts["healthy"]
        observer = Observer(
            structure, learned["theta"], monitor.dt, monitor.hold, monitor._substeps, healthy.gain
        )
        stream = Stream(observer, healthy, parts["bank"], parts["windows"], monitor.learn)
        check_memory(parts["memory"], stream, monitor._count)
        stream.memory = {key: np.array(value) for key, value in parts["memory"].items()}
        monitor._stream = stream
    return monitor
