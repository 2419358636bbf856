"""Reference of the recursive estimator: an identification of the arm, and the widths of the random walk."""

import hashlib
import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array
from armident.configs import ConfigError, DataError, RobotConfig
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.torque_delay import HELD
from armident.identify.monitoring.recursive.kernels import solve
from armident.identify.monitoring.recursive.settings import RecursiveSettings
from armident.identify.robot.arm import ArmModel

FRICTION = ("fv", "fc", "off")
"""Names of the friction parameters of a joint."""
TYPICAL_SPEED = 0.25
"""Speed at which friction torques are compared, in velocity limits."""
WIDE = 10.0
"""Prior standard deviation of friction in the estimate of one window, in friction torques: no restriction."""
NARROW = 0.1
"""The same for offsets and couplings: their changes show in the friction of the joints."""
MASS_PRIOR = 0.05
"""Prior relative standard deviation of the other parameters in one window: few are determined within seconds."""
KNOWN_LEAD = 0.25
"""Largest standard deviation of a joint's torque lead that counts, samples: half a sample is known by a factor of 2."""
SHORTEST_SHIFT, LONGEST_SHIFT = 0.1, 1.0
"""Differences from a held torque that are aligned, samples. Shorter ones are errors of interpolation."""

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Reference:
    """Parameters that friction is compared with, and how far they may move; SI. -1 in an index: none.

    ``walk`` (b,): variance per second of motion; ``window_precision`` (b, b): prior of a window; ``friction`` (n, 2).
    """

    model: ArmModel
    theta: Array
    covariance: Array
    walk: Array
    window_precision: Array
    friction: NDArray[np.int64]
    place: NDArray[np.int64]
    torque_lead: float = HELD

    @property
    def digest(self) -> str:
        """SHA-256 of the values, their covariance and the torque lead."""
        lead = np.float64(self.torque_lead).tobytes()
        return hashlib.sha256(self.theta.tobytes() + self.covariance.tobytes() + lead).hexdigest()

    @property
    def robot_digest(self) -> str:
        """SHA-256 of the configuration of the robot."""
        return hashlib.sha256(self.model.robot.model_dump_json(by_alias=True).encode()).hexdigest()


def torque_lead(document: IdentificationDocument) -> float:
    """Number of samples by which the torque leads the position, of all joints together.

    Torque is held (0.5), unless joints agree, within three standard deviations, on a lead that differs by 0.1 to 1. The
    joints that count know it to a quarter; the limits are those of the check of the set-up.
    """
    found = np.array(list((document.torque_delay_samples or {}).values())).reshape(-1, 2)
    samples, std = found[np.isfinite(found).all(axis=1) & (found[:, 1] <= KNOWN_LEAD) & (found[:, 1] > 0)].T
    if samples.size < 2:
        return HELD
    # The median: one joint in five may have a cause of its own, such as a slow actuator.
    lead, own = float(np.median(samples)), float(np.median(std))
    near = np.abs(samples - lead) <= 3.0 * std
    shift = abs(lead - HELD)
    if 2 * near.sum() <= samples.size or shift <= 3.0 * own or shift < SHORTEST_SHIFT:
        return HELD
    if shift > LONGEST_SHIFT:
        log.warning("the torque leads the position by %.2g samples: too many to be aligned on the stream", lead)
        return HELD
    return lead


def reference_from(document: IdentificationDocument, robot: RobotConfig, settings: RecursiveSettings) -> Reference:
    """Reference of an identification; ConfigError for effects in the configuration, DataError if it does not suit."""
    if robot.effects:
        raise ConfigError(f"robot {robot.name!r} has effects: armident watch needs a configuration without them")
    if document.robot != robot.name:
        raise DataError(f"the reference is of robot {document.robot!r}, the recording of {robot.name!r}")
    if document.verdict == "unusable":
        raise DataError("the reference is unusable by its own verdict: identify a recording that supports one")
    smoothing = document.sign_smoothing
    if smoothing is not None and set(smoothing) == {joint.name for joint in robot.joints}:
        friction = robot.friction.model_copy(
            update={"sign_smoothing": tuple(smoothing[joint.name] for joint in robot.joints)}
        )
        robot = robot.model_copy(update={"friction": friction})
    model = ArmModel.from_config(robot)
    found = {parameter.name: parameter.value for parameter in document.parameters}
    if set(found) != set(model.base.names):
        different = sorted(set(found) ^ set(model.base.names))
        raise DataError(f"the reference has other parameters than the robot ({', '.join(different[:5])})")
    order = [[p.name for p in document.parameters].index(name) for name in model.base.names]
    theta = np.array([found[name] for name in model.base.names])
    covariance = np.asarray(document.covariance, dtype=np.float64)[np.ix_(order, order)]
    made = _reference(model, theta, 0.5 * (covariance + covariance.T), settings)
    return replace(made, torque_lead=torque_lead(document))


def _reference(model: ArmModel, theta: Array, covariance: Array, settings: RecursiveSettings) -> Reference:
    names, b = model.base.names, model.base.b
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    friction = np.full((model.n, 2), -1)
    place = np.full(b, -1)
    minute = settings.mass_walk * (np.abs(theta) + std)
    prior = MASS_PRIOR * np.abs(theta) + 2.0 * std
    places: dict[str, tuple[int, ...]] = {str(j + 1): (j,) for j in range(model.n)}
    joints = [joint.name for joint in model.robot.joints]
    places |= {c.name: tuple(joints.index(name) for name in c.joints) for c in model.robot.couplings}
    for number, members in places.items():
        speed = TYPICAL_SPEED * min(model.robot.joints[j].limits.velocity for j in members)
        index = {kind: names.index(kind + number) for kind in FRICTION if kind + number in names}
        torque = sum(abs(theta[k]) * (speed if kind == "fv" else 1.0) for kind, k in index.items() if kind != "off")
        for kind, k in index.items():
            width = torque / (speed if kind == "fv" else 1.0)
            minute[k] = settings.friction_walk * width
            own = len(members) == 1 and kind != "off"
            prior[k] = WIDE * width if own else NARROW * width + 2.0 * std[k]
            if len(members) == 1:
                place[k] = members[0]
        if len(members) == 1:
            friction[members[0]] = index.get("fv", -1), index.get("fc", -1)
    precision = _inverse(covariance + np.diag(np.maximum(prior, 1e-12) ** 2))
    return Reference(model, theta, covariance, minute**2 / 60.0, precision, friction, place)


def _inverse(matrix: Array) -> Array:
    """Inverse of a covariance, scaled to its diagonal."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse = np.eye(scale.size)
    solve(matrix * np.outer(scale, scale), inverse)
    scaled: Array = 0.5 * (inverse + inverse.T) * np.outer(scale, scale)
    return scaled
