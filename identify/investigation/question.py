"""The next motion: the one that tells the rivals apart most per second of robot time (T-optimality).

For two models that are linear in their extra parameters, the expected log Bayes factor of a motion is half the squared
norm, whitened, of the one's prediction after projection on the other's columns (Box, Hill 1967, Technometrics 9(1);
Atkinson, Fedorov 1975, Biometrika 62(1)). The expected fall of the entropy follows from those of all pairs (Kolchinsky,
Tracey 2017, Entropy 19(7), equation 10).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from armident.arrays import Array
from armident.configs import Trajectory
from armident.identify.diagnosis.excess import about_reversals
from armident.identify.diagnosis.model_state import ModelState
from armident.identify.diagnosis.stretch import moving_rows
from armident.identify.excitation.point_to_point import sample_trajectory
from armident.identify.investigation.rivals import Rival
from armident.identify.regression.whitening import whitened
from armident.identify.robot.motion import Motion
from armident.identify.signals.differentiate import differentiate
from armident.identify.signals.experiments import Experiment

SINGULAR = 1e-10
"""Eigenvalue of normalised information over the largest below which a direction is not determined."""
SAMPLES = 20_000
"""Most samples of a motion whose columns are computed at a time: 0.1 GB for seven axes and eighty columns."""
MOST = 50.0
"""Log Bayes factor, nats, that counts as certain: no model of an arm is right to more."""


@dataclass(frozen=True, eq=False)
class Question:
    """Rivals at one joint; ``columns`` of each in the regressor of all; ``information`` (c, c) of the recordings."""

    state: ModelState
    rivals: tuple[Rival, ...]
    columns: tuple[slice, ...]
    information: Array

    @property
    def probabilities(self) -> Array:
        """Probabilities of the rivals, whose sum is one."""
        p = np.array([one.probability for one in self.rivals])
        return np.asarray(p / p.sum())

    def gain(self, trajectory: Trajectory) -> float:
        """Return the expected fall of the entropy by a recording of a motion, nats."""
        return self._gain(*sample_trajectory(trajectory, self.state.study.dt))

    def recorded_gain(self, experiment: Experiment) -> float:
        """Return the expected fall of the entropy by the torques of a recorded motion, nats."""
        study = self.state.study
        signals = differentiate(experiment.q, experiment.dt)
        rows = np.arange(0, experiment.q.shape[0], max(1, round(study.dt / experiment.dt)))
        return self._gain(signals.q[rows], signals.qd[rows], signals.qdd[rows])

    def _gain(self, q: Array, qd: Array, qdd: Array) -> float:
        study = self.state.study
        duration = max(study.duration, study.dt * q.shape[0])
        motion = Motion(study.model, q, qd, qdd, study.dt, 0.0, self.state.fit.theta, duration)
        more = _information(self.state, self.rivals, [motion])
        p = self.probabilities
        apart = np.zeros((p.size, p.size))
        for one in range(p.size):
            for other in range(p.size):
                if one != other and self.rivals[one].values is not None:
                    known, then = (self._apart(x, one, other) for x in (self.information, self.information + more))
                    # No model of an arm is right: the recordings so far should have decided by ``known`` nats, and
                    # gave the odds that they did. The ratio is what a nat of the next one is worth.
                    worth = (1.0 + abs(np.log(p[one] / p[other]))) / (1.0 + known)
                    apart[one, other] = worth * (then - known)
        # A model without an effect predicts another one's recording as badly as that one would its own.
        for one, rival in enumerate(self.rivals):
            if rival.values is None:
                apart[one] = apart[:, one]
        return float(-(p * np.log(np.exp(-np.clip(apart, 0.0, MOST)) @ p)).sum())

    def _apart(self, information: Array, one: int, other: int) -> float:
        """Expected log Bayes factor of one rival over another, if the first one is right, nats."""
        values = self.rivals[one].values
        assert values is not None
        own = np.arange(self.columns[one].start, self.columns[one].start + values.size)
        base = np.arange(self.columns[0].start)
        beside = np.concatenate([base, np.arange(self.columns[other].start, self.columns[other].stop)])
        inner = information[np.ix_(own, own)] @ values
        across = information[np.ix_(beside, own)] @ values
        scale = np.sqrt(np.maximum(np.diag(information)[beside], 1e-300))
        power, axes = np.linalg.eigh(information[np.ix_(beside, beside)] / np.outer(scale, scale))
        kept = power > SINGULAR * max(power[-1], 1e-300)
        along = axes[:, kept].T @ (across / scale)
        return max(0.5 * float(values @ inner - np.sum(along**2 / power[kept])), 0.0)


def question(state: ModelState, rivals: Sequence[Rival]) -> Question:
    """Return the question that rivals at one joint pose. ``state``: model fitted to all recordings so far."""
    rivals = tuple(rivals)
    study, theta = state.study, state.fit.theta
    motions = [study.motion(replace(s, before=None), "simulated", theta) for s in (*study.train, *study.held)]
    sizes = [0 if r.term is None else r.columns(_short(motions[0])).shape[2] for r in rivals]
    ends = study.model.base.b + np.cumsum([0, *sizes])
    columns = tuple(slice(int(a), int(b)) for a, b in pairwise(ends))
    return Question(state, rivals, columns, _information(state, rivals, motions))


def _short(motion: Motion) -> Motion:
    """First samples of a motion, to count columns."""
    few = slice(0, min(motion.samples, 50))
    return replace(motion, q=motion.q[few], qd=motion.qd[few], qdd=motion.qdd[few])


def _pieces(motion: Motion) -> Iterator[Motion]:
    """Yield parts of a motion of at most `SAMPLES` samples."""
    edges = np.linspace(0, motion.samples, -(-motion.samples // SAMPLES) + 1).astype(int)
    for begin, end in pairwise(edges):
        q, qd, qdd = (x[begin:end] for x in (motion.q, motion.qd, motion.qdd))
        yield replace(motion, q=q, qd=qd, qdd=qdd, start=motion.start + motion.dt * float(begin))


def _information(state: ModelState, rivals: Sequence[Rival], motions: Sequence[Motion]) -> Array:
    """Return the information (c, c) of motions on the parameters of the model and of all rivals."""
    study = state.study
    slowest, factor = 1.0 / np.asarray(state.robot.sign_smoothing), study.decimation.factor
    total: Array | float = 0.0
    pieces = [(piece, ~study.dragged(whole.qd)) for whole in motions for piece in _pieces(whole)]
    for motion, asked in pieces:
        parts = [study.model.rigid_regressor(motion.q, motion.qd, motion.qdd), study.model.term_regressor(motion)]
        parts += [r.columns(motion) for r in rivals if r.term is not None]
        x = study.decimation(np.concatenate(parts, axis=2))
        instants = study.decimation.instants(motion.samples)
        moving = moving_rows(motion.qd, slowest, factor, instants) & asked
        if not any(r.term.effect.at_reversals for r in rivals if r.term is not None):
            for j in range(study.robot.n):
                moving[:, j] &= ~about_reversals(moving[:, j], motion.qd[instants, j], study.reversing_velocity(j))
        rows = whitened([np.ascontiguousarray(x * moving[:, :, None])], state.weights)
        total = total + rows.T @ rows
    return np.asarray(total)
