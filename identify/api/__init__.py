"""Identification, diagnosis, comparison and trajectory design, as ``import armident`` offers them."""

from armident.identify.api.comparison import ChangeTest, compare
from armident.identify.api.diagnosis import Diagnosis, diagnose, effects
from armident.identify.api.identification import Identification, check, identify
from armident.identify.api.prediction import predict
from armident.identify.api.trajectory import Design, design_trajectory
from armident.identify.effects.effect import Effect

__all__ = [
    "ChangeTest",
    "Design",
    "Diagnosis",
    "Effect",
    "Identification",
    "check",
    "compare",
    "design_trajectory",
    "diagnose",
    "effects",
    "identify",
    "predict",
]
