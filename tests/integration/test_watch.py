"""``armident watch``: live on Zenoh and in replay give the same bits; the replay's command line."""

import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armident.configs import ConfigError, DataError, SessionConfig, load_session
from armident.daq.capture.publisher import Publisher
from armident.daq.recording import Recording, write_recording
from armident.daq.streaming import Keys, encode_block, open_session
from armident.identify.documents.files import to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.recursive.block_order import LONGEST_HOLD_S, BlockOrder
from armident.identify.monitoring.recursive.estimator import RecursiveEstimator
from armident.identify.monitoring.recursive.live_watch import LiveWatch, live_estimator
from armident.identify.monitoring.recursive.recorded_blocks import blocks_of
from armident.identify.monitoring.recursive.saved_state import state_of
from armident.identify.monitoring.recursive.watch import WatchOptions, watch_cell, watch_recordings
from armident.identify.monitoring.worker.stream_buffer import LARGEST_BLOCK
from tests.fixtures import arms
from tests.fixtures.signed import put_signed
from tests.integration.test_worker import blocks_of as published_blocks

pytestmark = pytest.mark.slow


def reference() -> IdentificationDocument:
    return arms.tx40_baseline()


def recorded() -> Recording:
    return arms.recording("tx40", "tx40_excitation", 1, period=arms.FAST)


@pytest.fixture
def session(request: pytest.FixtureRequest) -> SessionConfig:
    """A cell of its own, with the rate of the recording."""
    name = f"watch_{os.getpid()}_{abs(hash(request.node.name)) % 10**6}"
    shipped = load_session("tx40_cell.yaml")
    sync = shipped.sync.model_copy(update={"period_us": round(1e6 * arms.FAST)})
    return shipped.model_copy(update={"cell": name, "sync": sync})


@contextmanager
def watching(session: SessionConfig, estimator: RecursiveEstimator) -> Iterator[LiveWatch]:
    stop = threading.Event()
    with LiveWatch(session, recorded().robot, estimator) as live:
        thread = threading.Thread(target=live.run, args=(stop, lambda _: None, lambda: None))
        thread.start()
        try:
            yield live
        finally:
            stop.set()
            thread.join()


def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)


def seen_by(publisher: Publisher, token: str) -> bool:
    """True if the session of a publisher knows a liveliness token."""
    assert publisher._session is not None
    return any(reply.ok is not None for reply in publisher._session.liveliness().get(token, timeout=0.3))


def test_the_live_stream_and_the_replay_give_the_same_bits(session: SessionConfig) -> None:
    recording = recorded()
    live = live_estimator(session, recording.robot, reference())
    published = sorted(published_blocks(recording), key=lambda block: int(block.sync[-1]))
    last = int(recording.samples.sync[-1])
    with watching(session, live) as watch, open_session(session, "worker") as observer:
        keys = Keys(session.cell, recording.robot.name)
        publisher = Publisher(session, keys)
        # A capture configures its drives before its first block: by then the sessions have found each other.
        until(lambda: seen_by(publisher, keys.alive("watch")))
        time.sleep(1.0)
        for k, block in enumerate(published):
            publisher.offer(replace(block, sequence=k))
            time.sleep(0.005)
        until(lambda: live.matcher.last_sync == last)
        time.sleep(0.5)
        key = Keys(session.cell, recording.robot.name).recursive
        replies = list(observer.get(key))
        publisher.close()
    assert watch.dropped == watch.refusals.total == 0
    replayed = RecursiveEstimator(recording.robot, reference(), recording.sample_rate_hz)
    for piece in blocks_of(recording, 777):
        replayed.handle(piece)
    assert replayed.result().motion_s > 3.0
    first, second = state_of(live), state_of(replayed)
    assert first.keys() == second.keys()
    different = {name for name in first if first[name].tobytes() != second[name].tobytes()}
    # A subscriber may receive a block twice.
    assert different <= {"matcher.repeated"}
    assert replies
    assert replies[0].ok is not None
    document = json.loads(bytes(replies[0].ok.payload))
    assert document["schema"] == "armident/recursive/1"
    assert [joint["joint"] for joint in document["joints"]] == [joint.name for joint in recording.robot.joints]


def test_blocks_that_arrive_late_are_put_in_order_and_a_missing_one_is_given_up() -> None:
    made = [replace(block, sequence=k) for k, block in zip(range(8), published_blocks(recorded()), strict=False)]
    order = BlockOrder()
    seen = [block.sequence for k in (2, 3, 0, 1, 3, 4, 6, 7) for block in order.add(made[k], 0.0)]
    assert seen == [0, 1, 2, 3, 4]
    assert not list(order.overdue(0.9 * LONGEST_HOLD_S))
    assert [block.sequence for block in order.overdue(LONGEST_HOLD_S)] == [6, 7]
    assert order.lost == 1
    # Another capture begins anew; the late block of the earlier one is not held up by it.
    assert [block.sequence for block in order.add(replace(made[0], capture="c2"), 2.0)] == [0]


