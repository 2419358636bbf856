"""HTML report of a prediction: held-out error, measured against predicted torques."""

from armident.arrays import Array
from armident.identify.documents.prediction import PredictionDocument
from armident.identify.identification.robot_model import RobotModel
from armident.identify.report.glossary import base_entries
from armident.identify.report.identification_report import torque_plots
from armident.identify.report.page import render


def prediction_report(
    document: PredictionDocument, model: RobotModel, t: Array, measured: Array, predicted: Array
) -> str:
    """Return the HTML page of a prediction: torques (M, n), N m or N, over instants (M,), s."""
    return render(
        "prediction.html",
        document=document,
        robot=model.robot,
        torques=torque_plots(t, measured, predicted, list(document.units), list(document.units.values())),
        glossary=base_entries(p.name for p in model.document.parameters),
    )
