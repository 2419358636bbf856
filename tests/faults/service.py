"""Service processes killed at random moments: ``python -m tests.faults.service --rounds 200``.

Each round writes and publishes a recording as a capture does, beside two workers, a job that enters the recording in
the history, and a process that adds results to it. Some of them are ended by SIGKILL at a random moment and are started
again in the next round. In the end one worker finishes what is left. Every recording with samples then has exactly one
result, which was announced once, and at most one entry in the history. Needs no bus.
"""

import argparse
import datetime
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from armident.configs import ArmidentError, DataError, SessionConfig, load_robot, load_session
from armident.daq.capture.publisher import Publisher
from armident.daq.capture.recording_files import capture_stamp
from armident.daq.recording import RecordingWriter, StreamLayout, read_recording, write_recording
from armident.daq.streaming import Block, Keys, encode_event, open_session
from armident.daq.streaming.codec import end_content, start_content
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.options import options_of
from armident.identify.monitoring.change.history import History, recorded_at
from armident.identify.monitoring.reidentify.identify_once import identify_once
from armident.identify.monitoring.reidentify.keep import HistoryEntry
from armident.identify.monitoring.reidentify.publish import StatusPublisher
from armident.identify.monitoring.worker.ledger import FILE, Ledger
from armident.identify.monitoring.worker.recorded import Captured, captured_in
from armident.identify.monitoring.worker.worker import Worker
from tests.fixtures import arms

BLOCK_ROWS = 500
CAPTURE_S = 0.8
"""Duration of a capture, s."""
LONGEST_S = 300.0
"""Longest wait for the last results, s."""


def cell_of(folder: Path) -> SessionConfig:
    """Return the session of the cell whose recordings are in a folder."""
    session = load_session("emps_cell.yaml")
    cell = "".join(letter if letter.isalnum() else "_" for letter in folder.name.lower())
    recording = session.recording.model_copy(update={"directory": folder})
    options = {"method": "idim-ls"}
    return session.model_copy(update={"cell": cell, "recording": recording, "identification": options})


