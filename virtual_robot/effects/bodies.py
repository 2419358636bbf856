"""Hidden changes of the rigid bodies: payloads, rotors, and tilt and vibration of the base."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio

from armident.arrays import Array
from armident.configs import ConfigError
from armident.virtual_robot.effects.spec import EffectSpec, Hidden, ParameterSpec, positive

pin: Any = pinocchio

EFFECTS: dict[str, EffectSpec] = {
    "payload": EffectSpec(
        "body",
        "mass fixed to the joint's link, in that link's frame",
        {
            "mass": positive("kg", "mass"),
            "x": ParameterSpec("m", "centre of mass", 0.0),
            "y": ParameterSpec("m", "centre of mass", 0.0),
            "z": ParameterSpec("m", "centre of mass", 0.1),
            "radius": positive("m", "radius of gyration about every axis through the centre of mass", 0.05),
        },
    ),
    "rotor_inertia": EffectSpec(
        "body",
        "additional rotor inertia; between two joints with ``other``",
        {"inertia": ParameterSpec("kg m^2", "joint side")},
        other="optional",
    ),
    "gravity_direction": EffectSpec(
        "body",
        "base mounted out of level",
        {
            "tilt": ParameterSpec("rad", "angle", None, -math.pi, math.pi),
            "azimuth": ParameterSpec("rad", "horizontal axis of the tilt, from the base's x axis", 0.0),
        },
        first_joint=True,
    ),
    "slosh_payload": EffectSpec(
        "body",
        "liquid in a vessel on the joint's link, as a pendulum about the link's x axis",
        {
            "mass": positive("kg", "mass that swings"),
            "length": positive("m", "length of the pendulum", 0.1),
            "z": ParameterSpec("m", "position of its hinge in the link's frame", 0.05),
            "damping": positive("-", "damping of the pendulum, of critical", 0.05, 2.0),
        },
        group="outside",
    ),
    "base_vibration": EffectSpec(
        "body",
        "horizontal vibration of the base",
        {
            "amplitude": ParameterSpec("m/s^2", "acceleration"),
            "frequency": positive("Hz", "frequency", 4.0),
            "azimuth": ParameterSpec("rad", "direction, from the base's y axis", 0.0),
        },
        first_joint=True,
        group="outside",
    ),
}
"""Effects of this module."""


def change_bodies(model: Any, hidden: Sequence[Hidden]) -> None:
    """Add payloads and vessels to a Pinocchio model (swinging masses as last joints) and tilt its gravity, in place."""
    for h in hidden:
        if h.effect == "payload":
            placement = pin.SE3(np.eye(3), np.array([h["x"], h["y"], h["z"]]))
            model.appendBodyToJoint(h.joint + 1, _ball(h["mass"], h["radius"]), placement)
        elif h.effect == "gravity_direction":
            model.gravity.linear = tilted(np.array(model.gravity.linear), h["tilt"], h["azimuth"])
        elif h.effect == "slosh_payload":
            hinge = pin.SE3(np.eye(3), np.array([0.0, 0.0, h["z"]]))
            name = f"slosh_{h.joint + 1}"
            number = model.addJoint(h.joint + 1, pin.JointModelRX(), hinge, name)
            bob = pin.SE3(np.eye(3), np.array([0.0, 0.0, -h["length"]]))
            model.appendBodyToJoint(number, _ball(h["mass"], 0.1 * h["length"]), bob)


def rest_angles(model: Any, hidden: Sequence[Hidden], q: Array) -> Array:
    """Rest angles (S,), rad, of the swinging masses in Pinocchio's order, at a posture (n,), rad or m."""
    data = model.createData()
    swinging = [h for h in hidden if h.effect == "slosh_payload"]
    zero = np.concatenate([q, np.zeros(len(swinging))])
    pin.forwardKinematics(model, data, zero)
    out = []
    for k in range(len(swinging)):
        down = data.oMi[q.size + 1 + k].rotation.T @ model.gravity.linear
        out.append(math.atan2(down[1], -down[2]))
    return np.array(out)


def hinge_damping(hidden: Sequence[Hidden], gravity: Array) -> Array:
    """Viscous coefficients (S,), N m s/rad, of the swinging masses' hinges."""
    out = []
    for h in hidden:
        if h.effect == "slosh_payload":
            own = math.sqrt(max(float(np.linalg.norm(gravity)), 1.0) / h["length"])
            out.append(h["damping"] * 2.0 * h["mass"] * h["length"] ** 2 * own)
    return np.array(out)


def add_rotors(rotor: Array, hidden: Sequence[Hidden], links: Array) -> None:
    """Add hidden rotor inertias to ``rotor`` (n, n), joint side, in place."""
    for h in hidden:
        if h.effect == "rotor_inertia":
            one, two = (h.joint, h.joint) if h.other < 0 else (h.joint, h.other)
            rotor[one, two] += h["inertia"]
            if one != two:
                rotor[two, one] += h["inertia"]
            if np.linalg.eigvalsh(links + rotor).min() <= 0.0:
                raise ConfigError(f"{h.where}.parameters.inertia: {h['inertia']:g} leaves a joint without inertia")


def tilted(gravity: Array, tilt: float, azimuth: float) -> Array:
    """Gravity (3,), m/s^2, in the frame of a base tilted, rad, about a horizontal axis at an azimuth from x, rad."""
    one, two = _horizontal(gravity)
    axis = math.cos(azimuth) * one + math.sin(azimuth) * two
    out: Array = pin.exp3(tilt * axis) @ gravity
    return out


def base_vibrations(hidden: Sequence[Hidden], gravity: Array) -> Array:
    """Amplitude vector (m/s^2) and angular frequency (rad/s) of each vibration of the base, shape (V, 4)."""
    one, two = _horizontal(gravity)
    rows = []
    for h in hidden:
        if h.effect == "base_vibration":
            direction = math.cos(h["azimuth"]) * two + math.sin(h["azimuth"]) * one
            rows.append([*(h["amplitude"] * direction), 2 * math.pi * h["frequency"]])
    return np.array(rows, np.float64).reshape(-1, 4)


def _horizontal(gravity: Array) -> tuple[Array, Array]:
    """Two horizontal unit vectors: the projected x axis of the base, and the vector orthogonal to it and to gravity."""
    size = float(np.linalg.norm(gravity))
    down = gravity / size if size > 0.0 else np.array([0.0, 0.0, -1.0])
    start = np.array([1.0, 0.0, 0.0]) if abs(down[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    one = start - (start @ down) * down
    one /= np.linalg.norm(one)
    return one, np.cross(one, down)


def _ball(mass: float, radius: float) -> Any:
    return pin.Inertia(mass, np.zeros(3), mass * radius**2 * np.eye(3))