def test_first_blocks_of_a_capture_that_was_found_late_are_counted() -> None:
    made = [replace(block, sequence=k) for k, block in zip(range(8), published_blocks(recorded()), strict=False)]
    order = BlockOrder()
    assert not list(order.add(made[5], 0.0))
    assert [block.sequence for block in order.overdue(LONGEST_HOLD_S)] == [5]
    assert order.lost == 5
    assert not list(order.add(replace(made[3], capture="c2"), 5.0))
    assert [block.sequence for block in order.add(replace(made[4], capture="c2"), 6.1)] == [3, 4]
    assert order.lost == 8


def test_a_watch_reports_the_number_of_lost_blocks(session: SessionConfig, caplog: pytest.LogCaptureFixture) -> None:
    recording = recorded()
    estimator = live_estimator(session, recording.robot, reference())
    published = sorted(published_blocks(recording), key=lambda block: int(block.sync[-1]))[:20]
    with watching(session, estimator) as watch:
        keys = Keys(session.cell, recording.robot.name)
        publisher = Publisher(session, keys)
        until(lambda: seen_by(publisher, keys.alive("watch")))
        time.sleep(1.0)
        for k, block in enumerate(published):
            if k not in (8, 9, 10):
                publisher.offer(replace(block, sequence=k))
                time.sleep(0.02)
        until(lambda: watch.lost > 0)
        publisher.close()
    assert watch.lost == 3
    assert "3 blocks did not arrive" in caplog.text


def test_blocks_of_strangers_end_no_watch(session: SessionConfig) -> None:
    recording = recorded()
    estimator = live_estimator(session, recording.robot, reference())
    # A session of a worker drops large messages on a busy machine: it keeps one batch for each peer.
    with watching(session, estimator) as watch, open_session(session, "capture") as stranger:
        key = Keys(session.cell, recording.robot.name).samples
        (block, *_) = published_blocks(recording)
        others = replace(block.layout, joints=tuple(f"other_{joint}" for joint in block.layout.joints))
        for message in (b"no block", encode_block(replace(block, layout=others)), bytes(LARGEST_BLOCK + 1)):
            before, end = watch.refusals.total, time.monotonic() + 60.0
            while watch.refusals.total == before and time.monotonic() < end:
                put_signed(stranger, session, key, message)
                time.sleep(0.2)
            assert watch.refusals.total > before
    assert estimator.result().sync == -1
    # Blocks of another robot are not waited for.
    assert watch.lost == 0


def in_files(folder: Path, *recordings: Recording) -> tuple[list[Path], Path]:
    """Recordings and the reference as files."""
    paths = []
    for k, recording in enumerate(recordings):
        rows = {f"{name}.rows": int(s.sync.size) for name, s in recording.streams.items()}
        paths.append(folder / f"{k}.mcap")
        write_recording(replace(recording, counters=rows), paths[-1])
    document = folder / "identification.json"
    document.write_text(to_json(arms.tx40_baseline()))
    return paths, document


def test_a_replay_prints_lines_for_machines_and_keeps_its_state(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths, document = in_files(tmp_path, arms.recording("tx40", "tx40_1", 7, repeats=2, period=arms.FAST))
    state = tmp_path / "state.npz"
    options = WatchOptions(document, state, as_json=True)
    assert watch_recordings(paths, None, options) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) >= 15
    assert all(line["schema"] == "armident/recursive/1" for line in lines)
    assert lines[0]["joints"][0]["friction_change"]["valid"] is None
    assert lines[0]["joints"][0]["state"] == "no motion"
    last = lines[-1]["joints"][0]
    assert last["state"] == "unchanged"
    assert abs(last["friction_change"]["valid"]) < 0.05
    before = lines[-1]["motion_s"]
    assert watch_recordings(paths, None, options) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["motion_s"] > 1.8 * before


def test_an_alarm_is_the_exit_code_4_and_too_little_motion_a_data_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An alarm within 30 s of motion with a tenth more friction."""
    worn = arms.hide("friction_scale", "joint_3", factor=1.1)
    paths, document = in_files(tmp_path, arms.recording("tx40", "tx40_1", 8, worn, repeats=4, period=arms.FAST))
    assert watch_recordings(paths, None, WatchOptions(document, None, as_json=False)) == 4
    assert "joint_3: alarm" in capsys.readouterr().out
    streams = {
        name: replace(s, raw={f: np.repeat(v[:1], len(v), axis=0) for f, v in s.raw.items()})
        for name, s in arms.recording("tx40", "tx40_1", 7, repeats=2, period=arms.FAST).streams.items()
    }
    still = replace(arms.recording("tx40", "tx40_1", 7, repeats=2, period=arms.FAST), streams=streams)
    (tmp_path / "still").mkdir()
    at_rest, _ = in_files(tmp_path / "still", still)
    with pytest.raises(DataError, match="too little motion for any joint in 0"):
        watch_recordings(at_rest, None, WatchOptions(document, None, as_json=True))


def test_a_watch_without_recording_and_session_says_what_to_give(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="give a RECORDING, or --config SESSION"):
        watch_cell(None, WatchOptions(tmp_path / "identification.json", None, as_json=False))
