"""An identified model with physically consistent link parameters, as the writers of all formats take it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armident.configs import ConfigError, DataError, RobotConfig, load_robot
from armident.daq.recording import read_recording
from armident.identify.document import IdentificationDocument, load_document
from armident.identify.effects.recorded import of_recording
from armident.identify.effects.registry import of_entry
from armident.identify.effects.terms import arm_model, effect_terms
from armident.identify.model_export.link_frames import LinkFrames, mdh_link_frames
from armident.identify.model_export.source_urdf import SourceUrdf, source_for, source_frames, source_of
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Floats
from armident.identify.robot.consistent import ConsistentParameters, nearest_consistent
from armident.identify.robot_model import RobotModel

OF_DIAGNOSIS = (
    "a diagnosis finds effects, not the parameters of the arm: armident identify RECORDING --config {0}/model.yaml, "
    "then export its result with --robot {0}/model.yaml"
)
"""Next step where a diagnosis is to be exported."""

IMPOSSIBLE = (
    "look for the effect with armident diagnose RECORDING and identify with the model it writes, "
    "or export the nearest physical arm with --nearest"
)
"""Next step where no physical arm has the parameters."""

BALL_KG, BALL_RADIUS_M = 1e-3, 1e-2
"""Mass and radius of a ball that every exported link contains, at the origin of its frame.

Simulators refuse links without mass or extent. No link of an arm is smaller, and no recording shows a gram.
"""

SMALLEST_LINK = BALL_KG * np.diag([*np.full(3, BALL_RADIUS_M**2 / 5), 1.0])
"""Pseudo-inertia of that ball: second moments of a uniform ball (kg m^2) and mass (kg)."""


@dataclass(frozen=True, eq=False)
class LinkBody:
    """Rigid body of a link, in the frame of the link.

    Parameters
    ----------
    name
        Name of the link.
    mass
        Mass, kg.
    first_moments
        Mass times centre of mass, kg m, (3,).
    inertia
        Inertia about the origin of the frame, kg m^2, (3, 3).
    """

    name: str
    mass: float
    first_moments: Floats
    inertia: Floats

    @property
    def centre(self) -> Floats:
        """Centre of mass, m, (3,)."""
        return self.first_moments / self.mass

    @property
    def central_inertia(self) -> Floats:
        """Inertia about the centre of mass, axes of the link's frame, kg m^2, (3, 3)."""
        c = self.centre
        central: Floats = self.inertia - self.mass * (c @ c * np.eye(3) - np.outer(c, c))
        return central


@dataclass(frozen=True)
class JointFriction:
    """Rotor inertia and friction of a joint, joint side.

    Parameters
    ----------
    name, type
        Name in the exported file, and ``revolute`` or ``prismatic``.
    rotor_inertia
        kg m^2 or kg; 0 where it is not a parameter of the model.
    viscous
        N m s/rad or N s/m.
    coulomb, offset
        N m or N.
    """

    name: str
    type: str
    rotor_inertia: float
    viscous: float
    coulomb: float
    offset: float


@dataclass(frozen=True)
class JointCoupling:
    """Coupling of two joints (thesis equation B.1).

    Parameters
    ----------
    name
        Suffix of its parameters.
    joints
        Indices of the two joints, from 0.
    inertia, viscous, coulomb
        kg m^2, N m s/rad, N m, or those of prismatic joints.
    """

    name: str
    joints: tuple[int, int]
    inertia: float
    viscous: float
    coulomb: float


@dataclass(frozen=True)
class ExportedEffect:
    """Effect of the configuration, ``unnamed`` terms included.

    Parameters
    ----------
    effect, law, title
        Name and law in the catalogue, and its title in words.
    joint, other
        Index of its joint and of a second one, from 0.
    parameters
        Identified linear parameters and configured nonlinear ones, by name in the catalogue.
    units
        Unit of each linear parameter.
    of_recording
        True for a correction of recorded signals, which is no torque of the arm.
    """

    effect: str
    law: str
    title: str
    joint: int
    other: int | None
    parameters: dict[str, float]
    units: dict[str, str]
    of_recording: bool

    @property
    def is_linear_spring(self) -> bool:
        """True for a spring of constant positive stiffness ``ks`` that is relaxed at position zero."""
        return self.effect == "joint_spring" and not self.law and self.parameters.get("ks", 0.0) > 0.0


