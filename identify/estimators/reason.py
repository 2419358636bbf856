"""Reasons for which a result is doubtful or unusable."""

from dataclasses import dataclass
from typing import Literal

Level = Literal["trustworthy", "doubtful", "unusable"]
LEVELS: tuple[Level, ...] = ("trustworthy", "doubtful", "unusable")

Kind = Literal[
    "setup", "error", "physics", "excitation", "convergence", "loop", "residual", "uncertainty", "instruments", "delay"
]

DIAGNOSE = "armident diagnose RECORDING"


@dataclass(frozen=True)
class Reason:
    """One defect of a result: level of its verdict, a sentence with figures, and the action that removes it.

    ``joint``: ``None`` for several, or none in particular. ``kind``: property that was judged.
    """

    level: Level
    message: str
    next_step: str
    joint: str | None = None
    kind: Kind = "error"
