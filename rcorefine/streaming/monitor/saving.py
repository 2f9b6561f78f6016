"""Conversion of a monitor to a tree of file contents, and back.

A tree is checked against a fresh monitor of the same settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...effects.effect import as_effects
from ...engine.engine import MOST_SUBSTEPS
from ...engine.structure import Structure
from ...exceptions import DataError
from ...inference.whitening import MAX_ORDER
from ..persistence import check_like, check_range, check_schema, storable
from ..samples import Block
from .bank import Bank
from .baseline import TINY, Healthy
from .kernels import ALONE, CODES
from .learning import Adequacy, stream_of
from .stream import Stream, Windows
from .watching import ROWS, Alarm, Course, MonitorRow, Watch

if TYPE_CHECKING:
    from .monitor import Monitor


_SETTINGS = (
    "dt", "false_alarms", "learn", "disturbance", "hold", "missing", "windows", "patience", "tolerance",
    "candidates",
)  # fmt: skip
_FIXED = ("period", "dt", "false_alarms", "patience", "room")  # of the watch, by the settings
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
    # settings, then what was learned, then what runs with the samples
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
            "memory": {key: value.copy() for key, value in stream.memory.items()},
        },
    }


def restored(cls: type[Monitor], content: Any) -> Monitor:
    """Return the monitor that `content` was taken from.

    Every part is checked against that of a fresh monitor.
    """
    # a file of another layout holds other parameters
    if content.get("layout") != _LAYOUT:
        raise DataError(
            "this monitor was saved by another version of rcorefine (one without number: before 0.2), which "
            "learned other parameters: build it again and let it learn, or load it with that version"
        )
    # a fresh monitor of the same settings; substeps set the size of loops, so check them first
    settings, base = dict(content["settings"]), content["base"]
    check_like(base["substeps"], 1, "substeps of the model")
    check_range(base["substeps"], 1, MOST_SUBSTEPS, "substeps of the model")
    monitor = cls(_Base(base), settings.pop("candidates"), **settings)
    check_monitor(monitor, content)
    # counts, samples that wait, remarks
    monitor._count, monitor._latest = content["count"], content["latest"]
    monitor._waiting = list(content["waiting"])
    monitor.remarks = tuple(content["remarks"])
    monitor.adequacy = content["adequacy"]
    # the watch keeps what the settings determine
    kept = {name: getattr(monitor._watch, name) for name in _FIXED}
    monitor._watch = replace(content["watch"], **kept)
    monitor._course = Course.restored(content["course"])
    # learned parts: model with its parameters, noise, columns, and the memory of the loop
    if content["stream"] is not None:
        parts, fixed = content["stream"], monitor._structure
        structure = Structure(fixed.model, tuple(parts["numbers"]["effects"]), constants=fixed.constants)
        theta = parts["numbers"]["theta"]
        check_like(theta, np.zeros(structure.n_parameters), "parameters of the model")
        stream = stream_of(monitor, structure, theta, parts["healthy"], parts["bank"])
        check_memory(parts["memory"], stream, monitor._count)
        stream.memory = {key: np.array(value) for key, value in parts["memory"].items()}
        monitor._stream = stream
    return monitor


_NAN, _INF = float("nan"), float("inf")
_BLOCK = dict.fromkeys(("inputs", "outputs", "known", "use"), "samples")
_CODES = frozenset([0, *CODES.values()])  # 0 for the force of a law
_RANGES = {
    "size": (TINY, _INF), "factor": (TINY, _INF), "V": (0.0, _INF), "spread": (0.0, _INF),
    "known": (0.0, _INF), "crowd": (0.0, _INF), "ring_use": (0, ALONE),
    "power": (0.0, _INF), "doubt": (0.0, _INF), "ring_scale": (TINY, _INF),
}  # fmt: skip


def check_monitor(monitor: Monitor, content: Mapping[str, Any]) -> None:
    """Check all but the memory of the stream.

    Raises
    ------
    DataError
        If a monitor with these settings cannot have left it.
    """
    # counts, last inputs and waiting samples fit the model
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
    # during the learning phase samples wait; afterwards none do
    learning = content["stream"] is None
    check_range(waiting, count if learning else 0, count if learning else 0, "samples that wait")
    check_range(count, 0 if learning else monitor.learn, monitor.learn - 1 if learning else _INF, "count")
    # history and alarm have the width of the candidates
    _check_course(content["course"], len(monitor.candidates) + 4, count)
    _check_watch(content["watch"], monitor)
    for remark in content["remarks"]:
        check_like(remark, "", "remarks")
    if monitor._covariance is not None:
        check_like(monitor._covariance, np.full((s.n_parameters,) * 2, _NAN), "covariance")
    if not isinstance(content["adequacy"], Adequacy | None):
        raise DataError("adequacy is none: the file is damaged")
    if not learning:
        _check_parts(content["stream"], monitor)


def check_memory(found: Any, stream: Stream, count: int) -> None:
    """Check the memory of the stream against that of a stream that begins.

    Raises
    ------
    DataError
        If this stream cannot have left it.
    """
    # shapes and types of a stream that begins
    check_like(found, stream.memory, "memory", {"w": "rows"})
    check_range(len(found["w"]), 0, stream.observer.lag, "rows of memory.w")
    # values within their range: variances positive, counts not negative
    for name, (low, high) in _RANGES.items():
        check_range(found[name], low, high, f"memory.{name}")
    check_range(found["counters"], [count, 0], [count, count], "memory.counters")
    check_range(found["pause"], 0, _INF, "memory.pause")
    check_range(found["lost"], -1, count, "memory.lost")


def _check_course(found: Any, width: int, count: int) -> None:
    # rows of the history: any number, one width
    fresh = {"stride": 1, "rows": np.full((1, width), np.nan), "samples": np.zeros(1, dtype=np.int64)}
    check_like(found, fresh, "course", {"rows": "rows", "samples": "rows"})
    check_range(found["stride"], 1, _INF, "course.stride")
    check_range(len(found["rows"]), 0, ROWS, "rows of the course")
    check_range(found["samples"], 0, count, "course.samples")


def _check_watch(found: Any, monitor: Monitor) -> None:
    """Check the alarm and the ranking.

    The types of their fields were checked on reading.
    """
    # alarm and ranking name candidates of this monitor and their coefficients
    ny = monitor._structure.n_outputs
    check_like(found.mean, np.zeros(ny if len(found.mean) else 0), "watch.mean")
    if found.gains is not None:
        check_like(found.gains, np.full(len(monitor.candidates), -np.inf), "watch.gains")
    parts: list[tuple[Any, type]] = [(row, MonitorRow) for row in found.rows]
    parts += [(alarm, Alarm) for alarm in (found.found, *found.past) if alarm is not None]
    for part, kind in parts:
        sound = type(part) is kind
        if not sound or part.effect not in monitor.candidates:
            raise DataError(f"{part!r:.80} is of none of the candidates: the file is damaged")
        own = [name for name in part.coefficients if name in part.effect.coefficients]
        for name in ("coefficients", "std"):
            check_like(getattr(part, name), dict.fromkeys(own, _NAN), name)


def _check_parts(found: Any, monitor: Monitor) -> None:
    """Check the learned parts: observer, noise and columns."""
    s, healthy, bank = monitor._structure, found["healthy"], found["bank"]
    # shapes from the model; the number of columns and the order of the noise from the file
    sizes = {"n": s.n_states, "ny": s.n_outputs, "sensed": s.n_states + s.n_inputs}
    check_schema(healthy, Healthy, sizes, "healthy")
    check_range(sizes["q"], 0, MAX_ORDER, "orders of the noise")
    check_like(healthy.orders, (0,) * s.n_outputs, "healthy.orders")
    check_schema(bank, Bank, sizes, "bank")
    # first the candidates in their order, then the effects of uncertain parameters
    watched = len(monitor.candidates)
    if as_effects(bank.effects, "bank.effects")[:watched] != [*monitor.candidates]:
        raise DataError("bank.effects are not the candidates: the file is damaged")
    check_range(bank.watched, 1, sizes["k"], "bank.watched")
    check_range(bank.numbers, 0, sizes["k"] - 1, "bank.numbers")
    # each column has an owner, and each effect a column
    owner = bank.owner.tolist()
    if (
        set(owner) != set(range(len(bank.effects)))
        or set(owner[: bank.watched]) != set(range(watched))
        or len(bank.names) != len(owner)
        or not _CODES.issuperset(bank.codes.tolist())
    ):
        raise DataError("bank.owner, names and codes do not name each candidate: the file is damaged")
