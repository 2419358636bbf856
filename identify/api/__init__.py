"""Identification, diagnosis, comparison and trajectory design, as ``import armident`` offers them."""

from armident.identify.api.comparison_api import ChangeTest, compare
from armident.identify.api.diagnosis_api import Diagnosis, diagnose, effects
from armident.identify.api.identification_api import Identification, identify, load_identification
from armident.identify.api.prediction_api import TorquePrediction, predict
from armident.identify.api.setup_api import CheckedSetup, check
from armident.identify.api.trajectory_api import Design, design_trajectory
from armident.identify.effects.effect import Effect, Linear, Place, Shape
from armident.identify.identification.options import Options
from armident.identify.identification.robot_model import RobotModel
from armident.identify.robot.motion import Motion

__all__ = [
    "ChangeTest",
    "CheckedSetup",
    "Design",
    "Diagnosis",
    "Effect",
    "Identification",
    "Linear",
    "Motion",
    "Options",
    "Place",
    "RobotModel",
    "Shape",
    "TorquePrediction",
    "check",
    "compare",
    "design_trajectory",
    "diagnose",
    "effects",
    "identify",
    "load_identification",
    "predict",
]
