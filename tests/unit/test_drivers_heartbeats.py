"""When heartbeats came is told by their stamps, however late they are looked at."""

import time
from typing import Any

import numpy as np
import pytest

from configs.session import Bus
from drivers import heartbeats as module
from drivers.frames import BusDown, Frames, frames
from drivers.heartbeats import Heartbeats


class Waiting:
    """A bus on which frames wait."""

    bound = True

    def __init__(self) -> None:
        self.batches: list[list[tuple[int, float]]] = []
        self.down = False

    def receive(self, batch: Frames) -> int:
        """Node and age (s) of each heartbeat, as frames."""
        if self.down:
            self.down = False
            raise BusDown("bus: went down")
        if not self.batches:
            return 0
        taken = self.batches.pop(0)
        some = frames(len(taken))
        some["can_id"] = [0x700 + node for node, _ in taken]
        some["t_ns"] = [time.time_ns() - round(age * 1e9) for _, age in taken]
        batch[: len(taken)] = some
        return len(taken)

    def close(self) -> None:
        """Nothing to release."""


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Waiting:
    waiting = Waiting()
    monkeypatch.setattr(module, "open_bus", lambda *_, **__: waiting)
    return waiting


def consumer(bus: Waiting, began: float) -> Heartbeats:
    """Of nodes 1 and 2, both heard ``began`` seconds ago."""
    heartbeats = Heartbeats(Bus(channel="vcan0"), (1, 2))
    bus.batches = [[(1, began), (2, began)]]
    heartbeats._last = dict.fromkeys((1, 2), time.monotonic() - began)
    heartbeats.read()
    return heartbeats


def test_heartbeats_that_waited_while_nobody_looked_are_no_silence(bus: Waiting) -> None:
    heartbeats = consumer(bus, 2.0)
    bus.batches = [[(1, 2.0 - 0.1 * k) for k in range(1, 20)]]
    heartbeats.read()
    assert heartbeats.silent(1) == pytest.approx(0.1, abs=0.05)
    assert heartbeats.ended(1) == pytest.approx(0.1, abs=0.05)
    assert heartbeats.silent(2) == pytest.approx(2.0, abs=0.05)
    assert heartbeats.ended(2) == 0.0


def test_a_silence_between_two_looks_is_told(bus: Waiting) -> None:
    heartbeats = consumer(bus, 2.0)
    bus.batches = [[(1, 1.9), (1, 1.0)], [(1, 0.9)]]
    heartbeats.read()
    assert heartbeats.ended(1) == pytest.approx(0.9, abs=0.05)
    heartbeats.read()
    assert heartbeats.ended(1) == 0.0


def test_a_clock_that_is_set_makes_nobody_silent(bus: Waiting, monkeypatch: pytest.MonkeyPatch) -> None:
    heartbeats = consumer(bus, 0.1)
    real = time.time_ns
    for step in (3_600_000_000_000, -3_600_000_000_000):
        monkeypatch.setattr(time, "time_ns", lambda step=step: real() + step)
        bus.batches = [[(1, 0.05), (2, 0.05)]]
        heartbeats.read()
        assert heartbeats.ended(1) < 0.2
        assert heartbeats.silent(1) < 0.2


def test_a_bus_that_is_down_has_nothing_to_tell(bus: Waiting) -> None:
    heartbeats = consumer(bus, 1.0)
    bus.down = True
    heartbeats.read()
    assert heartbeats.silent(1) == pytest.approx(1.0, abs=0.05)
    bus.batches = [[(1, 0.0)]]
    heartbeats.read()
    assert heartbeats.silent(1) == pytest.approx(0.0, abs=0.05)


def test_beginning_forgets_what_was_before(bus: Waiting) -> None:
    heartbeats = consumer(bus, 5.0)
    heartbeats.begin()
    silences: Any = [heartbeats.silent(node) for node in (1, 2)]
    assert np.max(silences) < 0.1
