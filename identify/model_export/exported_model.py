"""An identified model with physically consistent link parameters, as the writers of all formats take it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armident.configs import DataError, RobotConfig, load_robot
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.effects.recording_corrections import of_recording
from armident.identify.effects.registry import of_entry
from armident.identify.effects.terms import effect_terms
from armident.identify.identification.checks.excitation import workspace_postures
from armident.identify.identification.robot_model import RobotModel
from armident.identify.identification.saved_model import load_model
from armident.identify.model_export.link_frames import LinkFrames, mdh_link_frames
from armident.identify.model_export.source_urdf import SourceUrdf, known_bodies, source_for, source_frames, source_of
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.chain import Floats
from armident.identify.robot.consistent import ConsistentParameters, nearest_consistent, pseudo_inertias
from armident.identify.robot.known_bodies import nearest_to_known

IMPOSSIBLE = (
    "look for the effect with armident diagnose RECORDING and identify with the model it writes, "
    "or export the nearest physical arm with --nearest"
)
"""Next step where no physical arm has the parameters."""

BALL_KG, BALL_RADIUS_M = 1e-3, 1e-2
"""Mass and radius of a ball at the origin of every exported link's frame: simulators refuse links without mass or
extent. No link of an arm is smaller, and no recording shows a gram."""

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
class ExportedFriction:
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
    configuration
        Path or name of the robot configuration that was given; empty: that of the document.
    choice
        Rule for the parameters that torques leave open, in words.
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
    joints: tuple[ExportedFriction, ...]
    couplings: tuple[JointCoupling, ...]
    effects: tuple[ExportedEffect, ...]
    source_urdf: SourceUrdf | None = None
    configuration: str = ""
    choice: str = "the lightest physical arm"

    @property
    def theta(self) -> Floats:
        """Exported standard parameters (p,), those of the effects last, in modified Denavit-Hartenberg frames."""
        return self.consistent.theta

    @property
    def model(self) -> RobotModel:
        """The model as ``import armident`` offers it, with the exported parameters."""
        return RobotModel(self.robot, self.theta)

    @property
    def recorded_s(self) -> float:
        """Duration of all recordings of the identification, s: the time unit of slow changes."""
        used = (self.document.recording, *(self.document.further_recordings or ()))
        return float(sum(each.samples / each.sample_rate_hz for each in used))

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
        """Return the model with links and joints in the frames and with the names of a URDF and its chain, ``source``.

        Raises ConfigError if the URDF cannot be read, or has another geometry than the configuration.
        """
        frames = source_frames(source, self.robot)
        moved, known = self, known_bodies(source, self.arm, frames)
        if known is not None:
            theta = nearest_to_known(self.arm, self.theta, known, SMALLEST_LINK)
            smallest = np.asarray(np.linalg.eigvalsh(pseudo_inertias(self.arm, theta))[:, 0], dtype=np.float64)
            consistent = replace(self.consistent, theta=theta, smallest_eigenvalues=smallest)
            choice = f"the physical arm nearest to the masses in {source.file.name}"
            moved = replace(self, consistent=consistent, couplings=_couplings(self.arm, theta), choice=choice)
        links, joints = _bodies(self.arm, moved.theta, frames), _joints(self.arm, moved.theta, frames)
        return replace(moved, frames=frames, links=links, joints=joints, source_urdf=source)


def load_exported_model(
    path: str | Path,
    robot: RobotConfig | str | Path | None = None,
    urdf: str | Path | None = None,
    *,
    nearest: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> ExportedModel:
    """Read an identification and compute the physically consistent arm.

    Parameters
    ----------
    path
        ``identification.json``, ``diagnosis.json``, or the folder of one of them. The structure that a diagnosis found
        is identified from its recordings (`armident.identify.identification.saved_model.load_model`).
    robot
        Configuration, or its path or shipped name; ``None``: that of the document.
    urdf
        URDF that the geometry comes from, whose frames and names the file takes; ``None``: the one that the
        configuration names, if it names one.
    nearest
        True to accept the nearest physical arm where the estimate differs significantly from every physical one.
    progress
        Called with the name of a stage and the share done, 0 to 1, while a diagnosed structure is identified.

    Raises
    ------
    ConfigError
        If a file is missing, there is no configuration, or the URDF is of another arm.
    DataError
        If the identification is unusable or of another configuration, or no physical arm has these parameters.
    """
    given = load_robot(robot, "identify") if isinstance(robot, str | Path) else robot
    saved = load_model(Path(path), given, progress=progress)
    source = source_of(robot) if isinstance(robot, str | Path) and urdf is None else None
    if urdf is not None:
        source = source_for(saved.robot, Path(urdf))
    model = exported_model(saved, nearest=nearest)
    if isinstance(robot, str | Path):
        model = replace(model, configuration=str(robot))
    return model if source is None else model.in_frames_of(source)


def exported_model(saved: RobotModel, *, nearest: bool = False) -> ExportedModel:
    """Compute the physically consistent arm of an identification.

    Parameters
    ----------
    saved
        The identified model.
    nearest
        As in `load_exported_model`.

    Raises
    ------
    DataError
        If no physical arm has these parameters, or couplings make its inertia negative.
    """
    arm, robot, theta, covariance = saved.arm, saved.robot, saved.theta, saved.covariance
    consistent = nearest_consistent(arm, theta, covariance, SMALLEST_LINK)
    if not consistent.compatible and not nearest:
        raise DataError(f"{saved.path}: {consistent.verdict}; next: {IMPOSSIBLE}")
    _refuse_negative_inertia(arm, consistent.theta, saved.path)
    frames = mdh_link_frames(robot)
    return ExportedModel(
        source=saved.path,
        robot=robot,
        document=saved.document,
        arm=arm,
        theta_base=theta,
        std=np.sqrt(np.diag(covariance)),
        consistent=consistent,
        frames=frames,
        links=_bodies(arm, consistent.theta, frames),
        joints=_joints(arm, consistent.theta, frames),
        couplings=_couplings(arm, consistent.theta),
        effects=_effects(arm, consistent.theta),
    )


def _refuse_negative_inertia(arm: ArmModel, theta: Floats, source: Path) -> None:
    """Refuse couplings that are larger than the rotor inertias and links which they couple."""
    turns = np.full((2, arm.n), np.pi) * [[-1.0], [1.0]]
    smallest = np.linalg.eigvalsh(arm.mass_matrix(theta, workspace_postures(arm.robot, turns)))[:, 0]
    if smallest.min() <= 0.0:
        names = ", ".join(coupling.name for coupling in arm.robot.couplings)
        raise DataError(
            f"{source}: the inertia of coupling {names} is larger than those that it couples: the mass matrix is not "
            f"positive definite at {100 * np.mean(smallest <= 0.0):.0f} % of the postures; next: record a motion with "
            "more acceleration of both joints, or identify without the coupling"
        )


def _joints(arm: ArmModel, theta: Floats, frames: LinkFrames) -> tuple[ExportedFriction, ...]:
    """Return rotor inertias and friction of the joints, with their names in the file."""
    values = arm.values(theta)
    rows = np.stack([values.ia, values.fv, values.fc, values.off], axis=1).tolist()
    types = [joint.type for joint in arm.robot.joints]
    return tuple(ExportedFriction(name, kind, *row) for name, kind, row in zip(frames.joints, types, rows, strict=True))


def _couplings(arm: ArmModel, theta: Floats) -> tuple[JointCoupling, ...]:
    """Return the couplings of the configuration."""
    values = arm.values(theta)
    rows = zip(arm.robot.couplings, values.coupling_joints.tolist(), values.coupling.tolist(), strict=True)
    return tuple(JointCoupling(coupling.name, (i, j), *three) for coupling, (i, j), three in rows)


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
