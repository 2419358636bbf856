"""Zero of an encoder that is another one than that of the model: a constant error of one joint's position.

It turns the links beyond the joint against those before it. Their own parameters take up most of that, but not the
place of the next axes, which the configuration states. The first joint's zero is invisible, as gravity does not change.
"""

from dataclasses import dataclass, replace

import numpy as np

from armident.arrays import Array
from armident.configs import RobotConfig
from armident.configs.schema.robot import Effect
from armident.identify.effects.wiring import PositionOffset
from armident.identify.setup.bench import Bench
from armident.identify.setup.calibration import CORRECTED
from armident.identify.setup.fit import Hypothesis, fit, held_out, regressors
from armident.identify.setup.limited_least_squares import RIDGE
from armident.identify.setup.plausible import LEAST_ODDS
from armident.identify.setup.prior import MISTAKE
from armident.identify.setup.result import SetupFinding
from armident.identify.setup.search import LEAST_DROP, independent_rows

LEAST = float(np.radians(1.0))
"""Least offset that is a mistake, rad: homing marks and stands are right within a degree."""

MOST = float(np.radians(35.0))
"""Largest step, rad: beyond it the torque is not linear in the position."""

STEP = 1e-3
"""Half the difference of positions for derivatives of the torque, rad."""

STEPS = 4
"""Gauss-Newton steps: the torque is a sine of the position, of which each step leaves the cube of the error."""

SETTLED = float(np.radians(0.05))
"""Step, rad, that ends these steps."""

CANDIDATES = 3
"""Joints whose offset is found exactly, of those that the first step prefers."""

RIGHT = 0.97
"""Share of right findings: 94 of 95 on development arms, 2 of them by a rival (``tests.evaluation.setup_zeros``)."""

SEEN = 1e-6
"""Share of the torque's change by an offset that the other parameters leave, below which it is rounding."""


@dataclass(frozen=True)
class ZeroOffset:
    """True less recorded position of a joint, rad, with its standard deviation, and the bench with it corrected.

    ``gain``: of the held-out score by it, nats; ``rivals``: joints whose offset explains nearly as much.
    """

    joint: int
    offset: float
    std: float
    gain: float
    probability: float
    rivals: tuple[int, ...]
    bench: Bench

    def entry(self, robot: RobotConfig) -> Effect:
        """Return the entry of ``effects`` that corrects the recordings."""
        value = float(f"{self.offset:.4g}")
        return Effect(effect=PositionOffset.name, joint=robot.joints[self.joint].name, parameters={"offset": value})

    @property
    def certain(self) -> bool:
        """True if the correction may be applied."""
        return self.probability > CORRECTED

    def finding(self, robot: RobotConfig, remedy: str) -> SetupFinding:
        """Return the mistake in words. ``remedy``: line of the configuration that corrects it, or the next step."""
        names = [joint.name for joint in robot.joints]
        rivals = f"; or that of {', '.join(names[j] for j in self.rivals)}" if self.rivals else ""
        message = (
            f"the zero of {names[self.joint]} is another one than the model's: the true position is "
            f"{np.degrees(self.offset):+.3g} degrees off the recorded one (standard deviation "
            f"{np.degrees(self.std):.2g}){rivals}"
        )
        return SetupFinding(
            PositionOffset.name, (names[self.joint],), self.probability, message, remedy, False, self.certain
        )


def zero_offset(bench: Bench, h: Hypothesis) -> ZeroOffset | None:
    """Return the offset of one revolute joint that explains the recordings, ``None`` without one.

    It gains the odds and the drop of any mistake over the set-up ``h``, with its prior, on held-out data.
    """
    revolute = np.array([joint.type == "revolute" for joint in bench.robot.joints])
    steps, gains, _ = _steps(bench, h)
    price = MISTAKE + float(np.log(bench.n))
    gains = np.where(revolute & bench.moving, gains, 0.0)
    chosen = [int(j) for j in np.argsort(-gains)[:CANDIDATES] if gains[j] > LEAST_ODDS + price]
    before = held_out(bench, h)[bench.moving] if chosen else np.zeros(0)
    found = []
    for j in chosen:
        offset, std, other = _exact(bench, h, j, float(steps[j]))
        drops = np.log(before / held_out(other, h)[bench.moving])
        rows = independent_rows(fit(other, h).residual)[bench.moving]
        if abs(offset) >= LEAST and drops.sum() >= LEAST_DROP:
            found.append(ZeroOffset(j, offset, std, float(0.5 * rows @ drops) - price, 0.0, (), other))
    found.sort(key=lambda one: -one.gain)
    if not found or found[0].gain < LEAST_ODDS:
        return None
    best = found[0]
    odds = [float(np.exp(min(one.gain - best.gain, 0.0))) for one in found[1:]]
    rivals = tuple(one.joint for one, ratio in zip(found[1:], odds, strict=True) if ratio > np.exp(-LEAST_ODDS))
    return replace(best, probability=RIGHT / (1.0 + sum(odds) + float(np.exp(-best.gain))), rivals=rivals)


def _exact(bench: Bench, h: Hypothesis, j: int, step: float) -> tuple[float, float, Bench]:
    """Offset of a joint, its standard deviation, and the bench with it."""
    offsets = np.zeros(bench.n)
    other, std = bench, np.inf
    for _ in range(STEPS):
        offsets[j] += np.clip(step, -MOST, MOST)
        other = bench.moved(offsets)
        steps, _, stds = _steps(other, h)
        step, std = float(steps[j]), float(stds[j])
        if abs(step) < SETTLED:
            break
    return float(offsets[j]), std, other


def _steps(bench: Bench, h: Hypothesis) -> tuple[Array, Array, Array]:
    """Gauss-Newton step of each joint's offset alone, rad, its gain of the score, nats, and its deviation, (n,) each.

    All parameters are free beside it; every joint counts by the power of its own residual.
    """
    found, x = fit(bench, h), regressors(bench, h)
    residual = found.residual @ h.torque.T
    weights = np.where(bench.moving, 1.0 / np.maximum((residual**2).mean(axis=0), 1e-300), 0.0)
    rows = float(independent_rows(residual)[bench.moving].mean()) / residual.shape[0]
    gram = sum(w * a.T @ a for w, a in zip(weights, x, strict=True))
    scale = np.sqrt(np.diag(gram))
    scale[scale <= 1e-12 * scale.max()] = np.inf
    lower = np.linalg.cholesky(gram / np.outer(scale, scale) + RIDGE * np.eye(scale.size))
    slopes = bench.slopes(h.position, h.gravity * h.clock**2, found.theta, STEP)
    # What the parameters leave of the residual and of each slope, by the joints' weights.
    series = np.concatenate([residual.T[None], slopes])
    products = np.einsum("m,mkc,smk->sc", weights, x, series) / scale
    inner = np.linalg.solve(lower, products.T)
    left = np.einsum("m,smk,tmk->st", weights, series, series) - inner.T @ inner
    information, seen = np.diag(left)[1:].copy(), np.einsum("m,smk->s", weights, slopes**2)
    information[information <= SEEN * np.maximum(seen, 1e-300)] = np.inf
    steps = left[0, 1:] / information
    return steps, 0.5 * rows * left[0, 1:] * steps, np.sqrt(1.0 / (rows * information))
