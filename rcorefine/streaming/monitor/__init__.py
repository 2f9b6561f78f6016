"""Streaming diagnosis: candidate effects, sequential test and alarm.

The alarm names the effect.
"""

from .monitor import Monitor
from .watching import Alarm, MonitorRow

__all__ = ["Alarm", "Monitor", "MonitorRow"]
