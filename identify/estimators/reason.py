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
    """One defect of a result: verdict, message, remedy; ``joint``: ``None`` for several; ``kind``: property judged."""

    level: Level
    message: str
    next_step: str
    joint: str | None = None
    kind: Kind = "error"
