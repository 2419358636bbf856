"""``armident watch``: the recursive estimator on the stream of a cell, or on recordings."""

import json
import logging
import signal
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from rich.console import Console
from rich.live import Live

from armident.configs import ConfigError, DataError, RobotConfig, load_robot, load_session
from armident.configs.errors import FOUND
from armident.daq.recording import read_recording
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.recursive.estimator import RecursiveEstimator, RecursiveResult
from armident.identify.monitoring.recursive.live_watch import SAVED_S, LiveWatch, Watch, live_estimator
from armident.identify.monitoring.recursive.recorded_blocks import blocks_of, has_reference
from armident.identify.monitoring.recursive.report import document, friction_table, joint_states

log = logging.getLogger(__name__)

REPLAY_SYNCS = 1000
"""SYNCs per block of a replay."""


@dataclass(frozen=True)
class WatchOptions:
    """Options of ``armident watch``: result of the healthy arm, file of the state, duration of a live watch, s."""

    reference: Path
    state: Path | None
    as_json: bool
    duration: float | None = None


class Screen:
    """Shows results: JSON lines, a table that is renewed on a terminal, or one line per change of state."""

    def __init__(self, robot: RobotConfig, as_json: bool) -> None:
        self._robot, self._as_json = robot, as_json
        self._states: list[str] = []
        self._console = Console()
        self._live = Live(console=self._console, auto_refresh=False) if self._console.is_terminal else None

    def __enter__(self) -> Self:
        """Begin the renewed table."""
        if self._live is not None and not self._as_json:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End the renewed table."""
        if self._live is not None and not self._as_json:
            self._live.stop()

    def show(self, result: RecursiveResult) -> None:
        """Show a result."""
        if self._as_json:
            print(json.dumps(document(result, self._robot)), flush=True)
            return
        if self._live is not None:
            self._live.update(friction_table(result, self._robot), refresh=True)
            return
        states = joint_states(result)
        for joint, before, now in zip(self._robot.joints, self._states or [""] * len(states), states, strict=True):
            if before and now != before:
                print(f"{result.motion_s:.0f} s of motion: {joint.name}: {now}", flush=True)
        self._states = states

    def end(self, result: RecursiveResult) -> None:
        """Show the last result."""
        if not self._as_json and self._live is None:
            self._console.print(friction_table(result, self._robot))


def watch_recordings(paths: Sequence[Path], config: Path | None, options: WatchOptions) -> int:
    """Carry out ``armident watch RECORDING``; 4 after an alarm, 3 if no joint had enough excitation, otherwise 0."""
    reference = load_document(options.reference, IdentificationDocument)
    first = read_recording(paths[0])
    robot = first.robot if config is None else load_robot(config, "identify")
    estimator = RecursiveEstimator(robot, reference, first.sample_rate_hz, with_reference=has_reference(first))
    _load_state(estimator, options.state)
    if not has_reference(first):
        log.warning("no reference positions: recursive least squares, which encoder noise may bias")
    with Screen(robot, options.as_json) as screen:
        watch = Watch(estimator, first.sample_rate_hz, screen.show)
        for k, path in enumerate(paths):
            recording = first if k == 0 else read_recording(path)
            if abs(recording.sample_rate_hz / first.sample_rate_hz - 1.0) > 1e-6:
                raise DataError(
                    f"{path}: {recording.sample_rate_hz:g} samples/s, {paths[0]} has {first.sample_rate_hz:g}: "
                    "watch them one by one"
                )
            estimator.start_capture()
            for block in blocks_of(recording, REPLAY_SYNCS):
                watch.handle(block)
        result = estimator.result()
        screen.show(result)
    screen.end(result)
    if options.state is not None:
        estimator.save(options.state)
    if result.alarm.any():
        return FOUND
    if not (result.information >= result.needed_information).any():
        raise DataError(
            f"too little motion for any joint in {result.motion_s:.1f} s: watch a longer or faster motion "
            "(excitation in the table; armident check RECORDING)"
        )
    return 0


def _load_state(estimator: RecursiveEstimator, path: Path | None) -> None:
    if path is not None and path.exists():
        estimator.load(path)
        log.info("continues from %s", path)


def watch_cell(config: Path | None, options: WatchOptions) -> int:
    """Carry out ``armident watch --config SESSION`` until SIGTERM or SIGINT; 4 after an alarm, otherwise 0."""
    if config is None:
        raise ConfigError("give a RECORDING, or --config SESSION for the live stream of a cell")
    session = load_session(config, "identify")
    robot = load_robot(session.robot, "identify")
    estimator = live_estimator(session, robot, load_document(options.reference, IdentificationDocument))
    _load_state(estimator, options.state)
    stopped = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stopped.set())

    def save() -> None:
        if options.state is None:
            return
        try:
            estimator.save(options.state)
        except OSError as error:
            log.warning("--state %s: not saved: %s; tried again every %g s", options.state, error.strerror, SAVED_S)

    with LiveWatch(session, robot, estimator) as live, Screen(robot, options.as_json) as screen:
        print("watch: ready", file=sys.stderr, flush=True)
        live.run(stopped, screen.show, save, options.duration)
    save()
    result = estimator.result()
    screen.end(result)
    if live.dropped:
        log.warning("%d blocks were dropped: this machine is too busy for the stream", live.dropped)
    if live.lost:
        log.warning("%d blocks did not arrive in all: armident watch RECORDING replays a whole capture", live.lost)
    return FOUND if result.alarm.any() else 0
