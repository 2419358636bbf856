"""The document ``commissioning.json``."""

from typing import Literal

from pydantic import Field

from armident.identify.documents.base import Document, RecordingReference, SignedDocument

Outcome = Literal["running", "trusted", "set_up", "not_trusted", "stopped"]


class CommissioningMotion(Document):
    """A motion that was played.

    Parameters
    ----------
    stage
        Name of the stage that asked for it.
    words
        The motion in words.
    duration_s
        Duration, s.
    recording
        Its recording.
    """

    stage: str
    words: str
    duration_s: float
    recording: RecordingReference


class CommissioningDocument(SignedDocument):
    """``commissioning.json``: the stages of a new arm on the way to a trusted model.

    Parameters
    ----------
    outcome
        ``trusted``; ``set_up``: the recordings contradict the configuration; ``not_trusted``: something is missing;
        ``stopped``: a motion was refused or stopped; ``running``: not ended.
    next_step
        What to do next.
    stages
        Result of each stage in one sentence, by its name, in order; that of the last one says why it did not pass.
    motions
        Motions that were played, the first one first.
    verdict
        Verdict of the identification; null before it.
    held_out_error_pct_by_joint
        Error of the torques that the model predicts along a motion that it has not seen, percent of their norm.
    """

    schema_: Literal["armident/commissioning/1"] = Field("armident/commissioning/1", alias="schema")
    robot: str
    outcome: Outcome = "running"
    next_step: str = ""
    stages: dict[str, str] = Field(default_factory=dict)
    motions: list[CommissioningMotion] = Field(default_factory=list)
    verdict: str | None = None
    held_out_error_pct_by_joint: dict[str, float] = Field(default_factory=dict)
    versions: dict[str, str]

    @property
    def motion_s(self) -> float:
        """Duration of all motions, s."""
        return sum(one.duration_s for one in self.motions)
