"""Schema of a robot: geometry, transmission, drives and the terms of its dynamic model."""

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from armident.arrays import Array
from armident.configs.blanks import check_filled, needed
from armident.configs.errors import ConfigError
from armident.configs.schema.base import FrozenModel, WithBlanks
from armident.configs.schema.collision import BASE, Collision
from armident.configs.schema.limits import Limits, Positive, endless

__all__ = [
    "Controller",
    "Coupling",
    "Drive",
    "Effect",
    "Friction",
    "Joint",
    "JointName",
    "Limits",
    "Mdh",
    "Name",
    "Positive",
    "Preprocessing",
    "RobotConfig",
]

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=64)]
JointName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=64)]

NOMINAL_SIGN_SMOOTHING = {"revolute": 150.0, "prismatic": 5000.0}
"""``g`` of the smoothed sign by type of joint where neither a value nor a motion is known, s/rad and s/m.

150 s/rad is that of the TX40 (thesis appendix B.2); 5000 s/m is the same for the EMPS, ``configs/robots/emps.yaml``.
"""


class Mdh(FrozenModel):
    """Modified Denavit-Hartenberg parameters, frame j-1 to j (thesis section 2.1.1, table B.1).

    ``Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r)``; the joint variable is added to
    ``theta`` of a revolute joint and to ``r`` of a prismatic one.

    Parameters
    ----------
    alpha, theta
        Angles, rad.
    d, r
        Lengths, m.
    """

    alpha: float = Field(description="rad")
    d: float = Field(description="m")
    theta: float = Field(description="rad")
    r: float = Field(description="m")


class Drive(FrozenModel):
    """Drive of one motor: conversion of its raw numbers to rad and N m at the motor shaft.

    Parameters
    ----------
    signal
        Quantity that the drive reports as effort: ``current`` (A), ``voltage`` (V) or ``torque`` (N m, N).
    gain
        Shaft torque (N m) or force (N) per unit of ``signal``; thesis equation 2.14 without the gear ratio.
    rated
        Value of ``signal`` that the drive reports as 1000 per mille (CiA 402, 6075h for 6078h).
    counts_per_unit
        Encoder counts per motor turn (revolute) or per metre (prismatic); ``None`` if positions come in SI.
    saturation
        Largest absolute value of ``signal`` the drive can apply; ``None`` if unknown.
    """

    signal: Literal["current", "voltage", "torque"] = "current"
    gain: float = 1.0
    rated: Positive = 1.0
    counts_per_unit: Positive | None = None
    saturation: Positive | None = None


