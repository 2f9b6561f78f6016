"""Streaming diagnosis: a bank of candidates, a sequential test, an alarm with a name."""

from .alarm import Alarm, MonitorRow
from .monitor import Monitor

__all__ = ["Alarm", "Monitor", "MonitorRow"]
