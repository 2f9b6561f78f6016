"""Streaming diagnosis: a bank of candidates, a sequential test, an alarm with a name."""

from .monitor import Monitor
from .report import Alarm, MonitorRow

__all__ = ["Alarm", "Monitor", "MonitorRow"]