@dataclass(frozen=True, eq=False)
class ExportedModel:
    """An identified arm with physically consistent parameters; SI, joint side.

    Parameters
    ----------
    source
        File that the model was read from.
    robot
        Configuration of the robot; ``friction.sign_smoothing`` is that of the identification.
    document
        The identification.
    arm
        Dynamic model with the effects as terms, p standard and b base parameters.
    theta_base, std
        Identified base parameters and their standard deviations, (b,), before the physical constraints.
    consistent
        Physically consistent parameters nearest to them.
    frames
        Frames of links and joints in the file.
    links, joints, couplings, effects
        The exported parameters by part of the arm; links in the frames of ``frames``.
    source_urdf
        URDF whose link frames these are; ``None``: modified Denavit-Hartenberg frames.
    """

    source: Path
    robot: RobotConfig
    document: IdentificationDocument
    arm: ArmModel
    theta_base: Floats
    std: Floats
    consistent: ConsistentParameters
    frames: LinkFrames
    links: tuple[LinkBody, ...]
    joints: tuple[JointFriction, ...]
    couplings: tuple[JointCoupling, ...]
    effects: tuple[ExportedEffect, ...]
    source_urdf: SourceUrdf | None = None

    @property
    def theta(self) -> Floats:
        """Exported standard parameters (p,), those of the effects last, in modified Denavit-Hartenberg frames."""
        return self.consistent.theta

    @property
    def model(self) -> RobotModel:
        """The model as ``import armident`` offers it; ``model.inverse_dynamics(exported.theta, q, qd, qdd)``."""
        return RobotModel(self.robot)

    @property
    def undetermined(self) -> dict[str, str]:
        """Standard parameters that the recordings did not determine by themselves, with the reason."""
        essential = {p.name: p.essential for p in self.document.parameters}
        found: dict[str, str] = {}
        for name, how, groups in zip(
            self.consistent.names, self.consistent.identifiable, self.consistent.groups, strict=True
        ):
            if how == "no":
                found[name] = "no effect on the torques; the value is a choice"
            elif how == "group":
                found[name] = "determined only together with others; its share is a choice"
            elif not all(essential.get(group, True) for group in groups):
                found[name] = "not essential: smaller than its uncertainty in these recordings"
        return found

    def position_limits(self, k: int) -> tuple[float, float] | None:
        """Return lower and upper limit of joint k, rad or m; ``None`` for a joint that has none.

        Parameters
        ----------
        k
            Index of the joint, from 0.
        """
        limits = self.robot.joints[k].limits.position
        return limits if np.isfinite(limits).all() and not self.frames.endless[k] else None

    def in_frames_of(self, source: SourceUrdf) -> "ExportedModel":
        """Return the model with links and joints in the frames and with the names of a URDF.

        Parameters
        ----------
        source
            URDF and chain.

        Raises
        ------
        ConfigError
            If the URDF cannot be read, or has another geometry than the configuration.
        """
        frames = source_frames(source, self.robot)
        joints = tuple(replace(j, name=name) for j, name in zip(self.joints, frames.joints, strict=True))
        links = _bodies(self.arm, self.theta, frames)
        return replace(self, frames=frames, links=links, joints=joints, source_urdf=source)


def load_exported_model(
    path: str | Path,
    robot: RobotConfig | str | Path | None = None,
    urdf: str | Path | None = None,
    *,
    nearest: bool = False,
) -> ExportedModel:
    """Read an identification and compute the physically consistent arm.

    Parameters
    ----------
    path
        ``identification.json``, or a folder that contains it.
    robot
        Configuration, or its path or shipped name, for example the ``model.yaml`` of a diagnosis; ``None``: that of
        the recording, else the shipped one of the document's name.
    urdf
        URDF that the geometry comes from, whose frames and names the file takes; ``None``: the one that the
        configuration names, if it names one.
    nearest
        True to accept the nearest physical arm where the estimate differs significantly from every physical one.

    Raises
    ------
    ConfigError
        If a file is missing, or configuration or URDF do not belong to the identification.
    DataError
        If the identification is unusable, or no physical arm has these parameters.
    """
    file = _document(Path(path))
    document = load_document(file, IdentificationDocument)
    config = robot if isinstance(robot, RobotConfig) else _robot(document, file, robot)
    source = source_of(robot) if isinstance(robot, str | Path) and urdf is None else None
    if urdf is not None:
        source = source_for(config, Path(urdf))
    model = exported_model(document, config, file, nearest=nearest)
    return model if source is None else model.in_frames_of(source)


def exported_model(
    document: IdentificationDocument, robot: RobotConfig, source: Path, *, nearest: bool = False
) -> ExportedModel:
    """Compute the physically consistent arm of an identification.

    Parameters
    ----------
    document
        The identification.
    robot
        Configuration of the robot.
    source
        File of the document, for messages.
    nearest
        As in `load_exported_model`.

    Raises
    ------
    ConfigError
        If the configuration has other parameters than the identification.
    DataError
        If the identification is unusable, or no physical arm has these parameters.
    """
    robot = _with_smoothing(robot, document)
    arm = arm_model(robot)
    theta, covariance = _estimate(arm, document, source)
    consistent = nearest_consistent(arm, theta, covariance, SMALLEST_LINK)
    if document.verdict == "unusable":
        reason = document.reasons[0]
        raise DataError(f"{source}: the identification is unusable: {reason.message}; next: {reason.next_step}")
    if not consistent.compatible and not nearest:
        raise DataError(f"{source}: {consistent.verdict}; next: {IMPOSSIBLE}")
    frames = mdh_link_frames(robot)
    values = arm.values(consistent.theta)
    return ExportedModel(
        source=source,
        robot=robot,
        document=document,
        arm=arm,
        theta_base=theta,
        std=np.sqrt(np.diag(covariance)),
        consistent=consistent,
        frames=frames,
        links=_bodies(arm, consistent.theta, frames),
        joints=tuple(
            JointFriction(name, joint.type, float(values.ia[k]), float(values.fv[k]), float(values.fc[k]), off)
            for k, (name, joint, off) in enumerate(zip(frames.joints, robot.joints, values.off.tolist(), strict=True))
        ),
        couplings=tuple(
            JointCoupling(coupling.name, (int(i), int(j)), *(float(v) for v in three))
            for coupling, (i, j), three in zip(robot.couplings, values.coupling_joints, values.coupling, strict=True)
        ),
        effects=_effects(arm, consistent.theta),
    )


