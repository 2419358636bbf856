"""Test for wiring errors before any other test: signals with the wrong sign, or of the wrong drive.

Every hypothesis (as recorded; one signal negated; two drives exchanged) is a least-squares fit to the same torques of
the motors. Friction and moments of inertia of all joints are constrained to be non-negative. Without these constraints
a model with a wrong sign would fit nearly as well; for a single axis, exactly as well.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize, stats

from armident.configs import DataError, RobotConfig
from armident.configs.schema.robot import Effect as Stanza
from armident.identify.effects.recorded import put_right
from armident.identify.effects.terms import arm_model
from armident.identify.effects.wiring import SIGNALS, exchanges
from armident.identify.experiment import Experiment
from armident.identify.identification.equations import aligned_torque, least_rows
from armident.identify.identification.sign_smoothing import with_sign_smoothing
from armident.identify.identification.solvers import decimation_of
from armident.identify.robot.arm import ArmModel
from armident.identify.signals.bandwidth import motion_bandwidth
from armident.identify.signals.decimate import Decimation, design
from armident.identify.signals.differentiate import Derivatives, differentiate

Array = NDArray[np.float64]

ALPHA = 0.01
"""Probability of a false alarm, of all hypotheses together."""

LEAST_GAIN = 2.0
"""Least sum over the drives of the logarithm of the drop of their unexplained power, for a wiring error."""

LEAST_DROP = 2.0
"""Factor by which the unexplained shares of all drives together must drop, too."""

MAX_MISTAKES = 6
BLOCKS = 30
"""Number of time intervals that are compared; within one the residual is correlated."""

WORKING_RATE = 8.0
"""Rate at which regressors are evaluated, over the cut-off of the comparison."""

POSTURES = 200
"""Postures over which moments of inertia are averaged."""

PASSES = 3
"""Iterations between parameters and the weights of the drives."""

FLOOR = 1e-6
"""Least share of a drive's torque power for a comparison."""

RIDGE = 1e-9
"""Ridge of the column-normalised normal equations: parameters that a motion does not determine stay small."""


@dataclass(frozen=True)
class WiringFinding:
    """Wiring errors that the recordings show.

    Parameters
    ----------
    stanzas
        Effect entries of a robot configuration: `armident.identify.effects.wiring.rewired` corrects them.
    words
        Meaning of each, in plain language.
    p_values
        Probability that a recording without the error favours it so consistently, corrected for all hypotheses.
    unexplained_before, unexplained_after
        Residual share of each motor's torque power with a physical model, (n,): as recorded, with all errors corrected.
    alternatives
        Other single errors that explain the recordings equally well as each, in words.
    certain
        True if the fits as recorded are so much worse that no effect of the model can be the cause.
    """

    stanzas: tuple[Stanza, ...]
    words: tuple[str, ...]
    p_values: tuple[float, ...]
    unexplained_before: Array
    unexplained_after: Array
    alternatives: tuple[tuple[str, ...], ...]
    certain: bool = True


@dataclass(frozen=True)
class _Hypothesis:
    """A wiring error: its correction of the motors' positions and torques, (n, n) each; see `exchanges`."""

    stanza: Stanza
    position: Array
    torque: Array


@dataclass(frozen=True)
class _Rows:
    """Equations of the motors for one assignment of positions.

    Parameters
    ----------
    x
        Regressors, (M, n, b).
    grams
        ``X_m' X_m``, (n, b, b).
    products
        ``X_m' y_k`` of motor m and recorded torque k, (n, n, b).
    physical
        Rows whose product with theta must not be negative: friction and moment of inertia of every joint, (3 n, b).
    """

    x: Array
    grams: Array
    products: Array
    physical: Array


@dataclass(frozen=True)
class _Fit:
    """Residual share of each recorded torque's power (n,), and the equations and parameters of the residuals."""

    shares: Array
    x: Array
    y: Array
    theta: Array
    taken: NDArray[np.int64]

    @property
    def residual(self) -> Array:
        """Residuals in the order of the recorded torques, (M, n)."""
        residual: Array = (self.y - self.x @ self.theta)[:, np.argsort(self.taken)]
        return residual

    @property
    def misfit(self) -> float:
        """Criterion of the hypotheses: twice the negative log-likelihood per sample, up to a constant."""
        return float(np.log(self.shares).sum())

    def beats(self, other: "_Fit") -> bool:
        """True if it is better by a margin that rules out the other hypothesis."""
        drop = float(other.shares.sum()) / float(self.shares.sum())
        return other.misfit - self.misfit >= LEAST_GAIN and drop >= LEAST_DROP

    def nearer(self, other: "_Fit") -> bool:
        """True if both its likelihood is higher and the unexplained power of all drives together is lower."""
        return self.misfit < other.misfit and float(self.shares.sum()) < float(other.shares.sum())