class Joint(FrozenModel):
    """One joint with its drive.

    Parameters
    ----------
    name, type
        Name, and ``revolute`` or ``prismatic``.
    mdh
        Modified Denavit-Hartenberg parameters.
    limits
        Limits of motion and torque, joint side.
    drive
        Drive of the joint's motor.
    rotor_inertia
        ``True`` if the rotor inertia ``ia`` is a separate parameter of the model.
    source_name
        Name of the joint in its URDF and in messages of ROS 2; ``None``: the same as ``name``.
    """

    name: JointName
    type: Literal["revolute", "prismatic"] = "revolute"
    mdh: Mdh
    limits: Limits = Limits()
    drive: Drive = Drive()
    rotor_inertia: bool = True
    source_name: Annotated[str, Field(min_length=1)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _endless(cls, data: Any) -> Any:
        """Give a revolute joint whose position limits are no limits the range of an endless one."""
        if not isinstance(data, dict) or data.get("type", "revolute") != "revolute":
            return data
        limits = data.get("limits")
        if not isinstance(limits, dict) or "position" not in limits:
            return data
        return {**data, "limits": {**limits, "position": endless(limits["position"])}}


class Coupling(FrozenModel):
    """Coupling of two joints by friction and inertia (thesis equation B.1).

    Parameters
    ----------
    name
        Suffix of the parameters ``ia<name>``, ``fv<name>`` and ``fc<name>``.
    joints
        Names of the two joints.
    """

    name: Name
    joints: tuple[JointName, JointName]


class Effect(FrozenModel):
    """Effect of the diagnosis catalogue that is part of the robot's model.

    Parameters
    ----------
    effect
        Name of the effect.
    law
        Formula of the effect, where it has several; empty: the first one. ``table`` is a free shape.
    joint, other
        Joint of the effect; second joint of an effect between two joints.
    parameters
        Values of the nonlinear parameters (a Stribeck velocity, a harmonic); linear ones are estimated.
    without
        Linear parameters to leave out, because the rigid model of this arm has an equivalent one.
    """

    effect: Name
    law: str = ""
    joint: JointName
    other: JointName | None = None
    parameters: dict[str, float] = Field(default_factory=dict)
    without: tuple[Name, ...] = ()


class Friction(FrozenModel):
    """Coulomb friction near standstill.

    Parameters
    ----------
    sign_smoothing
        ``g`` (s/rad or s/m) in ``sign(qd) -> (2/pi) atan(g qd)`` (thesis appendix B.2): one value for all joints, or
        one per joint. ``None``: each joint has its own, from its torques and velocities
        (`armident.identify.identification.sign_smoothing`).
    velocity_threshold
        Per joint (rad/s or m/s): samples of a joint slower than this are left out of that joint's equations, because
        its friction is undefined there. ``None``: chosen from the data.
    """

    sign_smoothing: Positive | tuple[Positive, ...] | None = None
    velocity_threshold: tuple[Annotated[float, Field(ge=0)], ...] | None = None


class Controller(FrozenModel):
    """Known cascade controller ``nu = kv (kp (q_r - q) - qd)`` per motor, in units of the drive's signal.

    Parameters
    ----------
    kp
        Position gains, 1/s, length n.
    kv
        Velocity gains, units of ``signal`` per rad/s or m/s, length n.
    velocity_samples
        Number of sampling periods over which the velocity ``qd`` is averaged.
    """

    kp: tuple[Positive, ...]
    kv: tuple[float, ...]
    velocity_samples: Annotated[int, Field(ge=1)] = 1


class Preprocessing(FrozenModel):
    """Filters of a published least-squares fit, applied as published (`armident.identify.signals.published_filters`).

    Parameters
    ----------
    cutoff_hz, order, padlen
        Cut-off (Hz), order and padding of the zero-phase Butterworth filter on the positions, before central
        differences.
    drop
        Number of samples dropped at the start.
    decimation, decimation_order, decimation_ripple_db, decimation_padlen
        Decimation factor, and order, ripple (dB) and padding of the zero-phase Chebyshev low-pass on torque and
        regressor.
    """

    cutoff_hz: Positive
    order: Annotated[int, Field(ge=1)] = 4
    padlen: Annotated[int, Field(ge=0)] = 12
    drop: Annotated[int, Field(ge=0)] = 0
    decimation: Annotated[int, Field(ge=2)]
    decimation_order: Annotated[int, Field(ge=1)] = 8
    decimation_ripple_db: Positive = 0.05
    decimation_padlen: Annotated[int, Field(ge=0)] = 24


class RobotConfig(WithBlanks):
    """Serial robot arm; all values in SI units, joint side unless stated otherwise.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the file format.
    name, description
        Name, and free text.
    gravity
        Acceleration of gravity in frame 0, m/s^2.
    joints
        Joints from base to tip, length n.
    transmission
        Matrix ``R`` with ``q_motor = R q``, n rows (motors) of n numbers (joints); ``None``: the identity.
    couplings
        Friction and inertia between joints.
    effects
        Effects of the diagnosis catalogue that are part of the model.
    friction
        Coulomb friction near standstill.
    controller
        Known controller of the drives; ``None``: unknown.
    bandwidth_hz
        Closed-loop bandwidth, Hz; ``None``: estimated from the data.
    initial_parameters
        Start values of the iterative methods, by parameter name, SI.
    preprocessing
        Filters of a published IDIM-LS fit, with a sharp ``sign(qd)``; ``None``: filters from the bandwidth.
    collision
        Bodies of the arm and of its cell, which designed trajectories keep apart.
    blanks
        Keys that the file marks as blank.
    """

    schema_: Literal["armident/robot/1"] = Field(alias="schema")
    name: Name
    description: str = ""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    joints: Annotated[tuple[Joint, ...], Field(min_length=1)]
    transmission: tuple[tuple[float, ...], ...] | None = None
    couplings: tuple[Coupling, ...] = ()
    effects: tuple[Effect, ...] = ()
    friction: Friction = Friction()
    controller: Controller | None = None
    bandwidth_hz: Positive | None = Field(None, description="closed-loop bandwidth; None: from the data")
    initial_parameters: dict[str, float] = Field(default_factory=dict)
    preprocessing: Preprocessing | None = Field(
        None, description="filters of a published IDIM-LS fit, with a sharp sign(qd); None: from the bandwidth"
    )
    collision: Collision | None = None
    _limit_places: tuple[str, ...] = PrivateAttr(())
    _first_moments: dict[str, float] = PrivateAttr(default_factory=dict)
    _first_moments_of_base: dict[str, float] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        n = len(self.joints)
        names = [j.name for j in self.joints]
        if len({name.lower() for name in names}) != n:
            raise ValueError("joints: names must be unique, without regard to case")
        sources = [j.source_name for j in self.joints if j.source_name is not None]
        if len(set(sources)) != len(sources):
            raise ValueError("joints: source names must be unique")
        if self.transmission is not None:
            if len(self.transmission) != n or any(len(row) != n for row in self.transmission):
                raise ValueError(f"transmission: expected {n} rows of {n} numbers (motor rows, joint columns)")
            if not np.linalg.slogdet(np.array(self.transmission)).logabsdet > np.log(1e-12):
                raise ValueError("transmission: the matrix is singular")
        for coupling in self.couplings:
            for joint in coupling.joints:
                if joint not in names:
                    raise ValueError(f"couplings: no joint named {joint!r}; joints are {', '.join(names)}")
        for effect in self.effects:
            for name in (effect.joint, effect.other):
                if name is not None and name not in names:
                    raise ValueError(f"effects: no joint named {name!r}; joints are {', '.join(names)}")
        for capsule in () if self.collision is None else self.collision.capsules:
            if capsule.link not in (BASE, *names):
                raise ValueError(f"collision: no link {capsule.link!r}; links are {', '.join((BASE, *names))}")
        threshold = self.friction.velocity_threshold
        if threshold is not None and len(threshold) != n:
            raise ValueError(f"friction.velocity_threshold: expected {n} numbers")
        smoothing = self.friction.sign_smoothing
        if isinstance(smoothing, tuple) and len(smoothing) != n:
            raise ValueError(f"friction.sign_smoothing: expected one number or {n}")
        if self.controller is not None and not len(self.controller.kp) == len(self.controller.kv) == n:
            raise ValueError(f"controller: expected {n} numbers in kp and in kv")
        return self

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    def __eq__(self, other: object) -> bool:
        """Return ``True`` for the same robot, wherever its limits were read."""
        return isinstance(other, RobotConfig) and self.__dict__ == other.__dict__

    @property
    def limit_places(self) -> tuple[str, ...]:
        """File and line of each joint's limits where they come from a URDF; empty otherwise."""
        return self._limit_places or ("",) * self.n

    @property
    def first_moments(self) -> dict[str, float]:
        """Masses and first moments ``mx1`` to ``m6`` of the URDF, kg and kg m; empty without a mass in every link."""
        return self._first_moments

    @property
    def first_moments_of_base(self) -> dict[str, float]:
        """The same if the URDF has its centres of mass in the frame of its base, as some files do."""
        return self._first_moments_of_base

    def with_urdf_facts(
        self,
        limit_places: tuple[str, ...],
        first_moments: dict[str, float] | None = None,
        of_base: dict[str, float] | None = None,
    ) -> Self:
        """Return the robot with facts of its URDF that no document of it contains.

        Parameters
        ----------
        limit_places
            File and line of the limits of each joint, (n,).
        first_moments
            Masses, kg, and first moments, kg m, in the frames of the model; ``None``: not every link has a mass.
        of_base
            The same with the centres of mass of the file taken in the frame of its base.
        """
        made = self.model_copy()
        made._limit_places, made._first_moments = limit_places, first_moments or {}
        made._first_moments_of_base = of_base or {}
        return made

    @property
    def sign_smoothing(self) -> Array:
        """``g`` (n,) of the smoothed sign of each joint, s/rad or s/m; nominal values where the configuration has none.

        A coupling of two joints has the smaller of their two values.
        """
        given = self.friction.sign_smoothing
        if given is None:
            given = tuple(NOMINAL_SIGN_SMOOTHING[joint.type] for joint in self.joints)
        return np.broadcast_to(np.asarray(given, dtype=np.float64), (self.n,)).copy()

    @property
    def transmission_matrix(self) -> Array:
        """Matrix ``R`` of shape (n, n): ``q_motor = R q`` and ``tau = R' tau_motor`` (thesis equation 2.14)."""
        if self.transmission is None:
            return np.eye(self.n)
        return np.array(self.transmission, dtype=np.float64)

    def blanks_for(self, command: str | None) -> tuple[str, ...]:
        """Blanks whose value a command needs.

        Parameters
        ----------
        command
            The command; ``None``: one that needs everything.
        """
        torques = all(joint.drive.signal == "torque" for joint in self.joints)
        return needed(self.blanks, command, efforts_are_torques=torques)

    def check_filled(self, command: str | None, where: str = "") -> None:
        """Refuse a robot that lacks a value that a command needs.

        Parameters
        ----------
        command
            The command; ``None``: one that needs everything.
        where
            Name of the configuration in messages; empty: the robot's.

        Raises
        ------
        ConfigError
            If there are such blanks; lists all of them with the way to find their values.
        """
        check_filled(where or f"robot {self.name}", self.blanks_for(command), command)

    def check_movable(self, where: str = "") -> None:
        """Refuse to move an arm whose limits or transmission are not known.

        Parameters
        ----------
        where
            Name of the configuration or trajectory in messages; empty: the robot's.

        Raises
        ------
        ConfigError
            If something is missing; lists everything.
        """
        lacking: dict[str, list[str]] = {}
        for joint in self.joints:
            for quantity in joint.limits.missing():
                lacking.setdefault(quantity, []).append(joint.name)
        needs = [f"limits.{quantity} of {', '.join(joints)}" for quantity, joints in lacking.items()]
        needs += [f"transmission ({self.n} rows of {self.n} numbers)"] if self.transmission is None else []
        if needs:
            place = where or f"robot {self.name}"
            raise ConfigError(f"{place}: to move the arm, the robot configuration needs also {'; '.join(needs)}")