def _document(path: Path) -> Path:
    """Return the path of the identification; a diagnosis has no rigid parameters and is refused."""
    if not path.is_dir():
        if path.name == "diagnosis.json":
            raise ConfigError(f"{path}: {OF_DIAGNOSIS.format(path.parent)}")
        return path
    if not (path / "identification.json").is_file() and (path / "diagnosis.json").is_file():
        raise ConfigError(f"{path}: {OF_DIAGNOSIS.format(path)}")
    return path / "identification.json"


def _robot(document: IdentificationDocument, file: Path, given: str | Path | None) -> RobotConfig:
    """Return the configuration that was given, that of the recording, or the shipped one."""
    if given is not None:
        return load_robot(given)
    recorded = document.recording.path
    for candidate in () if recorded is None else (Path(recorded), file.parent / recorded):
        if candidate.is_file():
            return read_recording(candidate).robot
    try:
        return load_robot(document.robot)
    except ConfigError as error:
        raise ConfigError(
            f"{file}: the configuration of robot {document.robot} is unknown (its recording {recorded} is not here): "
            "give it with --robot ROBOT.yaml"
        ) from error


def _with_smoothing(robot: RobotConfig, document: IdentificationDocument) -> RobotConfig:
    """Return the configuration with the smoothed signs of the identification."""
    found = document.sign_smoothing
    if found is None or set(found) != {joint.name for joint in robot.joints}:
        return robot
    smoothing = tuple(found[joint.name] for joint in robot.joints)
    return robot.model_copy(update={"friction": robot.friction.model_copy(update={"sign_smoothing": smoothing})})


def _estimate(arm: ArmModel, document: IdentificationDocument, source: Path) -> tuple[Floats, Floats]:
    """Return base parameters (b,) and covariance (b, b) in the order of the model."""
    names = [p.name for p in document.parameters]
    if set(names) != set(arm.base.names):
        odd = sorted(set(names) ^ set(arm.base.names))
        raise ConfigError(
            f"{source}: other parameters than the configuration of {arm.robot.name} ({', '.join(odd[:5])}): "
            "give the configuration that was identified with --robot, or identify with this one"
        )
    order = [names.index(name) for name in arm.base.names]
    theta = np.array([document.parameters[k].value for k in order])
    return theta, np.array(document.covariance)[np.ix_(order, order)]


def _bodies(arm: ArmModel, theta: Floats, frames: LinkFrames) -> tuple[LinkBody, ...]:
    """Return the bodies of the links in the frames of the file."""
    bodies = []
    for name, placement, ten in zip(frames.links, frames.from_mdh, arm.values(theta).inertial, strict=True):
        xx, xy, xz, yy, yz, zz, mx, my, mz, mass = ten
        turn, shift = placement[:3, :3], placement[:3, 3]
        moments = turn @ np.array([mx, my, mz])
        inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        # Second moments about the new origin: sum of m (x + s)(x + s)'.
        second = np.outer(moments, shift) + np.outer(shift, moments) + mass * np.outer(shift, shift)
        bodies.append(
            LinkBody(name, float(mass), moments + mass * shift, inertia + np.trace(second) * np.eye(3) - second)
        )
    return tuple(bodies)


def _effects(arm: ArmModel, theta: Floats) -> tuple[ExportedEffect, ...]:
    """Return the effects of the configuration with the identified values of their linear parameters."""
    index = {joint.name: k for k, joint in enumerate(arm.robot.joints)}
    terms = iter(_with_values(arm, theta))
    found = []
    for entry in arm.robot.effects:
        effect = of_entry(entry)
        correction = bool(of_recording(entry))
        values, units = ({}, {}) if correction else next(terms)
        found.append(
            ExportedEffect(
                effect=entry.effect,
                law=entry.law,
                title=effect.title,
                joint=index[entry.joint],
                other=None if entry.other is None else index[entry.other],
                parameters={**entry.parameters, **values},
                units=units,
                of_recording=correction,
            )
        )
    return tuple(found)


def _with_values(arm: ArmModel, theta: Floats) -> Sequence[tuple[dict[str, float], dict[str, str]]]:
    """Return values and units of the linear parameters of each term."""
    first, found = len(arm.names) - arm.e, []
    for term in effect_terms(arm):
        names = [linear.name for linear in term.linear]
        values = theta[first : first + len(names)].tolist()
        found.append((dict(zip(names, values, strict=True)), dict(zip(names, term.units, strict=True))))
        first += len(names)
    return found