@dataclass
class _Bench:
    """Signals of the experiments, and a cache of the equations by the assignment of positions."""

    model: ArmModel
    signals: list[Derivatives]
    decimation: Decimation
    torque: Array
    made: dict[bytes, _Rows]

    def rows(self, position: Array) -> _Rows:
        """Equations with the motors' positions assigned by a signed and scaled permutation (n, n)."""
        key = np.round(position, 9).tobytes()
        if key not in self.made:
            self.made[key] = self._make(position)
        return self.made[key]

    def _make(self, position: Array) -> _Rows:
        ratios = self.model.robot.transmission_matrix
        moved = np.linalg.solve(ratios, position @ ratios).T
        to_motors = np.linalg.inv(ratios).T
        parts, postures = [], []
        for s in self.signals:
            q, qd, qdd = s.q @ moved, s.qd @ moved, s.qdd @ moved
            at_motors = to_motors @ self.decimation(self.model.rigid_regressor(q, qd, qdd))
            # Springs on the joints: their torques in phase with the motion would resemble negative inertia.
            springs = self.decimation(q)[:, None, :] * to_motors
            parts.append(np.concatenate([at_motors, springs], axis=2))
            postures.append(q)
        x = np.concatenate(parts)
        grams = np.stack([x[:, m].T @ x[:, m] for m in range(self.model.n)])
        products = np.stack([self.torque.T @ x[:, m] for m in range(self.model.n)])
        return _Rows(x, grams, products, self._physical(np.concatenate(postures)))

    def _physical(self, q: Array) -> Array:
        """See `_Rows`; moments of inertia are averaged over postures ``q``."""
        names, n = self.model.base.names, self.model.n
        out = np.zeros((3, n, len(names) + n))
        chosen = np.ascontiguousarray(q[:: max(1, q.shape[0] // POSTURES)])
        still = np.zeros_like(chosen)
        weightless = self.model.with_gravity(np.zeros(3))
        for j in range(n):
            out[0, j, names.index(f"fv{j + 1}")] = out[1, j, names.index(f"fc{j + 1}")] = 1.0
            push = still.copy()
            push[:, j] = 1.0
            out[2, j, : len(names)] = weightless.rigid_regressor(chosen, still, push)[:, j].mean(axis=0)
        return out.reshape(3 * n, -1)

    def fit(self, position: Array, torque: Array) -> _Fit:
        """Physical weighted least squares; residuals in the order and with the weights of the recorded torques.

        Parameters
        ----------
        position, torque
            Corrections of the motors' positions and torques, shape (n, n); see `exchanges`.
        """
        rows = self.rows(position)
        taken = np.abs(torque).argmax(axis=1)
        sign = torque[np.arange(self.model.n), taken]
        y = self.torque[:, taken] * sign
        power = np.maximum((y**2).sum(axis=0), 1e-300)
        weights = 1.0 / power
        right = np.stack([sign[m] * rows.products[m, k] for m, k in enumerate(taken)])
        shares, theta = np.ones(self.model.n), np.zeros(right.shape[1])
        for _ in range(PASSES):
            theta = _physical_least_squares(np.tensordot(weights, rows.grams, 1), weights @ right, rows.physical)
            left = power - 2 * right @ theta + rows.grams @ theta @ theta
            shares = np.maximum(left / power, FLOOR)
            weights = 1.0 / (shares * power)
        return _Fit(shares[np.argsort(taken)], rows.x, y, theta, taken)


def find_wiring(experiments: Sequence[Experiment], robot: RobotConfig) -> WiringFinding | None:
    """Wrong signs and exchanged drives, or ``None``.

    Wiring errors among the robot's effects are corrected first; the result is in addition to them. A single error that
    the recordings favour throughout, but by a small margin, is returned as not ``certain``. Two similar joints
    exchanged as a whole, or a missing effect, look like this.

    Parameters
    ----------
    experiments
        SI, joint side.
    robot
        The robot as configured.

    Raises
    ------
    DataError
        If the sampling rates differ.
    """
    bench = _bench(put_right(experiments, robot), robot)
    plain = robot.model_copy(update={"effects": ()})
    hypotheses = list(_singles(plain))
    position, torque = np.eye(robot.n), np.eye(robot.n)
    first = current = bench.fit(position, torque)
    found: list[Stanza] = []
    p_values: list[float] = []
    rivals: list[tuple[str, ...]] = []
    while len(found) < MAX_MISTAKES:
        fits = [(h, bench.fit(h.position @ position, h.torque @ torque)) for h in hypotheses]
        best, fitted = min(fits, key=lambda pair: pair[1].misfit)
        p = min(1.0, len(hypotheses) * _preferred(current, fitted))
        if p > ALPHA or not fitted.beats(current):
            if not found and p <= ALPHA and fitted.nearer(current):
                suspected = (_words(best.stanza, robot),)
                return WiringFinding((best.stanza,), suspected, (p,), first.shares, fitted.shares, ((),), certain=False)
            break
        equal = [
            _words(h.stanza, robot)
            for h, f in fits
            if h is not best and f.beats(current) and not fitted.beats(f) and _preferred(f, fitted) > ALPHA
        ]
        found.append(best.stanza)
        p_values.append(p)
        rivals.append(tuple(equal))
        position, torque, current = best.position @ position, best.torque @ torque, fitted
    if not found:
        return None
    words = tuple(_words(stanza, robot) for stanza in found)
    return WiringFinding(tuple(found), words, tuple(p_values), first.shares, current.shares, tuple(rivals))


def _bench(experiments: Sequence[Experiment], robot: RobotConfig) -> _Bench:
    dt = experiments[0].dt
    if any(abs(e.dt - dt) > 1e-9 * dt for e in experiments):
        raise DataError("the recordings have different sampling rates; check their wiring separately")
    bandwidth = robot.bandwidth_hz or motion_bandwidth([e.q for e in experiments], dt)
    model = arm_model(with_sign_smoothing(robot, experiments, bandwidth)).without_terms()
    wanted = decimation_of(
        "idim-ls", dt, bandwidth, None, samples=[e.q.shape[0] for e in experiments], rows=least_rows(model)
    )
    cutoff = 0.5 / (dt * wanted.factor)
    factor = max(1, int(1.0 / (dt * WORKING_RATE * cutoff)))
    first = design(dt, 0.4 / (dt * factor), factor) if factor > 1 else design(dt, 0.5 / dt, 1)
    second = design(dt * factor, cutoff, max(1, wanted.factor // factor))
    signals, torques = [], []
    to_motors = np.linalg.inv(robot.transmission_matrix)
    for e in experiments:
        s = differentiate(e.q, dt, bandwidth_hz=bandwidth)
        kept = first.instants(e.q.shape[0])
        signals.append(replace(s, q=s.q[kept], qd=s.qd[kept], qdd=s.qdd[kept], dt=dt * factor))
        torques.append(second(first(aligned_torque(e.tau) @ to_motors)))
    return _Bench(model, signals, second, np.concatenate(torques), {})


def _singles(robot: RobotConfig) -> Iterator[_Hypothesis]:
    """All single wiring errors: of a position, a torque or both, of one motor or between two."""
    names = [joint.name for joint in robot.joints]
    places: list[tuple[str, str, str | None]] = [("sign_error", name, None) for name in names]
    places += [("joint_order", one, two) for one, two in combinations(names, 2)]
    kinds = ((SIGNALS[0],), (SIGNALS[1],), SIGNALS)
    for (effect, joint, other), signals in product(places, kinds):
        stanza = Stanza(effect=effect, joint=joint, other=other, parameters={s: 1.0 for s in signals})
        yield _Hypothesis(stanza, *exchanges(robot.model_copy(update={"effects": (stanza,)})))


def _physical_least_squares(gram: Array, right: Array, physical: Array) -> Array:
    """``min theta' gram theta / 2 - right' theta`` subject to ``physical theta >= 0``, through the dual problem.

    Lawson, Hanson, Solving Least Squares Problems, 1974, chapter 23.
    """
    scale = np.sqrt(np.diag(gram))
    scale[scale == 0] = 1.0
    lower = linalg.cholesky(gram / np.outer(scale, scale) + RIDGE * np.eye(scale.size), lower=True)
    free = linalg.solve_triangular(lower, right / scale, lower=True)
    limits = linalg.solve_triangular(lower, (physical / scale).T, lower=True)
    limits /= np.maximum(np.linalg.norm(limits, axis=0), 1e-300)
    if np.any(limits.T @ free < 0):
        free = free + limits @ optimize.nnls(limits, -free)[0]
    theta: Array = linalg.solve_triangular(lower.T, free, lower=False) / scale
    return theta


def _preferred(first: _Fit, second: _Fit) -> float:
    """Probability that time intervals favour the second fit so consistently if both are equally good (Vuong 1989)."""
    gains = np.zeros(first.residual.shape[0])
    for e, f in zip(first.residual.T, second.residual.T, strict=True):
        before, after = float(np.mean(e**2)), float(np.mean(f**2))
        if before == 0.0 or after == 0.0:
            continue
        gains += 0.5 * (e**2 / before - f**2 / after + math.log(before / after))
    votes = np.array([part.sum() for part in np.array_split(gains, BLOCKS)])
    if not votes.any():
        return 1.0
    return float(stats.ttest_1samp(votes, 0.0, alternative="greater").pvalue)


def _words(stanza: Stanza, robot: RobotConfig) -> str:
    signals = " and ".join(signal for signal in SIGNALS if stanza.parameters.get(signal))
    verb = "are" if " and " in signals else "is"
    if stanza.effect == "joint_order":
        plural = "s of" if " and " not in signals else " of"
        return f"{signals}{plural} the drives of {stanza.joint} and {stanza.other} are exchanged"
    words = f"{signals} of the drive of {stanza.joint} {verb} read with the wrong sign"
    if " and " in signals:
        words += ": the joint turns opposite to its configured direction"
    return words
