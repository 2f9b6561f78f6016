"""Streaming diagnosis: candidate effects, sequential test and alarm.

The alarm names the effect.
"""

from .alarm import Alarm, MonitorRow
from .monitor import Monitor

__all__ = ["Alarm", "Monitor", "MonitorRow"]
