"""HTML report of a prediction: held-out error, measured against predicted torques."""

from armident.configs import RobotConfig
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.prediction import TorquePrediction
from armident.identify.report.glossary import identification_entries
from armident.identify.report.identification import torque_plots
from armident.identify.report.page import render


def prediction_report(prediction: TorquePrediction, robot: RobotConfig, identified: IdentificationDocument) -> str:
    """Return the HTML page of a prediction, complete in one file.

    ``prediction``: torques and errors; ``robot``: configuration of the model; ``identified``: identification of the
    model, whose parameters the glossary explains.
    """
    document = prediction.document
    joints, units = list(document.units), list(document.units.values())
    return render(
        "prediction.html",
        document=document,
        robot=robot,
        torques=torque_plots(prediction.t, prediction.measured, prediction.predicted, joints, units),
        glossary=identification_entries(identified),
    )