def capture(folder: Path, number: int) -> None:
    """Write and publish one recording; its first samples make it differ from the others."""
    session, base = cell_of(folder), read_recording(folder / "base" / "base.mcap")
    began = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC) + datetime.timedelta(seconds=number)
    name = f"{base.robot.name}-{capture_stamp(began)}"
    joints = [joint.name for joint in base.robot.joints]
    layouts = [StreamLayout.of(stream, joints) for stream in base.streams.values()]
    metadata = {"capture": name, "cell": session.cell, "started_utc": began.isoformat()}
    path = folder / f"{name}.mcap"
    with closing(Publisher(session, Keys(session.cell, base.robot.name), exclusive=False)) as publisher:
        with RecordingWriter(path, base.robot, session, base.sample_rate_hz, layouts, metadata) as writer:
            start = start_content(name, base.robot, session, base.sample_rate_hz, layouts, metadata)
            publisher.event(encode_event("experiment_start", start))
            sequence, counters = 0, dict[str, int]()
            pieces = [
                (stream, layout, slice(first, first + BLOCK_ROWS))
                for stream, layout in zip(base.streams.values(), layouts, strict=True)
                for first in range(0, stream.sync.size, BLOCK_ROWS)
            ]
            pieces.sort(key=lambda piece: int(piece[0].sync[piece[2]][0]))
            for stream, layout, rows in pieces:
                raw = {key: values[rows].copy() for key, values in stream.raw.items()}
                if int(stream.sync[rows][0]) < BLOCK_ROWS:
                    for values in raw.values():
                        values[0] += np.asarray(number % 100, values.dtype)
                        values[1] += np.asarray(number // 100, values.dtype)
                writer.append(stream.name, stream.sync[rows], stream.t_ns[rows], raw)
                publisher.offer(Block(layout, sequence, stream.sync[rows], stream.t_ns[rows], raw, name))
                counters[f"{stream.name}.rows"] = counters.get(f"{stream.name}.rows", 0) + len(stream.sync[rows])
                sequence += 1
                time.sleep(CAPTURE_S / len(pieces))
            writer.add_marks(base.marks)
            writer.flush()
            writer.close(counters)
        end = end_content(name, sequence, counters, (), base.marks, [path])
        publisher.event(encode_event("experiment_end", end))


def work(folder: Path) -> None:
    """Run a worker until it is killed."""
    session = cell_of(folder)
    with Worker(session, load_robot(session.robot), folder):
        threading.Event().wait()


def job(folder: Path, path: Path) -> None:
    """Identify a recording as ``armident reidentify`` does after the motion, and enter it in the history."""
    session = cell_of(folder)
    recording, robot = read_recording(path), load_robot(session.robot)
    options = options_of(session)
    with StatusPublisher(session, robot) as publisher:
        done = identify_once(recording, robot, options, folder, publisher, lambda _: None)
    HistoryEntry(store_of(folder), recording, done.document, done.path).write()


def add_results(folder: Path) -> None:
    """Add all results to the history, as ``armident history FILES`` does."""
    history = History(store_of(folder))
    for path in sorted(folder.glob("*.identification/identification.json")):
        document = load_document(path, IdentificationDocument)
        history.add(document, recorded_at(document, path))


def store_of(folder: Path) -> str:
    """Return the URL of the history in a folder."""
    return f"sqlite:///{folder}/history.sqlite"


def quietly(folder: Path, function: Callable[..., None], *arguments: Any) -> None:
    """Call a function with its output in a log file; one that cannot go on ends with its exit code."""
    log = os.open(folder / "service.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    try:
        function(folder, *arguments)
    except ArmidentError as error:
        print(f"{function.__name__}: {error}", flush=True)
        sys.exit(error.exit_code)


class Audience:
    """Counts the announced results and failures of a cell by the hash of the recording."""

    def __init__(self, session: SessionConfig, robot: str) -> None:
        self.results: Counter[str] = Counter()
        self.failures: Counter[str] = Counter()
        self._session = open_session(session, "observer", any_port=True)
        keys = Keys(session.cell, robot)
        self._kept = [
            self._session.declare_subscriber(keys.identification, self._on_result),
            self._session.declare_subscriber(keys.status, self._on_status),
        ]

    def _on_result(self, sample: zenoh.Sample) -> None:
        self.results[json.loads(bytes(sample.payload))["recording"]["sha256"]] += 1

    def _on_status(self, sample: zenoh.Sample) -> None:
        status = json.loads(bytes(sample.payload))
        if status["state"] == "failed" and "sha256" in status:
            self.failures[status["sha256"]] += 1

    def close(self) -> None:
        """End the subscription."""
        self._session.close()


@dataclass
class Service:
    """Processes of one folder, with the number of their kills."""

    folder: Path
    rng: random.Random
    kills: Counter[str] = field(default_factory=Counter)
    _workers: list[ForkServerProcess] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["tests.faults.service"])

    def start(self, function: Callable[..., None], *arguments: Any) -> ForkServerProcess:
        """Call a function in a process of its own."""
        process = self._context.Process(target=quietly, args=(self.folder, function, *arguments), daemon=True)
        process.start()
        return process

    def kill(self, kind: str, process: ForkServerProcess) -> None:
        """End a process by SIGKILL."""
        if process.is_alive():
            assert process.pid is not None
            # It may have ended meanwhile.
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGKILL)
                self.kills[kind] += 1
        process.join()

    def round(self, number: int) -> None:
        """Run one round: one capture; every process is killed with a probability of a half."""
        self._workers = [worker for worker in self._workers if worker.is_alive()]
        while len(self._workers) < 2:
            self._workers.append(self.start(work))
        running = [("capture", self.start(capture, number)), ("history", self.start(add_results))]
        finished = [each.paths[0] for each in captured_in((self.folder,), "emps") if each.finished]
        if finished:
            running.append(("reidentify", self.start(job, self.rng.choice(finished[-3:]))))
        running.append(("worker", self.rng.choice(self._workers)))
        begin = time.monotonic()
        doomed = [(self.rng.uniform(0.0, 2.5), kind, each) for kind, each in running if self.rng.random() < 0.5]
        for after, kind, process in sorted(doomed, key=lambda each: each[0]):
            time.sleep(max(0.0, begin + after - time.monotonic()))
            self.kill(kind, process)
        for kind, process in running:
            if kind != "worker":
                process.join(60.0)
                self.kill(f"{kind} that did not end", process)

    def finish(self) -> None:
        """Let one new worker do what is left."""
        for worker in self._workers:
            self.kill("worker", worker)
        last = self.start(work)
        try:
            wait_for_results(self.folder)
        finally:
            self.kill("last worker", last)
        add_results(self.folder)


