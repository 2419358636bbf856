"""The documents ``prediction.json`` and ``predictions.json``: a model on recordings."""

from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from armident.identify.documents.base import RecordingReference, SignedDocument

ALL_PCT = 100.0
"""Torque error of no model at all, percent."""


class PredictionDocument(SignedDocument):
    """Content of ``prediction.json``: error of an identified model on a recording.

    Torques are low-passed as in the identification, at twice the closed-loop bandwidth.

    Parameters
    ----------
    model
        File of the model.
    method
        Method of its identification.
    recording
        Recording whose torques are predicted.
    held_out
        False if the model was identified from this recording.
    relative_error_pct, relative_error_pct_by_joint
        ``||y - X theta|| / ||y||``, percent, in total and by joint.
    identification_error_pct, identification_error_pct_by_joint
        The same of the model on its own data.
    error_rms, torque_rms
        Root mean square of the error and of the measured torque by joint, each in its unit.
    units
        Unit of the torque by joint: N m or N.
    samples
        Number of instants after the decimation.
    rate_hz
        Rate of these instants, Hz.
    warnings
        Remarks: motion beyond that of the identification, mistakes of the set-up.
    """

    schema_: Literal["armident/prediction/1"] = Field("armident/prediction/1", alias="schema")
    robot: str
    model: str
    method: str
    recording: RecordingReference
    held_out: bool
    relative_error_pct: float
    relative_error_pct_by_joint: dict[str, float]
    identification_error_pct: float
    identification_error_pct_by_joint: dict[str, float]
    error_rms: dict[str, float]
    torque_rms: dict[str, float]
    units: dict[str, str]
    samples: int
    rate_hz: float
    warnings: list[str]
    versions: dict[str, str]

    @property
    def worthless(self) -> bool:
        """True if the model explains the torques no better than none."""
        return not self.relative_error_pct < ALL_PCT

    @property
    def sentence(self) -> str:
        """Result in words: the data it holds for, and the error in total."""
        data = "held-out data: the model was not identified from this recording"
        if not self.held_out:
            data = "not held out: the model was identified from this recording, so the error is too favourable"
        worse = ". The model explains these torques no better than none" if self.worthless else ""
        own = f"on its own data {self.identification_error_pct:.2f} %"
        return f"Torque error {self.relative_error_pct:.2f} % ({data}); {own}{worse}."


class PredictionsDocument(SignedDocument):
    """Content of ``predictions.json``: errors of an identified model on several recordings.

    Parameters
    ----------
    model
        File of the model.
    worst_recording
        Recording with the largest torque error.
    worst_error_pct
        Its torque error, percent.
    predictions
        Prediction of each recording, in the given order.
    """

    schema_: Literal["armident/predictions/1"] = Field("armident/predictions/1", alias="schema")
    robot: str
    model: str
    worst_recording: str | None
    worst_error_pct: float
    predictions: list[PredictionDocument]

    @property
    def worthless(self) -> bool:
        """True if the model explains the torques of a recording no better than none."""
        return any(each.worthless for each in self.predictions)


def predictions_document(predictions: Sequence[PredictionDocument]) -> PredictionsDocument:
    """Return the document of several predictions by one model.

    Parameters
    ----------
    predictions
        Predictions, at least one.
    """
    worst = max(predictions, key=lambda each: each.relative_error_pct)
    return PredictionsDocument(
        robot=worst.robot,
        model=worst.model,
        worst_recording=worst.recording.path,
        worst_error_pct=worst.relative_error_pct,
        predictions=list(predictions),
    )
