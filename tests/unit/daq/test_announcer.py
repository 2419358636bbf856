"""Announcements of processes that are killed at once."""

import multiprocessing
import os
import signal
import threading
import time

import pytest
import zenoh

from armident.configs import SessionConfig
from armident.daq.identity.signatures import signer_for
from armident.daq.streaming import Announcer, Keys, open_session
from armident.daq.streaming.announcer import RETRY_S, longest_retry_s
from tests.unit.daq.test_streaming import cell

KILLED = 6
"""Number of processes that announce at the same time."""


def announce_and_end(session: SessionConfig, number: int, size: int) -> None:
    """Announce a number, followed by blanks up to a size, and end by SIGKILL."""
    keys = Keys(session.cell, "emps")
    opened = open_session(session, "worker", any_port=True)
    announcer = Announcer(opened, keys, 1.0, signer_for(session, "worker"))
    time.sleep(announcer.ready_in_s)
    announcer.announce((keys.identification, str(number).encode().ljust(size)))
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.parametrize("size", [100, 20_000, 1_000_000])
def test_an_announcement_arrives_if_its_process_is_killed_at_once(size: int) -> None:
    session = cell(f"announcer_{size}")
    heard, complete = [set[int](), set[int]()], threading.Event()

    def listen(number: int, sample: zenoh.Sample) -> None:
        heard[number].add(int(bytes(sample.payload)))
        if all(len(each) == KILLED for each in heard):
            complete.set()

    context = multiprocessing.get_context("forkserver")
    key = Keys(session.cell, "emps").identification
    with open_session(session, "worker") as first, open_session(session, "observer", any_port=True) as second:
        declared = [
            first.declare_subscriber(key, lambda sample: listen(0, sample)),
            second.declare_subscriber(key, lambda sample: listen(1, sample)),
        ]
        processes = [context.Process(target=announce_and_end, args=(session, k, size)) for k in range(KILLED)]
        for process in processes:
            process.start()
        for process in processes:
            process.join()
            assert process.exitcode == -signal.SIGKILL
        assert complete.wait(5.0), heard
        for subscriber in declared:
            subscriber.undeclare()


@pytest.mark.parametrize(
    ("retry", "longest_s"),
    [
        ("null", RETRY_S),
        ("{period_init_ms: 100}", RETRY_S),
        ("{period_max_ms: 1500}", 1.5),
        ("{period_max_ms: {router: 8000, peer: 2000}}", 8.0),
    ],
)
def test_the_wait_for_listeners_follows_the_configuration(retry: str, longest_s: float) -> None:
    config = zenoh.Config.from_json5(f"{{connect: {{retry: {retry}}}}}")
    assert longest_retry_s(config) == longest_s


def test_an_announcer_is_ready_when_listeners_have_had_time_to_connect() -> None:
    session = cell("announcer_ready")
    with open_session(session, "worker") as opened:
        announcer = Announcer(opened, Keys(session.cell, "emps"), 0.5, signer_for(session, "worker"))
        assert 1.0 < announcer.ready_in_s <= 1.5
        time.sleep(1.6)
        assert announcer.ready_in_s == 0.0
