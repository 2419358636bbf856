"""Records robot arms over CANopen and identifies, diagnoses and monitors their dynamic models.

>>> import armident
>>> recording = armident.simulate_recording("tx40", "tx40_excitation", seed=1)
>>> result = armident.identify(recording, method="idim-ls")
>>> result.parameters["zz1r"].unit
'kg m^2'

Recordings: `Recording.from_arrays`, `read_recording`, `import_recording`, `simulate_recording`, `capture`.
Configurations: `load_robot`, `load_session`.
Work: `commission`, `check`, `identify` with `Options`, `diagnose`, `investigate`, `characterise`, `compare`, `predict`,
`design_trajectory`.
Results: `CheckedSetup`, `Identification` (`load_identification`) and its `RobotModel`, `Diagnosis`, `Investigation`,
`Commissioning`, `Characterisation`, `ChangeTest`, `TorquePrediction`, `Design`. They print, show themselves in a
notebook, and have ``report`` and ``save``.
Effects: `effects` lists them; `Effect`, `Linear`, `Shape`, `Place` and `Motion` make a new one.
Errors: `ArmidentError`, and of it `ConfigError` and `DataError`.
"""

import importlib
import logging
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from armident.configs import ArmidentError as ArmidentError
    from armident.configs import ConfigError as ConfigError
    from armident.configs import DataError as DataError
    from armident.configs import load_robot as load_robot
    from armident.configs import load_session as load_session
    from armident.daq.api import capture as capture
    from armident.daq.api import import_recording as import_recording
    from armident.daq.recording import Recording as Recording
    from armident.daq.recording import read_recording as read_recording
    from armident.identify.api.characterisation_api import Characterisation as Characterisation
    from armident.identify.api.characterisation_api import characterise as characterise
    from armident.identify.api.commissioning_api import Commissioning as Commissioning
    from armident.identify.api.commissioning_api import commission as commission
    from armident.identify.api.comparison_api import ChangeTest as ChangeTest
    from armident.identify.api.comparison_api import compare as compare
    from armident.identify.api.diagnosis_api import Diagnosis as Diagnosis
    from armident.identify.api.diagnosis_api import diagnose as diagnose
    from armident.identify.api.diagnosis_api import effects as effects
    from armident.identify.api.identification_api import Identification as Identification
    from armident.identify.api.identification_api import identify as identify
    from armident.identify.api.identification_api import load_identification as load_identification
    from armident.identify.api.investigation_api import Investigation as Investigation
    from armident.identify.api.investigation_api import investigate as investigate
    from armident.identify.api.prediction_api import TorquePrediction as TorquePrediction
    from armident.identify.api.prediction_api import predict as predict
    from armident.identify.api.setup_api import CheckedSetup as CheckedSetup
    from armident.identify.api.setup_api import check as check
    from armident.identify.api.trajectory_api import Design as Design
    from armident.identify.api.trajectory_api import design_trajectory as design_trajectory
    from armident.identify.effects.effect import Effect as Effect
    from armident.identify.effects.effect import Linear as Linear
    from armident.identify.effects.effect import Place as Place
    from armident.identify.effects.effect import Shape as Shape
    from armident.identify.identification.options import Options as Options
    from armident.identify.identification.robot_model import RobotModel as RobotModel
    from armident.identify.robot.motion import Motion as Motion
    from armident.virtual_robot.api import simulate_recording as simulate_recording

    __version__: str

_HOMES = {
    "armident.configs": ("ArmidentError", "ConfigError", "DataError", "load_robot", "load_session"),
    "armident.daq.api": ("capture", "import_recording"),
    "armident.daq.recording": ("Recording", "read_recording"),
    "armident.identify.api.characterisation_api": ("Characterisation", "characterise"),
    "armident.identify.api.commissioning_api": ("Commissioning", "commission"),
    "armident.identify.api.comparison_api": ("ChangeTest", "compare"),
    "armident.identify.api.diagnosis_api": ("Diagnosis", "diagnose", "effects"),
    "armident.identify.api.identification_api": ("Identification", "load_identification"),
    "armident.identify.api.investigation_api": ("Investigation", "investigate"),
    "armident.identify.api.prediction_api": ("TorquePrediction", "predict"),
    "armident.identify.api.setup_api": ("CheckedSetup", "check"),
    "armident.identify.api.trajectory_api": ("Design", "design_trajectory"),
    "armident.identify.effects.effect": ("Effect", "Linear", "Place", "Shape"),
    "armident.identify.identification.options": ("Options",),
    "armident.identify.identification.robot_model": ("RobotModel",),
    "armident.identify.robot.motion": ("Motion",),
    "armident.virtual_robot.api": ("simulate_recording",),
}  # fmt: skip
"""Names of the public API by the module that defines them; a name is imported when it is first used."""
_MODULES = {name: module for module, names in _HOMES.items() for name in names}
__all__ = sorted([*_MODULES, "identify"])

# A program that imports armident chooses the output of the log; by default there is none.
logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562), so that ``import armident`` is quick."""
    if name == "identify":
        # The package of this name is callable.
        return importlib.import_module("armident.identify")
    if name == "__version__":
        from importlib.metadata import version

        return version("armident")
    if name not in _MODULES:
        raise AttributeError(f"module 'armident' has no attribute {name!r}")
    from armident.extras import named_extra

    with named_extra(f"armident.{name}", _MODULES[name]):
        value = getattr(importlib.import_module(_MODULES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, for completion."""
    return sorted({*(name for name in globals() if name.startswith("__")), "__version__", *__all__})
