"""Identification worker: identifies every experiment from the samples and events on Zenoh, publishes the result."""

import json
import logging
import math
import queue
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import zenoh
import zenoh.ext

from armident.configs import ArmidentError, DataError, RobotConfig, SessionConfig, load_robot, load_session
from armident.configs.yaml_loader import is_file
from armident.daq.recording import Recording, join_parts, read_recording
from armident.daq.streaming import Block, Keys, assemble, decode_block, decode_event, open_session
from armident.identify.document import to_json
from armident.identify.identification.api import identify_recording
from armident.identify.identification.options import Options
from armident.identify.report.files import write_identification

log = logging.getLogger(__name__)

MAX_WAITING_S = 10.0
"""Longest wait for missing blocks after the end event of an experiment, s."""
MOST_BYTES = 1 << 30
"""Largest size of the samples in memory: an hour of six axes at 5 kHz. A longer capture is read from its file."""
HISTORY_BLOCKS = 100_000
"""Number of blocks that a worker requests from the capture's cache when it starts: all of it."""


@dataclass
class Assembly:
    """Events and blocks of one capture, in any order of arrival.

    Parameters
    ----------
    capture
        Name of the capture.
    start, end
        Start and end event, when received.
    most_bytes
        Largest size of the samples in memory, bytes. No block is kept above it: captures may last months, and a sender
        may be malicious.
    """

    capture: str
    start: Mapping[str, Any] | None = None
    end: Mapping[str, Any] | None = None
    most_bytes: int = MOST_BYTES
    blocks: dict[int, Block] = field(default_factory=dict)
    last_ns: int = -1
    too_long: bool = False
    _bytes: int = 0

    def add(self, block: Block) -> None:
        """Store a block, unless the memory limit is exceeded."""
        self.last_ns = max(self.last_ns, int(block.t_ns[-1])) if block.t_ns.size else self.last_ns
        if self.too_long or block.sequence in self.blocks:
            return
        self.blocks[block.sequence] = block
        self._bytes += block.nbytes
        if self._bytes > self.most_bytes:
            self.too_long = True
            self.blocks.clear()

    @property
    def complete(self) -> bool:
        """True if both events and all blocks have arrived, or the samples will be read from the file."""
        if self.start is None or self.end is None:
            return False
        return self.too_long or len(self.blocks) >= int(self.end["blocks"])

    def recording(self) -> Recording:
        """Return the recording from the stream, or from its file if blocks are missing.

        Raises
        ------
        DataError
            If blocks are missing and the file cannot be read.
        """
        if self.start is None or self.end is None:
            raise DataError(
                f"capture {self.capture}: its {'start' if self.start is None else 'end'} event was not received"
            )
        missing: str | None = "the capture exceeds the memory limit"
        if not self.too_long:
            recording = assemble(self.start, self.blocks.values(), self.end)
            missing = recording.missing
            if missing is None:
                return recording
        paths = [Path(path) for path in self.end["paths"]]
        absent = [str(path) for path in paths if not is_file(path)]
        if absent or not paths:
            where = f"its file {absent[0]} is not here" if absent else "it was not written to a file"
            raise DataError(f"capture {self.capture}: {missing}, and {where}")
        return join_parts([read_recording(path) for path in paths])


