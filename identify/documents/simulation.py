"""The document that ``armident simulate --json`` prints."""

from typing import Literal

from pydantic import Field

from armident.identify.documents.base import RecordingReference, SignedDocument


class SimulationDocument(SignedDocument):
    """Output of ``armident simulate --json``: the file that was written and what it was simulated from.

    Parameters
    ----------
    physics
        ``virtual`` (Pinocchio) or ``identified`` (equations of the identification).
    trajectory, model, scenario
        Files of the reference, of the model and of the hidden effects; null without.
    seed, noise
        Seed, and factor on the noise, of the virtual arm; null for an identified model, which has no noise.
    recording
        File that was written, hash of the samples, sampling rate and number of samples.
    duration_s
        Time from the first to the last sample, s.
    """

    schema_: Literal["armident/simulation/1"] = Field("armident/simulation/1", alias="schema")
    robot: str
    physics: Literal["virtual", "identified"]
    trajectory: str
    model: str | None
    scenario: str | None
    seed: int | None
    noise: float | None
    recording: RecordingReference
    duration_s: float
