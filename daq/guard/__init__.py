"""The guard: a process that watches a moving arm on its bus, and stops the drives within one cycle."""

from daq.guard.limits import Limits, limits_of
from daq.guard.run import guard
from daq.guard.watch import Alarm, Watch

__all__ = ["Alarm", "Limits", "Watch", "guard", "limits_of"]