class Worker:
    """Subscribes to one robot of one cell and identifies every experiment in a separate thread.

    Parameters
    ----------
    session
        Configuration of the cell.
    robot
        Configuration of its robot.
    out
        Folder of the results; each capture has a subfolder.
    """

    def __init__(self, session: SessionConfig, robot: RobotConfig, out: Path) -> None:
        self._robot = robot
        self._out = out
        self._options = Options(**session.identification.model_dump())
        self._keys = Keys(session.cell, robot.name)
        self._ready: queue.Queue[Assembly | None] = queue.Queue()
        self._results: queue.Queue[int] = queue.Queue()
        self._current: Assembly | None = None
        self._early = Assembly("", most_bytes=MOST_BYTES)
        self._refused = 0
        self._finished_ns = -1
        self._done: set[str] = set()
        self._timer: threading.Timer | None = None
        self._lock = threading.Lock()
        self._last: bytes | None = None
        self._session = open_session(session, "worker")
        self._thread = threading.Thread(target=self._identify_all, name="identify", daemon=True)

    def __enter__(self) -> "Worker":
        """Subscribe, answer queries, and declare the liveliness token."""
        self._thread.start()
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=HISTORY_BLOCKS)
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
        self._subscribers = [
            zenoh.ext.declare_advanced_subscriber(
                self._session, key, handler, history=history, recovery=recovery, subscriber_detection=True
            )
            for key, handler in ((self._keys.samples, self._on_block), (self._keys.events, self._on_event))
        ]
        self._queryable = self._session.declare_queryable(self._keys.identification, self._on_query)
        self._token = self._session.liveliness().declare_token(self._keys.alive("worker"))
        self._status("waiting")
        return self

    def __exit__(self, *_: object) -> None:
        """Close the session; a running identification is abandoned."""
        if self._timer is not None:
            self._timer.cancel()
        self._ready.put(None)
        self._token.undeclare()
        self._session.close()

    def result(self, timeout: float | None = None) -> int | None:
        """Wait for the exit code of the next experiment; ``None`` after ``timeout``, s."""
        try:
            return self._results.get(timeout=timeout)
        except queue.Empty:
            return None

    def _on_event(self, sample: zenoh.Sample) -> None:
        try:
            event = decode_event(bytes(sample.payload))
        except DataError as error:
            self._refuse(error)
            return
        if event["kind"] not in ("experiment_start", "experiment_end"):
            return
        capture = str(event.get("capture"))
        with self._lock:
            if capture in self._done:
                return
            if self._current is None or self._current.capture != capture:
                self._current = Assembly(capture, most_bytes=MOST_BYTES)
            if event["kind"] == "experiment_start":
                self._current.start = event
                self._status("recording", capture=capture)
            else:
                self._current.end = event
                self._timer = threading.Timer(MAX_WAITING_S, self._hand_over, [capture])
                self._timer.daemon = True
                self._timer.start()
            self._hand_over_if_complete()

    def _on_block(self, sample: zenoh.Sample) -> None:
        try:
            block = decode_block(bytes(sample.payload))
        except DataError as error:
            self._refuse(error)
            return
        with self._lock:
            if block.t_ns.size and int(block.t_ns[-1]) <= self._finished_ns:
                return
            (self._early if self._current is None else self._current).add(block)
            self._hand_over_if_complete()

    def _refuse(self, error: DataError) -> None:
        """Report an invalid message: the first one, the tenth, the hundredth, and so on."""
        self._refused += 1
        if math.log10(self._refused).is_integer():
            times = f" ({self._refused} times)" if self._refused > 1 else ""
            log.warning("%s%s", error, times)

    def _hand_over_if_complete(self) -> None:
        current = self._current
        if current is None:
            return
        for block in self._early.blocks.values():
            current.add(block)
        self._early = Assembly("", most_bytes=MOST_BYTES)
        if current.complete:
            self._finish(current)

    def _hand_over(self, capture: str) -> None:
        with self._lock:
            if self._current is not None and self._current.capture == capture:
                self._finish(self._current)

    def _finish(self, assembly: Assembly) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._done.add(assembly.capture)
        # Blocks carry times, not names: a late one must not count for the next capture.
        self._finished_ns = assembly.last_ns
        self._current = None
        self._ready.put(assembly)

    def _on_query(self, query: zenoh.Query) -> None:
        if self._last is None:
            query.reply_err(b"no identification yet")
        else:
            query.reply(self._keys.identification, self._last)

    def _identify_all(self) -> None:
        while (assembly := self._ready.get()) is not None:
            code = 1
            try:
                code = self._identify(assembly)
            except ArmidentError as error:
                code = error.exit_code
                log.error("%s", error)
                self._status("failed", capture=assembly.capture, message=str(error))
            except Exception as error:
                # The worker must survive any failure of one experiment.
                log.error("%s: %s", type(error).__name__, error)
                self._status("failed", capture=assembly.capture, message=f"{type(error).__name__}: {error}")
            self._results.put(code)

    def _identify(self, assembly: Assembly) -> int:
        recording = assembly.recording()
        source = "stream" if assembly.complete and not assembly.too_long else "file"
        print(f"worker: {recording.samples.sync.size} samples from the {source}, identifying", flush=True)

        def progress(stage: str, share: float) -> None:
            self._status("identifying", capture=assembly.capture, stage=stage, share=share)

        outcome = identify_recording(recording, self._robot, self._options, progress)
        self._last = to_json(outcome.document).encode()
        self._session.put(self._keys.identification, self._last)
        name = assembly.capture if recording.path is None else recording.path.name.removesuffix(".mcap")
        document, report = write_identification(outcome, self._out / f"{name}.identification")
        level = outcome.result.verdict.level
        self._status("done", capture=assembly.capture, result=str(document), verdict=level)
        for reason in outcome.result.verdict.reasons:
            log.warning("%s: %s. Next: %s", reason.level, reason.message, reason.next_step)
        for warning in outcome.document.warnings:
            log.warning("%s", warning)
        print(
            f"worker: {level}, relative torque error {outcome.document.relative_error_pct:.2f} %\n"
            f"result: {document}\nreport: {report}",
            flush=True,
        )
        return DataError.exit_code if level == "unusable" else 0

    def _status(self, state: str, **more: Any) -> None:
        self._session.put(self._keys.status, json.dumps({"component": "worker", "state": state, **more}).encode())


def run_worker(config: Path, *, once: bool, out: Path | None) -> int:
    """Carry out ``armident worker`` until SIGTERM or SIGINT.

    Parameters
    ----------
    config
        Session configuration.
    once
        End after one experiment with its exit code.
    out
        Folder of the results; ``None``: the recording directory of the session.

    Returns
    -------
    int
        Exit code.

    Raises
    ------
    ConfigError
        If the configuration is wrong or another worker of this cell runs.
    """
    session = load_session(config)
    robot = load_robot(session.robot)
    stopped = threading.Event()

    def stop(_signal: int, _frame: FrameType | None) -> None:
        stopped.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    with Worker(session, robot, out or session.recording.directory) as worker:
        print("worker: ready", flush=True)
        while not stopped.is_set():
            code = worker.result(timeout=0.2)
            if once and code is not None:
                return code
    return 0
