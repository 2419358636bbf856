"""HTML report of a prediction: held-out error, measured against predicted torques."""

from typing import TYPE_CHECKING

from armident.identify.report.glossary import identification_entries
from armident.identify.report.identification import torque_plots
from armident.identify.report.page import render

if TYPE_CHECKING:
    from armident.identify.api.prediction import TorquePrediction


def prediction_report(prediction: "TorquePrediction") -> str:
    """Return the HTML page of a prediction, complete in one file."""
    document, model = prediction.document, prediction.model
    joints, units = list(document.units), list(document.units.values())
    return render(
        "prediction.html",
        document=document,
        robot=model.robot,
        torques=torque_plots(prediction.t, prediction.measured, prediction.predicted, joints, units),
        glossary=identification_entries(model.document),
    )