def wait_for_results(folder: Path, seconds: float = LONGEST_S) -> None:
    """Wait until the results of all recordings in a folder were announced, at most for a time in s."""
    until = time.monotonic() + seconds
    ledger = Ledger(folder / FILE, "witness")
    while time.monotonic() < until:
        time.sleep(2.0)
        entries = ledger.entries()
        known = {path for entry in entries for path in entry.paths}
        if {each.paths[0] for each in recorded(folder)} <= known and all(entry.announced for entry in entries):
            break
    time.sleep(1.0)


def recorded(folder: Path) -> dict[Captured, str]:
    """Return the captures in a folder that have samples, with the hashes of their recordings."""
    found = {}
    for captured in captured_in((folder,), "emps"):
        with suppress(DataError):
            recording = captured.read()
            if recording.samples.sync.size > 0:
                found[captured] = recording.sha256
    return found


def violations(folder: Path, audience: Audience) -> tuple[list[str], int, int]:
    """Return what is wrong, the number of recordings with samples, and the number of their results."""
    digests = list(recorded(folder).values())
    entries = {entry.sha256: entry for entry in Ledger(folder / FILE, "witness").entries()}
    results: Counter[str] = Counter()
    for path in folder.glob("*.identification/identification.json"):
        results[load_document(path, IdentificationDocument).recording.sha256] += 1
    history = Counter(run.document.recording.sha256 for run in History(store_of(folder)).runs())
    wrong = [f"{digest[:8]}: of no recording" for digest in results if digest not in digests]
    for digest in digests:
        entry = entries.get(digest)
        state = "unknown" if entry is None else entry.state
        expected = (1, 1, 0) if state == "done" else (0, 0, 1)
        found = results[digest], audience.results[digest], audience.failures[digest]
        if state == "unknown" or found != expected or history[digest] != results[digest]:
            wrong.append(f"{digest[:8]}: {state}, results, announcements, failures {found}, history {history[digest]}")
    return wrong, len(digests), sum(results.values())


def run_rounds(rounds: int, seed: int, folder: Path) -> list[str]:
    """Run rounds in a new folder and print the figures; return what is wrong."""
    session = cell_of(folder)
    base = replace(arms.recording("emps", "emps_excitation", 1), session=session)
    write_recording(base, folder / "base" / "base.mcap")
    begin = time.monotonic()
    with closing(Audience(session, base.robot.name)) as audience:
        service = Service(folder, random.Random(seed))
        for number in range(rounds):
            service.round(number)
        service.finish()
        wrong, recordings, results = violations(folder, audience)
    if 2 * recordings < rounds:
        wrong.append(f"only {recordings} recordings with samples in {rounds} rounds")
    kills = ", ".join(f"{kind} {count}" for kind, count in sorted(service.kills.items()))
    print(f"{rounds} rounds in {time.monotonic() - begin:.0f} s, seed {seed}; kills: {kills}")
    print(f"{recordings} recordings with samples, {results} results; {len(wrong)} violations")
    return wrong


def options_of_rounds(module: str, description: str | None) -> argparse.ArgumentParser:
    """Return the parser of the options that the programs of rounds share."""
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=description)
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", action="store_true", help="keep the folder")
    return parser


def run_in_new_folder(run: Callable[[Path], list[str]], *, keep: bool) -> int:
    """Print what a run finds wrong; return 1 if there is anything, whose folder is kept, otherwise 0."""
    folder = Path(tempfile.mkdtemp(prefix="armident-service-"))
    wrong = run(folder)
    if not wrong and not keep:
        shutil.rmtree(folder)
    else:
        print(f"files: {folder}")
    print(*wrong, sep="\n")
    return int(bool(wrong))


def main() -> int:
    """Run the rounds; return 1 if there are violations."""
    options = options_of_rounds("tests.faults.service", __doc__).parse_args()
    return run_in_new_folder(partial(run_rounds, options.rounds, options.seed), keep=options.keep)


if __name__ == "__main__":
    # By its name, so that the processes find their functions.
    from tests.faults import service

    sys.exit(service.main())
