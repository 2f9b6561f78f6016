"""Conversion of a monitor to a tree of file contents, and back.

A tree is checked against a fresh monitor of the same settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from ...effects.several import as_effects
from ...engine.engine import MOST_SUBSTEPS
from ...engine.structure import Structure
from ...exceptions import DataError
from ...inference.autoregression import MAX_ORDER
from ..gaps import Block
from ..persistence import storable
from ..restoring import check_like, check_range, parts_of
from .adequacy import Adequacy
from .alarm import Alarm, MonitorRow
from .bank import Bank
from .baseline import Healthy
from .forces import CODES
from .kernels import ALONE
from .observer import Observer
from .sequential_test import Watch
from .stream import Stream, Windows
from .watching import ROWS, Course

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
    """Return the monitor that `content` was taken from.

    Every part is checked against that of a fresh monitor.
    """
    if content.get("layout") != _LAYOUT:
        raise DataError(
            "this monitor was saved by another version of rcorefine (one without number: before 0.2), which "
            "learned other parameters: build it again and let it learn, or load it with that version"
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
        check_like(learned["theta"], np.zeros(structure.n_parameters), "parameters of the model")
        healthy = parts["healthy"]
        observer = Observer(
            structure, learned["theta"], monitor.dt, monitor.hold, monitor._substeps, healthy.gain
        )
        stream = Stream(observer, healthy, parts["bank"], parts["windows"], monitor.learn)
        check_memory(parts["memory"], stream, monitor._count)
        stream.memory = {key: np.array(value) for key, value in parts["memory"].items()}
        monitor._stream = stream
    return monitor


_NAN, _INF = float("nan"), float("inf")
_BLOCK = dict.fromkeys(("inputs", "outputs", "known", "use"), "samples")
_ALARM = {
    "sample": 0, "time": 0.0, "crossed": 0.0, "since_sample": 0, "since": 0.0, "probability": _NAN,
    "statistic": 0.0, "threshold": 0.0, "false_alarms": 0.0, "sentence": "",
}  # fmt: skip
_ROW = {"probability": 0.0, "log_likelihood": _NAN, "fitted": False}
_WATCH = {
    "confirmed": False, "crossed": 0, "misfit": _INF, "place": "", "next_naming": 0, "next_follow": 0,
    "value": _NAN, "std": _NAN,
}  # fmt: skip
_CODES = frozenset([0, *CODES.values()])  # 0 for the force of a law
_TINY = np.finfo(float).tiny
_RANGES = {
    "size": (_TINY, _INF), "factor": (_TINY, _INF), "V": (0.0, _INF), "spread": (0.0, _INF),
    "known": (0.0, _INF), "crowd": (0.0, _INF), "ring_use": (0, ALONE),
    "power": (0.0, _INF), "doubt": (0.0, _INF), "ring_scale": (_TINY, _INF),
}  # fmt: skip


def check_monitor(monitor: Monitor, content: Mapping[str, Any]) -> None:
    """Check all but the memory of the stream.

    Raises
    ------
    DataError
        If a monitor with these settings cannot have left it.
    """
    s = monitor._structure
    count = content["count"]
    check_like(monitor._theta, np.zeros(s.n_parameters), "coefficients of the model")
    check_like(count, 0, "count")
    check_like(content["latest"], np.zeros(s.n_inputs), "latest")
    flags = np.zeros((0, s.n_outputs), dtype=np.uint8)
    block = Block(np.zeros((0, s.n_inputs)), np.zeros((0, s.n_outputs)), np.zeros(0, dtype=np.uint8), flags)
    for part in content["waiting"]:
        check_like(part, block, "waiting", _BLOCK)
    waiting = sum(len(part.inputs) for part in content["waiting"])
    learning = content["stream"] is None
    check_range(waiting, count if learning else 0, count if learning else 0, "samples that wait")
    check_range(count, 0 if learning else monitor.learn, monitor.learn - 1 if learning else _INF, "count")
    _check_course(content["course"], len(monitor.candidates) + 4, count)
    _check_watch(parts_of(content["watch"]), monitor)
    for remark in content["remarks"]:
        check_like(remark, "", "remarks")
    if monitor._covariance is not None:
        check_like(monitor._covariance, np.full((s.n_parameters,) * 2, _NAN), "covariance")
    if content["adequacy"] is not None:
        _check_adequacy(parts_of(content["adequacy"]), monitor)
    if not learning:
        _check_parts(content["stream"], monitor)


def check_memory(found: Any, stream: Stream, count: int) -> None:
    """Check the memory of the stream against that of a stream that begins.

    Raises
    ------
    DataError
        If this stream cannot have left it.
    """
    check_like(found, stream.memory, "memory", {"w": "rows"})
    check_range(len(found["w"]), 0, stream.observer.lag, "rows of memory.w")
    for name, (low, high) in _RANGES.items():
        check_range(found[name], low, high, f"memory.{name}")
    check_range(found["counters"], [count, 0], [count, count], "memory.counters")
    check_range(found["pause"], 0, _INF, "memory.pause")
    check_range(found["lost"], -1, count, "memory.lost")


def _check_course(found: Any, width: int, count: int) -> None:
    fresh = {"stride": 1, "rows": np.full((1, width), np.nan), "samples": np.zeros(1, dtype=np.int64)}
    check_like(found, fresh, "course", {"rows": "rows", "samples": "rows"})
    check_range(found["stride"], 1, _INF, "course.stride")
    check_range(len(found["rows"]), 0, ROWS, "rows of the course")
    check_range(found["samples"], 0, count, "course.samples")


def _check_watch(found: Any, monitor: Monitor) -> None:
    fresh = monitor._watch
    for name in ("period", "dt", "false_alarms", "patience", "room"):
        wanted = getattr(fresh, name)
        if found[name] != wanted:
            raise DataError(f"watch.{name} is {found[name]!r} and must be {wanted!r}: the file is damaged")
    check_like({name: found[name] for name in _WATCH}, _WATCH, "watch")
    ny = monitor._structure.n_outputs
    check_like(found["mean"], np.zeros(ny if len(found["mean"]) else 0), "watch.mean")
    if found["gains"] is not None:
        check_like(found["gains"], np.full(len(monitor.candidates), -np.inf), "watch.gains")
    alarms = [parts_of(alarm) for alarm in (found["found"], *found["past"]) if alarm is not None]
    rows = [parts_of(row) for row in found["rows"]]
    for alarm in alarms:
        check_like({name: alarm[name] for name in _ALARM}, _ALARM, "alarm")
        if alarm["ended"] is not None:
            check_like(alarm["ended"], 0.0, "alarm.ended")
    for row in rows:
        check_like({name: row[name] for name in _ROW}, _ROW, "ranking")
    for part in (*alarms, *rows):
        if part["effect"] not in monitor.candidates:
            raise DataError(f"{part['effect']!r:.80} is none of the candidates: the file is damaged")
        own = [name for name in part["coefficients"] if name in part["effect"].coefficients]
        for name in ("coefficients", "std"):
            check_like(part[name], dict.fromkeys(own, _NAN), name)


def _check_adequacy(found: Any, monitor: Monitor) -> None:
    fits = (_NAN,) * monitor._structure.n_outputs
    fresh = {"fit": fits, "fit_moved": fits, "score": _NAN, "adequate": True, "sentence": ""}
    check_like({name: found[name] for name in fresh}, fresh, "adequacy")
    check_like(found["moved"], dict.fromkeys(found["moved"], _NAN), "adequacy.moved")
    if found["missing"] is not None and found["missing"] not in monitor.candidates:
        raise DataError("adequacy.missing is none of the candidates: the file is damaged")


def _check_parts(found: Any, monitor: Monitor) -> None:
    """Check the learned parts: observer, noise, columns and windows."""
    s = monitor._structure
    n, ny, nw = s.n_states, s.n_outputs, s.n_inputs
    healthy, bank = parts_of(found["healthy"]), parts_of(found["bank"])
    q, k = np.shape(healthy["filters"])[-1], len(bank["owner"])
    check_range(q, 0, MAX_ORDER, "orders of the noise")
    check_like(
        healthy,
        {
            "ratio": 0.0, "gain": np.zeros((n, ny)), "x0": np.zeros(n), "filters": np.zeros((ny, q)),
            "mix": np.zeros((ny, ny)), "settle": 1, "orders": (0,) * ny, "mean": np.zeros(ny),
            "noise": np.zeros((ny, 3)), "least": np.zeros(ny), "pace": 1.0, "power": np.zeros(ny),
        },
        "healthy",
    )  # fmt: skip
    check_range(healthy["noise"], 0.0, _INF, "healthy.noise")
    check_range(healthy["least"], _TINY, _INF, "healthy.least")
    check_range(healthy["pace"], 0.0, 1.0, "healthy.pace")
    integers = np.zeros(k, dtype=np.int64)
    effects, watched = bank.pop("effects"), len(monitor.candidates)
    if as_effects(effects, "bank.effects")[:watched] != [*monitor.candidates]:
        raise DataError("bank.effects are not the candidates: the file is damaged")
    p = len(bank["numbers"])
    check_like(
        bank,
        {
            "owner": integers, "rows": np.zeros((2, k, n + nw)), "codes": integers,
            "values": np.zeros((k, 4)), "widths": np.zeros(k), "pick": integers,
            "drive": np.zeros((2, n, k)), "through": np.zeros((ny, k)), "names": ("",) * k,
            "Phi": np.zeros((n, n)), "C": np.zeros((ny, n)), "scale": np.zeros(k),
            "watched": 1, "numbers": np.zeros(p, dtype=np.int64), "root": np.zeros((p, p)),
        },
        "bank",
    )  # fmt: skip
    check_range(bank["pick"], 0, 3, "bank.pick")
    owner = bank["owner"].tolist()
    if set(owner) != set(range(len(effects))) or set(owner[: bank["watched"]]) != set(range(watched)):
        raise DataError("bank.owner does not name each candidate: the file is damaged")
    check_range(bank["watched"], 1, k, "bank.watched")
    check_range(bank["numbers"], 0, k - 1, "bank.numbers")
    for code in bank["codes"].tolist():
        if code not in _CODES:
            raise DataError(f"bank.codes holds {code}, the code of no law: the file is damaged")
    windows = parts_of(found["windows"])
    M = monitor._lengths.size
    fresh = {"keep": np.zeros(M), "levels": np.zeros(M), "block": 1, "blocks": 1, "fading": 0.0}
    check_like(windows, fresh, "windows")
    check_range(windows["keep"], _TINY, 1.0 - 1e-12, "windows.keep")
    check_range(windows["levels"], _TINY, _INF, "windows.levels")
    check_range(windows["fading"], 0.0, 1.0, "windows.fading")
    check_range(windows["block"], monitor._block, monitor._block, "windows.block")
    room = monitor._watch.room // monitor._block
    check_range(windows["blocks"], room, room, "windows.blocks")
