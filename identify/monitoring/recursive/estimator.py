"""Recursive instrumental-variable estimator on the live stream, the same live and in replay."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from armident.arrays import Array, Mask
from armident.configs import RobotConfig
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.recursive.change_detection import FrictionTest
from armident.identify.monitoring.recursive.equations import Instant, StreamEquations
from armident.identify.monitoring.recursive.kernels import update
from armident.identify.monitoring.recursive.noise import RunningNoise
from armident.identify.monitoring.recursive.reference import reference_from
from armident.identify.monitoring.recursive.rows import RowMatcher, SampleBlock
from armident.identify.monitoring.recursive.saved_state import read_state, restore_state, state_of, write_state
from armident.identify.monitoring.recursive.self_check import check_update
from armident.identify.monitoring.recursive.settings import RecursiveSettings
from armident.identify.monitoring.recursive.windows import Window, friction_change

NOMINAL_BANDWIDTH_HZ = 10.0
"""Closed-loop bandwidth where the configuration has none, Hz: that of an industrial arm (thesis section 2.3.1)."""


@dataclass(frozen=True)
class RecursiveResult:
    """State of the estimator after the last block; joints in the order of the robot, n of them, and b parameters.

    ``sync`` is -1 before the first sample; ``motion_s`` is the time in which a joint moved, s. ``raw``, ``filtered``,
    ``level`` (n,), 1: relative change of friction by the last window, by the recursive estimate, and its slow level.
    ``valid`` is NaN without enough Fisher ``information``. ``evidence``: log-likelihood ratio against ``threshold``,
    nats. ``parameters_*`` (b,), SI: friction is valid with its joint, others with all joints. ``noise_std`` (n,), N m
    or N, allows for serial correlation.
    """

    sync: int
    motion_s: float
    raw: Array
    raw_std: Array
    filtered: Array
    filtered_std: Array
    valid: Array
    information: Array
    needed_information: float
    level: Array
    evidence: Array
    threshold: float
    alarm: Mask
    alarm_s: Array
    alarm_change: Array
    names: tuple[str, ...]
    reference: Array
    parameters_raw: Array
    parameters_filtered: Array
    parameters_std: Array
    parameters_valid: Array
    noise_std: Array
    lag_s: Array
    gaps: int
    without_reference: int
    repeated: int


class RecursiveEstimator:
    """Tracks the base parameters of an arm on its stream and tests the friction of every joint for a change.

    A random walk around an earlier identification, filtered by Young's symmetric recursive instrumental-variable
    estimator (thesis sections 3.2.2 and 7.3.3; P. C. Young, Recursive Estimation and Time-Series Analysis, 2011). Cuts
    into blocks do not matter. Raises ConfigError for effects in the configuration, DataError for an unsuitable
    reference or rate.
    """

    _saved = (
        "matcher", "equations", "noise", "window_noise", "window", "test", "state", "covariance", "information",
        "motion_instants",
        "raw", "raw_std", "raw_difference", "speed_error",
    )  # fmt: skip

    def __init__(
        self,
        robot: RobotConfig,
        reference: IdentificationDocument,
        sample_rate_hz: float,
        *,
        with_reference: bool = True,
        settings: RecursiveSettings | None = None,
    ) -> None:
        check_update()
        self.settings = settings or RecursiveSettings()
        self.reference = reference_from(reference, robot, self.settings)
        model = self.reference.model
        self.matcher = RowMatcher(robot, with_reference, self._on_rows)
        self.equations = StreamEquations(
            model, 1.0 / sample_rate_hz, robot.bandwidth_hz or NOMINAL_BANDWIDTH_HZ, with_reference, self.settings,
            self.handle_instant, self.reference.torque_lead,
        )  # fmt: skip
        rate = self.equations.rate_hz
        self._period = 1.0 / rate
        # Residuals of the recursive estimate, and of the last window, which follows a change at once.
        self.noise = RunningNoise(model.n, rate, self.settings)
        self.window_noise = RunningNoise(model.n, rate, self.settings)
        self.window = Window(self.reference)
        self.test = FrictionTest(model.n, self.settings)
        self._window_instants = max(1, round(self.settings.window_s * rate))
        self._identity = {
            "robot": self.reference.robot_digest,
            "reference": self.reference.digest,
            "setting": repr((sample_rate_hz, with_reference, self.settings)),
        }
        self.reset()

    def reset(self) -> None:
        """Start anew from the reference: no samples, no windows, no alarms."""
        n, b = self.reference.model.n, self.reference.theta.size
        self.matcher.start_capture()
        self.equations.restart()
        self.equations.instants, self.equations.restarts = 0, 0
        self.equations.lag_sums = np.zeros((2, n))
        self.noise.reset()
        self.window_noise.reset()
        self.window.reset()
        self.test.reset()
        self.state = np.zeros(b)
        self.covariance = self.reference.covariance + np.diag(60.0 * self.reference.walk)
        self.information = np.zeros(n)
        self.motion_instants = 0
        self.raw, self.raw_std = np.full(n, np.nan), np.full(n, np.inf)
        self.raw_difference = np.full(b, np.nan)
        self.speed_error = np.zeros((2, n))

    def handle(self, block: SampleBlock) -> None:
        """Process a block of any stream: repeated rows are skipped, missing ones start the filters anew."""
        if self.matcher.add(block):
            self.start_capture(begun=True)

    def handle_instant(self, instant: Instant) -> None:
        """Process the equations of a decimated instant, which `handle` makes of the stream: noise, gates, update."""
        reference, s = self.reference, self.settings
        moving = instant.moving >= s.moving_share
        residual = instant.y - _rows_times(instant.x, reference.theta)
        innovation = residual - _rows_times(instant.x, self.state)
        ready = self.noise.ready
        variance = self._variance
        self.noise.add(innovation, moving)
        if self.test.windows:
            self.window_noise.add(residual - _rows_times(instant.x, self.raw_difference), moving)
        use = moving & ready & (variance > 0.0) & self._instruments(instant, moving)
        if not use.any():
            return
        self.motion_instants += 1
        # Only what the motion excites walks: a joint at rest does not lose its estimate.
        walks = np.where(reference.place >= 0, use[np.maximum(reference.place, 0)], True)
        diagonal = np.arange(self.state.size)
        self.covariance[diagonal, diagonal] += np.where(walks, reference.walk, 0.0) * self._period
        update(self.state, self.covariance, instant.x, instant.z, residual, variance, use)
        self.window.add(instant, residual, variance, use)
        if self.window.instants >= self._window_instants:
            self._close_window()

    def start_capture(self, *, begun: bool = False) -> None:
        """Expect another capture, whose first block may have ``begun``: filters start anew, estimates stay."""
        if not begun:
            self.matcher.start_capture()
        self.equations.restart()
        self._interrupt_noise()

    def result(self) -> RecursiveResult:
        """Return the state after the last block."""
        reference, s = self.reference, self.settings
        theta, test = reference.theta, self.test
        filtered, filtered_std = friction_change(reference, self.state, self.covariance)
        valid = self._valid
        place = reference.place
        trusted = np.where(place >= 0, valid[np.maximum(place, 0)], bool(valid.all()))
        alarm = test.alarm >= 0
        return RecursiveResult(
            sync=self.matcher.last_sync,
            motion_s=self.motion_instants * self._period,
            raw=self.raw.copy(),
            raw_std=self.raw_std.copy(),
            filtered=filtered,
            filtered_std=filtered_std,
            valid=np.where(valid, filtered, np.nan),
            information=self.information.copy(),
            needed_information=s.needed_information,
            level=test.level.copy(),
            evidence=test.sums.max(axis=0),
            threshold=test.threshold,
            alarm=alarm,
            alarm_s=np.where(alarm, test.alarm * self._period, np.nan),
            alarm_change=test.alarm_change.copy(),
            names=tuple(reference.model.base.names),
            reference=theta.copy(),
            parameters_raw=theta + self.raw_difference,
            parameters_filtered=theta + self.state,
            parameters_std=np.sqrt(np.diag(self.covariance)),
            parameters_valid=np.where(trusted, theta + self.state, np.nan),
            noise_std=np.sqrt(self._variance),
            lag_s=self.equations.lag_s,
            gaps=self.equations.restarts,
            without_reference=self.matcher.without_reference,
            repeated=self.matcher.repeated,
        )

    def save(self, path: Path) -> None:
        """Write the state to a file (NumPy ``.npz``), as a whole or not at all."""
        write_state(path, state_of(self), self._identity)

    def load(self, path: Path) -> None:
        """Continue from a saved state to the last bit; raises ConfigError or DataError if it does not suit."""
        restore_state(self, read_state(path, self._identity))

    @property
    def _valid(self) -> Mask:
        return self.information >= self.settings.needed_information

    def _on_rows(self, sync: NDArray[np.int64], values: Array) -> None:
        restarts = self.equations.restarts
        self.equations.add(sync, values)
        if self.equations.restarts != restarts:
            self._interrupt_noise()

    def _interrupt_noise(self) -> None:
        self.noise.interrupt()
        self.window_noise.interrupt()

    @property
    def _variance(self) -> Array:
        """Variance (n,) of the equations: the smaller one of both residuals, as the other may contain a change."""
        variance, later = self.noise.variance, self.window_noise.variance
        return np.where(self.window_noise.ready & (later < variance), later, variance)

    def _instruments(self, instant: Instant, moving: Mask) -> Mask:
        """Mask (n,) of the joints whose velocity the reference predicts, by their viscous columns."""
        if not self.equations.with_reference:
            return np.ones(moving.size, np.bool_)
        keep = np.exp(-self._period / self.settings.following_memory_s)
        for j, k in enumerate(self.reference.friction[:, 0]):
            if k >= 0 and moving[j]:
                difference = instant.x[j, k] - instant.z[j, k]
                self.speed_error[0, j] = keep * self.speed_error[0, j] + difference * difference
                self.speed_error[1, j] = keep * self.speed_error[1, j] + instant.x[j, k] * instant.x[j, k]
        good: Mask = self.speed_error[0] <= self.settings.instrument_error**2 * self.speed_error[1]
        return good

    def _close_window(self) -> None:
        s = self.settings
        found = self.window.estimate()
        self.raw, self.raw_std, self.raw_difference = found.change, found.std, found.difference
        keep = np.exp(-s.window_s / s.excitation_memory_s)
        self.information = keep * self.information + found.std**-2.0
        self.test.add(found.change, found.std, self.motion_instants, self._valid)


def _rows_times(x: Array, values: Array) -> Array:
    """``x values`` row by row, (n,), without BLAS, whose sums may depend on the machine's load."""
    return np.asarray((x * values).sum(axis=1))
