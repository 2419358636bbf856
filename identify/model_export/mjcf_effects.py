"""Friction and named effects in MJCF: passive actuators, and second hinges for elasticity and backlash."""

import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from armident.identify.model_export.exported_model import ExportedEffect, ExportedModel
from armident.identify.model_export.rigid_effects import SHAFT_KG, SHAFT_KG_M2, gear_spring
from armident.identify.model_export.saturated_dampers import SaturatedDamper, saturated_dampers
from armident.identify.model_export.xml_text import numbers
from armident.identify.robot.chain import Floats

LEAST_FRICTION = 0.01
"""Friction that Stribeck friction on a bristle falls to where it has no Coulomb friction, relative to its peak."""

STOP = {"solreflimit": "0.002 1", "solimplimit": "0.99 0.9999 1e-5"}
"""Ends of a backlash gap: without rebound, as in the model; the time constant is that of two steps, s."""

NO_GAIN = "1e-9"
"""Gain of an actuator whose input is not used."""


@dataclass
class Passive:
    """Passive actuators of a model: of joints, or tendons if ``at`` is ``tendon``. ``unused``: those with an input."""

    element: ET.Element = field(default_factory=lambda: ET.Element("actuator"))
    unused: list[str] = field(default_factory=list)

    def friction(self, name: str, law: Callable[[Floats], Floats], top: float, at: str = "joint") -> None:
        """Add the friction ``law`` (N m or N over rad/s or m/s) of a joint or tendon."""
        for k, damper in enumerate(saturated_dampers(law, top)):
            self._damper(f"{name}_friction_{k}", damper, {at: name})

    def bristle(self, name: str, level: float, peak: float, velocity: float, displacement: float) -> None:
        """Add LuGre friction of a joint: ``peak`` at rest falls to ``level`` over ``velocity``; N m or N."""
        values = [peak / displacement, 0.0, max(level, LEAST_FRICTION * peak), peak, velocity]
        self._motor(f"{name}_bristle_{len(self.element)}", {"joint": name, "lugre": numbers(values)})

    def ripple(self, name: str, cosine: float, sine: float, wave_number: float) -> None:
        """Add a ripple that the motor has to overcome, ``cosine cos(w q) + sine sin(w q)``, N m or N."""
        values = [np.hypot(cosine, sine), wave_number, np.arctan2(cosine, sine) + np.pi]
        self._motor(f"{name}_ripple_{len(self.element)}", {"joint": name, "cogging": numbers(values)})

    def _damper(self, name: str, damper: SaturatedDamper, where: dict[str, str]) -> None:
        if damper.slope > 0.0 and damper.low == -damper.high:
            # A motor with shorted windings brakes in proportion to its speed, up to its largest torque.
            constant, most = numbers(np.sqrt(damper.slope)), numbers([damper.high, 0.0, 0.0])
            self._motor(name, {**where, "saturation": most}, constant)
            return
        # With a gain of zero, MuJoCo would read a positive third number as a damping ratio.
        law = {"biastype": "affine", "gainprm": NO_GAIN}
        limits = {"biasprm": numbers([0.0, 0.0, -damper.slope]), "forcerange": numbers([damper.low, damper.high])}
        ET.SubElement(self.element, "general", {"name": name, **where, **law, **limits})
        self.unused.append(name)

    def _motor(self, name: str, attributes: dict[str, str], constant: str = "0") -> None:
        fixed = {"name": name, "input": "none", "resistance": "1", "motorconst": f"{constant} {constant}"}
        ET.SubElement(self.element, "dcmotor", {**fixed, **attributes})


def add_effects(model: ExportedModel, passive: Passive) -> tuple[set[int], list[float]]:
    """Add bristles and ripples; return the numbers of their effects, and the friction of each joint that they replace.

    That is Coulomb friction with the smoothed sign, N m or N.
    """
    held, replaced = set(), [0.0] * len(model.joints)
    for number, effect in enumerate(model.effects):
        k, value = effect.joint, effect.parameters
        name, displacement = model.joints[k].name, value.get("displacement", 0.0)
        if effect.effect == "presliding_friction" and value["fcd"] < 0.0:
            passive.bristle(name, -value["fcd"], -value["fcd"], 1.0, displacement)
            replaced[k] -= value["fcd"]
        elif effect.effect == "stribeck_friction" and displacement > 0.0:
            level = value.get("fsb", 0.0)
            passive.bristle(name, level, level + value["fst"], value["velocity"], displacement)
            replaced[k] += level
        elif effect.effect == "cogging_torque" and np.count_nonzero(model.robot.transmission_matrix[k]) == 1:
            wave_number = value["harmonic"] * float(model.robot.transmission_matrix[k, k])
            passive.ripple(name, value.get("cgc", 0.0), value.get("cgs", 0.0), wave_number)
        else:
            continue
        held.add(number)
    return held, replaced


def on_shaft(body: ET.Element, joint: ET.Element, effect: ExportedEffect) -> ET.Element:
    """Return the body of a motor, which ``joint`` turns, with ``body`` on a second joint about the same axis."""
    shaft = ET.Element("body", {key: str(body.get(key)) for key in ("pos", "xyaxes")}, name=f"{body.get('name')}_motor")
    sphere = numbers(np.full(3, SHAFT_KG_M2))
    ET.SubElement(shaft, "inertial", pos="0 0 0", mass=numbers(SHAFT_KG), diaginertia=sphere)
    del body.attrib["pos"], body.attrib["xyaxes"]
    gear = ET.Element("joint", {key: str(joint.get(key)) for key in ("type", "axis")}, name=f"{joint.get('name')}_gear")
    value = effect.parameters
    if effect.effect == "backlash":
        gear.attrib.update(STOP, range=numbers([-0.5 * value["gap"], 0.5 * value["gap"]]))
    else:
        stiffness, damping = gear_spring(effect)
        gear.attrib.update(stiffness=numbers(stiffness), damping=numbers(damping))
    body.insert(0, gear)
    shaft.append(body)
    return shaft
