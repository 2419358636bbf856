"""Hidden effects of random arms: physics and readings, with laws that are not the formulas of the catalogue."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tests.evaluation.plants.arm import PRISMATIC_SCALE, Generator
from tests.evaluation.plants.motions import Motion
from tests.evaluation.plants.plant import Plant, with_entry, with_law
from tests.evaluation.plants.slots import COULOMB, VISCOUS

Floats = NDArray[np.float64]
Range = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Place:
    """Joint of an effect, and the motion there.

    ``motion``: reference of the recording to learn from; ``peak``: largest torque of the healthy arm at each joint,
    N m or N, shape (n,).
    """

    joint: int
    motion: Motion
    peak: Floats


class Shapes:
    """Draws the numbers that shape a law; two objects of one seed draw the same.

    ``wider``: factor by which the ranges of the laws are extended at both ends.
    """

    def __init__(self, seed: Sequence[int], wider: float) -> None:
        self.generator, self._wider = np.random.default_rng(seed), wider

    def between(self, low: float, high: float) -> float:
        """Draw a number of the range, extended for this half of the suite.

        ``low``, ``high``: ends of the range; a range about zero is extended in both directions.
        """
        wider = self._wider
        return float(self.generator.uniform(low / wider if low > 0.0 else low * wider, high * wider))

    def angle(self) -> float:
        """Draw an angle of the full circle, rad."""
        return float(self.generator.uniform(0.0, 2.0 * np.pi))

    def one_of(self, values: Sequence[float]) -> float:
        """Draw one of some values."""
        return float(self.generator.choice(values))


Apply = Callable[[Plant, Place, float, Shapes], Plant]
"""Plant with an effect of a strength."""


@dataclass(frozen=True)
class HiddenEffect:
    """A hidden effect.

    ``apply``: adds the effect to a plant. ``strengths``: smallest and largest strength; 1 is typical. ``pair``:
    ``True`` if the effect is between the joint and the next one. ``arm``: ``True`` if the effect belongs to the whole
    arm.
    """

    apply: Apply
    strengths: Range = (0.02, 4.0)
    pair: bool = False
    arm: bool = False


def _metre(plant: Plant, j: int) -> float:
    return PRISMATIC_SCALE if plant.arm.prismatic[j] else 1.0


def _stribeck(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    speed, law = draw.between(0.02, 0.12) * plant.arm.speed[j], draw.generator.integers(2)
    amount = s * 0.5 * max(plant.laws[j, COULOMB], 0.1 * plant.arm.scale[j])
    return with_law(plant, j, stribeck=amount, stribeck_velocity=speed, stribeck_law=float(law))


def _tight_spot(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    low, high = np.percentile(at.motion.position[:, j], [15.0, 85.0])
    amount = s * 0.8 * max(plant.laws[j, COULOMB], 0.1 * plant.arm.scale[j])
    width = draw.between(0.06, 0.3) * _metre(plant, j)
    return with_law(plant, j, tight=amount, tight_position=float(draw.generator.uniform(low, high)), tight_width=width)


def _fastest_order(plant: Plant, j: int) -> float:
    """Largest order, per rad or m, whose ripple at full speed is sampled six times a period."""
    sampling = 1.0 / (plant.step * plant.every)
    return 2.0 * np.pi * min(sampling / 6.0, 1.0 / (25.0 * plant.step)) / float(plant.arm.speed[j])


def _ripple_joint(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    top = min(_fastest_order(plant, j), 60.0 / _metre(plant, j))
    order = np.exp(draw.generator.uniform(np.log(min(6.0 / _metre(plant, j), 0.5 * top)), np.log(top)))
    amount = s * 0.15 * plant.arm.scale[j]
    return with_law(plant, j, ripple=amount, ripple_order=float(order), ripple_phase=draw.angle())


def _ripple_motor(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    ratio, top = float(plant.arm.ratio[j]), _fastest_order(plant, j)
    whole = [k for k in (1, 2, 3, 4, 6) if k * ratio <= top]
    # Too slow a rate for a turn of the motor: a stage of the gear before it.
    order = ratio * (draw.one_of(whole) if whole else min(top / ratio, 1.0) * draw.between(0.4, 0.9))
    amount = s * 0.15 * plant.arm.scale[j]
    return with_law(plant, j, ripple=amount, ripple_order=order, ripple_phase=draw.angle())


def _spring(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j, metre = at.joint, _metre(plant, at.joint)
    stiffness = s * 0.25 * plant.arm.scale[j] / metre
    centre = draw.between(-0.3, 0.3) * metre
    cubic = stiffness * draw.between(0.5, 2.0) / metre**2
    return with_law(plant, j, spring=stiffness, spring_cubic=cubic, spring_position=centre)


def _one_sided_viscosity(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    amount = s * 0.3 * plant.arm.scale[j] / plant.arm.speed[j]
    return with_law(plant, j, viscous_forward=amount)


def _more_friction(plant: Plant, j: int, least: float) -> Plant:
    """Plant whose friction at a joint is at least a share of the torque scale, so that its change is visible."""
    scale, speed = plant.arm.scale[j], plant.arm.speed[j]
    dry, viscous = max(plant.laws[j, COULOMB], least * scale), max(plant.laws[j, VISCOUS], least * scale / speed)
    return with_law(plant, j, coulomb=dry, viscous=viscous)


def _warming_with_work(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    plant = _more_friction(plant, j, 0.2)
    rate = np.abs(at.motion.velocity[:, j])
    work = plant.step * float(np.sum(rate * (plant.laws[j, VISCOUS] * rate + plant.laws[j, COULOMB])))
    return with_law(plant, j, work_drop=min(0.45 * s, 0.95), work_scale=work * draw.between(0.2, 0.8))


def _warming_with_time(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    plant = _more_friction(plant, j, 0.2)
    duration = plant.step * at.motion.position.shape[0]
    return with_law(plant, j, time_drop=min(0.6 * s, 1.2), time_scale=duration * draw.between(0.2, 0.8))


def _curved_viscosity(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    power = draw.one_of([draw.between(0.35, 0.55), draw.between(1.7, 2.5)])
    return with_law(plant, j, curve=s * 0.6 * plant.arm.scale[j], curve_velocity=plant.arm.speed[j], curve_power=power)


def _load_friction(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    return with_law(plant, j, load=0.2 * s, load_knee=draw.between(0.05, 0.3) * plant.arm.scale[j])


def _presliding(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    plant = with_law(plant, j, coulomb=max(plant.laws[j, COULOMB], 0.15 * plant.arm.scale[j]))
    return with_law(plant, j, presliding=s * draw.between(0.01, 0.03) * _metre(plant, j))


def _pair_friction(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    i, j = at.joint, at.joint + 1
    scale = min(plant.arm.scale[i], plant.arm.scale[j])
    viscous = s * draw.between(0.1, 0.3) * scale / max(plant.arm.speed[i], plant.arm.speed[j])
    row = np.array([[i, j, viscous, s * draw.between(0.1, 0.3) * scale]])
    return replace(plant, pairs=np.vstack([plant.pairs, row]))


def _link_inertia(plant: Plant, j: int) -> float:
    return float(plant.arm.diagonal[j] - plant.arm.rotor[j])


def _elastic_gear(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j, inertia = at.joint, _link_inertia(plant, at.joint)
    stiffness = inertia * (2.0 * np.pi * draw.between(18.0, 35.0)) ** 2 / s
    twist = 3.0 * plant.arm.scale[j] / stiffness
    damping = 2.0 * draw.between(0.03, 0.12) * np.sqrt(stiffness * inertia)
    row = np.array([[j, stiffness, stiffness * draw.between(0.0, 0.8) / twist**2, damping, 0.0]])
    return replace(plant, gears=np.vstack([plant.gears, row]))


def _play(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    inertia = 1.0 / (1.0 / _link_inertia(plant, j) + 1.0 / plant.arm.rotor[j])
    stiffness = inertia * (2.0 * np.pi * draw.between(80.0, 140.0)) ** 2
    damping = 2.0 * draw.between(0.15, 0.4) * np.sqrt(stiffness * inertia)
    row = np.array([[j, stiffness, 0.0, damping, 0.5 * s * 4e-3 * _metre(plant, j)]])
    return replace(plant, gears=np.vstack([plant.gears, row]))


def _soft_saturation(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    return with_entry(plant, "saturation", at.joint, float(at.peak[at.joint]) / s)


def _gain_error(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    return with_entry(plant, "gain", at.joint, 1.0 + max(draw.one_of([-1.0, 1.0]) * 0.15 * s, -0.6))


def _torque_delay(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    return with_entry(plant, "delay", at.joint, 5e-3 * s)


def _slow_actuator(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    return with_law(plant, at.joint, lag=3e-3 * s)


def _eccentric_encoder(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j, metre = at.joint, _metre(plant, at.joint)
    order = draw.one_of([1.0, 2.0, draw.between(2.0, 8.0)]) / metre
    phase = draw.angle()
    return with_law(plant, j, eccentricity=6e-3 * s / order, eccentricity_order=order, eccentricity_phase=phase)


def rotated(gravity: Floats, axis: Floats, angle: float) -> Floats:
    """Vector rotated about a unit axis (Rodrigues).

    ``gravity``: vector, shape (3,); ``axis``: unit axis, shape (3,); ``angle``: rad.
    """
    return np.asarray(
        gravity * np.cos(angle)
        + np.cross(axis, gravity) * np.sin(angle)
        + axis * (axis @ gravity) * (1.0 - np.cos(angle))
    )


def _tilted_base(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    heading = draw.angle()
    axis = np.array([np.cos(heading), np.sin(heading), 0.0])
    return replace(plant, arm=replace(plant.arm, gravity=rotated(plant.arm.gravity, axis, 0.1 * s)))


def _bursts(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    amount, rate, width = s * 0.5 * plant.arm.scale[at.joint], draw.between(0.6, 2.0), draw.between(0.01, 0.06)

    def torque(own: Generator, t: Floats) -> Floats:
        out = np.zeros_like(t)
        for centre in own.uniform(0.0, t[-1], own.poisson(rate * t[-1])):
            out += own.normal() * amount * np.exp(-0.5 * ((t - centre) / (width * own.uniform(0.5, 2.0))) ** 2)
        return out

    return replace(plant, external=plant.external | {at.joint: torque})


def _unrecorded(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    """Torque that follows a signal that no recording holds: slow random process with a cut-off."""
    amount, cutoff = s * 0.2 * plant.arm.scale[at.joint], draw.between(0.3, 2.5)

    def torque(own: Generator, t: Floats) -> Floats:
        rates = np.linspace(0.05, 1.0, 25) * cutoff
        phases, sizes = own.uniform(0.0, 2.0 * np.pi, rates.size), own.normal(size=rates.size)
        moved = rates * own.uniform(0.9, 1.1, rates.size)
        out = np.sin(2.0 * np.pi * t[:, None] * moved + phases) @ sizes
        return np.asarray(amount * out / np.sqrt(0.5 * rates.size))

    return replace(plant, external=plant.external | {at.joint: torque})


def _vibration(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    sampling = 1.0 / (plant.step * plant.every)
    amount, frequency = s * 0.15 * plant.arm.scale[at.joint], draw.between(12.0, min(70.0, sampling / 6.0))

    def torque(own: Generator, t: Floats) -> Floats:
        swell = 1.0 + 0.4 * np.sin(2.0 * np.pi * own.uniform(0.2, 0.6) * t + own.uniform(0.0, 6.0))
        return np.asarray(amount * swell * np.sin(2.0 * np.pi * frequency * t + own.uniform(0.0, 6.0)))

    return replace(plant, external=plant.external | {at.joint: torque})


def _offset_steps(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    amount, rate = s * 0.2 * plant.arm.scale[at.joint], draw.between(0.3, 1.0)

    def torque(own: Generator, t: Floats) -> Floats:
        out = np.zeros_like(t)
        for begin in own.uniform(0.0, t[-1], 1 + own.poisson(rate * t[-1])):
            out[t >= begin] = amount * own.normal()
        return out

    return replace(plant, external=plant.external | {at.joint: torque})


def _slosh(plant: Plant, at: Place, s: float, draw: Shapes) -> Plant:
    j = at.joint
    return with_law(
        plant,
        j,
        slosh=min(0.25 * s, 1.0) * _link_inertia(plant, j),
        slosh_frequency=draw.between(0.7, 3.0),
        slosh_damping=draw.between(0.02, 0.1),
    )


NAMED: dict[str, HiddenEffect] = {
    "stribeck_law": HiddenEffect(_stribeck),
    "tight_spot": HiddenEffect(_tight_spot),
    "ripple_joint": HiddenEffect(_ripple_joint),
    "ripple_motor": HiddenEffect(_ripple_motor),
    "stiffening_spring": HiddenEffect(_spring),
    "one_sided_viscosity": HiddenEffect(_one_sided_viscosity),
    "warming_with_work": HiddenEffect(_warming_with_work, (0.05, 2.1)),
    "warming_with_time": HiddenEffect(_warming_with_time, (0.05, 2.0)),
    "curved_viscosity": HiddenEffect(_curved_viscosity),
    "load_friction": HiddenEffect(_load_friction, (0.02, 3.0)),
    "presliding": HiddenEffect(_presliding, (0.05, 12.0)),
    "pair_friction": HiddenEffect(_pair_friction, pair=True),
    "elastic_gear": HiddenEffect(_elastic_gear, (0.05, 6.0)),
    "play": HiddenEffect(_play, (0.05, 15.0)),
    "soft_saturation": HiddenEffect(_soft_saturation, (0.05, 2.0)),
    "gain_error": HiddenEffect(_gain_error, (0.05, 5.0)),
    "torque_delay": HiddenEffect(_torque_delay, (0.05, 6.0)),
    "slow_actuator": HiddenEffect(_slow_actuator, (0.05, 6.0)),
    "eccentric_encoder": HiddenEffect(_eccentric_encoder, (0.02, 6.0)),
    "tilted_base": HiddenEffect(_tilted_base, (0.05, 4.0), arm=True),
}
"""Hidden effects that the catalogue has a name for."""

OUTSIDE: dict[str, HiddenEffect] = {
    "torque_bursts": HiddenEffect(_bursts),
    "unrecorded_signal": HiddenEffect(_unrecorded),
    "vibration": HiddenEffect(_vibration),
    "offset_steps": HiddenEffect(_offset_steps),
    "slosh": HiddenEffect(_slosh),
}
"""Hidden effects outside the catalogue."""
