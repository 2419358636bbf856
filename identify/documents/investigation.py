"""The document ``investigation.json``."""

from typing import Literal

from pydantic import Field

from armident.identify.documents.base import Document, RecordingReference, SignedDocument
from armident.identify.documents.diagnosis import Explanation

Outcome = Literal["running", "healthy", "named", "set_up", "unnamed", "cannot_tell"]

OUTCOMES: dict[Outcome, str] = {
    "running": "The investigation has not ended: it waits for the recording of its last motion.",
    "healthy": "Nothing is missing that these motions could show.",
    "named": "The missing effects have names, and every joint is decided.",
    "set_up": "The recordings contradict the configuration: correct it first.",
    "unnamed": "Something is missing that no effect of the catalogue explains.",
    "cannot_tell": "Several explanations are left that no further motion could tell apart.",
}
"""Meaning of each outcome."""


class MotionChoice(Document):
    """A motion that was considered.

    Parameters
    ----------
    motion
        Name of the family of motions.
    words
        The motion in words.
    joint
        Name of the joint that it moves; null for all.
    other
        Name of a second joint that moves.
    size
        Amplitude over the usable range of the joint.
    duration_s
        Duration, s.
    expected_gain
        Expected fall of the entropy of the explanations, nats; null for a motion that no question chose.
    excluded
        Limit for which it was not allowed; null if it was.
    """

    motion: str
    words: str
    joint: str | None = None
    other: str | None = None
    size: float | None = None
    duration_s: float
    expected_gain: float | None = None
    excluded: str | None = None


class InvestigationRound(Document):
    """One question to the arm, and its answer.

    Parameters
    ----------
    explanations
        Possible causes at each joint before the motion.
    question
        The question in words.
    considered
        The best motions, the one with the largest expected gain per second first.
    chosen
        The motion that was asked for.
    trajectory
        Trajectory file in the folder of the investigation; null without a folder.
    recording
        The answer; null before it arrives or if the motion was refused.
    refused
        Reason for which the robot did not move.
    """

    explanations: list[Explanation]
    question: str
    considered: list[MotionChoice]
    chosen: MotionChoice
    trajectory: str | None = None
    recording: RecordingReference | None = None
    refused: str | None = None


class InvestigationDocument(SignedDocument):
    """``investigation.json``: questions to an arm, its answers, and what they say about the missing effects.

    Parameters
    ----------
    recordings
        Recordings from before the first motion.
    experiments
        Most motions.
    minutes
        Longest motion of all rounds together, min.
    rounds
        Questions and answers, the oldest first.
    motion_s
        Duration of the motions so far, s.
    outcome
        Result in one word.
    statement
        Result in one sentence, with the next step.
    explanations
        Possible causes at each joint after the last recording.
    model
        Robot configuration with what was found; null if it was not written.
    """

    schema_: Literal["armident/investigation/1"] = Field("armident/investigation/1", alias="schema")
    robot: str
    recordings: list[RecordingReference]
    experiments: int
    minutes: float
    rounds: list[InvestigationRound] = Field(default_factory=list)
    motion_s: float = 0.0
    outcome: Outcome = "running"
    statement: str = ""
    explanations: list[Explanation] = Field(default_factory=list)
    model: str | None = None
    versions: dict[str, str]
