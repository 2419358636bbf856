"""The auxiliary model: the closed loop simulated with the last estimate, source of the instruments."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from armident.arrays import Array
from armident.configs import DataError
from armident.identify.regression.equations import ExperimentEquations, filtered_regressor, thinned_regressor
from armident.identify.robot.arm import ArmModel
from armident.identify.robot.controller import DiscreteController
from armident.identify.robot.physical import damp_to_physical
from armident.identify.robot.relaxation import ROUNDS, simulate_with_terms
from armident.identify.robot.simulation import Simulation
from armident.identify.signals.bandpass import butterworth
from armident.identify.signals.decimate import Decimation
from armident.identify.signals.differentiate import Derivatives
from armident.identify.signals.streamed import Streamed, chosen, kept, mapped

HALVINGS = 8
"""Step halvings towards the last estimate that could be simulated."""

WIDER = 2.0
"""Least decimated Nyquist frequency, in bands of the instruments, at which the instruments are filtered."""

FELT = 0.6
"""Share of the band of the instruments up to which the torques of terms act on a simulated arm: hardly any torque moves
it beyond three bandwidths of the closed loop."""

REFERENCE_POSTURES = 100
"""Postures of the references at which the mass matrix of an iterate that diverged is examined."""


class _Diverged(Exception):
    """The simulation of an experiment has diverged."""


@dataclass(frozen=True)
class Response:
    """Filtered response of the simulated loop: torques, N m or N, and positions, rad or m, (M, n) per experiment."""

    torque: tuple[Array, ...]
    position: tuple[Array, ...]


@dataclass
class AuxiliaryModel:
    """Simulates the reference of every experiment through controller and arm, and filters the regressor (thesis 2.3.3).

    An estimate that cannot be simulated is made physical: no negative friction, a positive definite mass matrix. If
    that is not enough, it is moved half-way, and half-way again, towards the last estimate that could be simulated.
    Each such step adds a line to ``warnings``. Only the simulation uses the changed estimate; the estimator keeps its
    own.

    ``controller``: on the motor side. ``references``: (N, n) per experiment, rad or m. ``initial``: position and
    velocity (n,) at its start, ``starts``: time of its first sample since the recordings began, s. ``max_velocity``
    (n,): diverged beyond it. ``anchor`` (b,): can be simulated; the target while there is no earlier estimate.
    ``measured``: derivatives of simulated positions of experiment k by the filter of the measured ones. ``feedback``:
    True for the controller of the drives, through which the noise of their encoders passes. ``rounds``, ``tolerated``:
    see `simulate_with_terms`. ``first_motions``: where the torque of the terms is computed first.

    ``band_hz``: highest frequency of the instruments. The measured regressor is smoothed and lacks content that the
    reference still holds, such as steps of the set points; a prefilter would amplify it and take it for information.
    """

    model: ArmModel
    controller: DiscreteController
    references: Sequence[Array]
    initial: Sequence[tuple[Array, Array]]
    dt: float
    decimation: Decimation
    max_velocity: Array
    anchor: Array | None = None
    band_hz: float = np.inf
    starts: Sequence[float] | None = None
    measured: Callable[[Array, int], Derivatives] | None = None
    feedback: bool = True
    rounds: int = ROUNDS
    tolerated: float = 0.0
    first_motions: Sequence[Derivatives] | None = None
    _last: Array | None = None
    _warnings: list[str] = field(default_factory=list)
    _simulated: list[tuple[tuple[object, ...], bytes, Sequence[Simulation]]] = field(default_factory=list, repr=False)

    @property
    def limits_band(self) -> bool:
        """True if the decimation passes so much more than ``band_hz`` that the instruments are filtered."""
        return 0.5 / (self.dt * self.decimation.factor) >= WIDER * self.band_hz

    def fresh(self) -> Self:
        """Copy without earlier estimates and warnings, with which an estimator starts."""
        return replace(self, _warnings=[], _last=None)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings since the last :meth:`fresh`, each once."""
        return tuple(dict.fromkeys(self._warnings))

    def warn(self, text: str) -> None:
        """Add a warning, one sentence, for the result."""
        self._warnings.append(text)

    def of_experiments(self, numbers: Sequence[int]) -> Self:
        """The loop of the experiments with these numbers, from 0."""
        return replace(
            self,
            references=chosen(self.references, numbers),
            initial=[self.initial[k] for k in numbers],
            starts=[self._start(k) for k in numbers],
            first_motions=None if self.first_motions is None else chosen(self.first_motions, numbers),
        )

    def simulate(self, theta: Array, disturbances: Sequence[Array] | None = None) -> Sequence[Simulation] | None:
        """All experiments with base parameters (b,), or ``None`` if one diverges or theta is not finite.

        ``disturbances``: additional motor torques (N, n) per experiment, N m or N.
        The last simulation without them is kept, for this loop and its copies with other filters.
        """
        if not np.isfinite(theta).all():
            return None
        signals = (self.references, self.initial, self.starts, self.first_motions, self.dt)
        loop: tuple[object, ...] = (self.model, self.controller, self.rounds, self.tolerated, self.band_hz)
        loop = (*loop, self.max_velocity, *signals)
        if disturbances is None:
            for parts, of, runs in self._simulated:
                if of == theta.tobytes() and all(a is b for a, b in zip(parts, loop, strict=True)):
                    return runs

        def run(k: int, q_ref: Array) -> Simulation:
            q0, qd0 = self.initial[k]
            found = simulate_with_terms(
                self.model,
                theta,
                self.controller,
                q_ref,
                self.dt,
                start=self._start(k),
                disturbance=None if disturbances is None else disturbances[k],
                band_hz=FELT * self.band_hz,
                rounds=self.rounds,
                tolerated=self.tolerated,
                motion=None if self.first_motions is None else self.first_motions[k],
                q0=q0,
                qd0=qd0,
                max_velocity=self.max_velocity,
            )
            if found.diverged_at is not None:
                raise _Diverged
            return found

        try:
            made = kept((run(k, q_ref) for k, q_ref in enumerate(self.references)), like=self.references)
        except _Diverged:
            return None
        if disturbances is None and not isinstance(made, Streamed):
            self._simulated[:] = [(loop, theta.tobytes(), made)]
        return made

    def respond(self, theta: Array) -> Response | None:
        """Simulated torques and positions after the parallel filter, or ``None`` if the simulation diverges."""
        runs = self.simulate(theta)
        return None if runs is None else self._filtered(runs)

    def respond_many(self, thetas: Sequence[Array]) -> list[Response | None]:
        """`respond` for many parameter vectors at once, on all processors: simulations hold no interpreter lock."""
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            return list(pool.map(self.respond, thetas))

    def instruments(self, theta: Array) -> Sequence[Array]:
        """Filtered regressor at few simulated samples, (M, n, b) per experiment; DataError if no loop runs."""
        return self.regressors(self.motions(theta), thinned=True)

    def motions(self, theta: Array) -> Sequence[Derivatives]:
        """Simulated signals of every experiment; raises DataError like `instruments`."""
        return self.motions_of(self._nearest(theta)[1])

    def motions_of(self, runs: Sequence[Simulation]) -> Sequence[Derivatives]:
        """Signals of simulations of every experiment."""
        starts = [self._start(k) for k in range(len(runs))]
        return mapped(lambda run, start: Derivatives(run.q, run.qd, run.qdd, None, self.dt, start), runs, starts)

    def regressors(self, motions: Sequence[Derivatives], *, thinned: bool = False) -> Sequence[Array]:
        """Filtered regressor at noise-free motions, (M, n, b) per experiment; ``thinned``: few samples suffice."""
        regressor = thinned_regressor if thinned else filtered_regressor
        seen = (self._in_band(motion, k) for k, motion in enumerate(motions))
        return kept((regressor(self.model, motion, self.decimation) for motion in seen), like=motions)

    def equations(self, blocks: Sequence[ExperimentEquations], theta: Array) -> Sequence[ExperimentEquations]:
        """Equations with the regressor simulated at theta (b,) (2.32); DataError like `instruments`."""
        return mapped(lambda block, zeta: replace(block, x=zeta), blocks, self.regressors(self.motions(theta)))

    def reachable(self, theta: Array) -> tuple[Array, Response]:
        """Theta and its response, or of the nearest point towards the last good estimate; DataError if none."""
        near, runs = self._nearest(theta)
        return near, self._filtered(runs)

    def _start(self, experiment: int) -> float:
        return 0.0 if self.starts is None else self.starts[experiment]

    def _in_band(self, motion: Derivatives, experiment: int) -> Derivatives:
        """Motion after the filter of the measured one, and low-pass filtered where the decimation passes more."""
        if self.measured is not None:
            motion = replace(self.measured(motion.q, experiment), start=motion.start)
        if not self.limits_band:
            return motion
        q, qd, qdd = (butterworth(s, self.dt, self.band_hz) for s in (motion.q, motion.qd, motion.qdd))
        return replace(motion, q=q, qd=qd, qdd=qdd)

    def _filtered(self, runs: Sequence[Simulation]) -> Response:
        return Response(
            tuple(self.decimation(_at_samples(run.tau)) for run in runs),
            tuple(self.decimation(run.q) for run in runs),
        )

    def _nearest(self, theta: Array) -> tuple[Array, Sequence[Simulation]]:
        """Theta, or the first point on the way back from it that can be simulated."""
        runs = self.simulate(theta)
        if runs is not None:
            self._last = theta
            return theta, runs
        previous = self.anchor if self._last is None else self._last
        if previous is None:
            raise DataError("the auxiliary closed loop cannot be simulated: it diverges with the first estimate")
        damped = damp_to_physical(self.model, theta, previous, self._postures())
        reason = damped.reason or "its simulation diverged"
        for share in (*(0.5**halving for halving in range(HALVINGS + 1)), 0.0):
            target = previous + (damped.theta - previous) * share
            runs = self.simulate(target)
            if runs is not None:
                self._last = target
                self.warn(
                    f"An iterate was not physical ({reason}). "
                    f"The simulation used {100 * damped.step * share:.1f} % of the step to it."
                )
                return target, runs
        raise DataError("the auxiliary closed loop cannot be simulated: it diverges between all estimates tried")

    def _postures(self) -> Array:
        total = sum(q_ref.shape[0] for q_ref in self.references)
        return np.concatenate([q_ref[:: max(1, total // REFERENCE_POSTURES)].copy() for q_ref in self.references])


def _at_samples(held: Array) -> Array:
    """Torques (N, n) at the samples: the mean of those held before and after, as the simulated accelerations are."""
    at = held.copy()
    at[1:] = 0.5 * (held[1:] + held[:-1])
    return at
