"""A master delayed at any point, also between two buses: all buses get equal SYNC numbers."""

import numpy as np
import pytest

from armident.daq.matching.assembler import Assembler, Batch, TpdoStream
from armident.drivers.can.frames import Frames, frames

pytestmark = pytest.mark.slow

PERIOD_NS = 200_000
OVERFLOW = 240
BUSES = 3
T0 = 1_700_000_000_000_000_000
STREAMS = (TpdoStream("samples", 1, (0x181,) * BUSES, 8),)


def sent(rng: np.random.Generator, count: int, stalls: int) -> list[Frames]:
    """Frames of each bus: SYNC after SYNC, on one bus after the other, each followed by its drive's answer.

    The master sleeps for the rest of a period; after a delay it continues without catching up.
    """
    held = np.zeros(2 * BUSES * count)
    held[rng.integers(held.size, size=stalls)] = rng.uniform(1, 1000, stalls) * PERIOD_NS
    # Some for as long as whole turns of the counter take.
    turned = rng.integers(held.size, size=stalls)
    held[turned] = (OVERFLOW * rng.integers(1, 4, stalls) + rng.uniform(-2, 2, stalls)) * PERIOD_NS
    took = rng.uniform(500, 4000, held.size) + held
    out = [frames(2 * count) for _ in range(BUSES)]
    at, grid = 0.0, 0.0
    for k in range(count):
        at = grid = max(at, grid + PERIOD_NS)
        for bus in range(BUSES):
            for i, (can_id, length) in enumerate([(0x80, 1), (0x181, 8)]):
                at += took[2 * (BUSES * k + bus) + i]
                frame = out[bus][2 * k + i]
                frame["t_ns"], frame["can_id"], frame["length"] = T0 + int(at), can_id, length
                number = k % OVERFLOW + 1 if i == 0 else k
                frame["data"] = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
    return out


@pytest.mark.parametrize(
    "seeds", [range(6), pytest.param(range(6, 100), marks=pytest.mark.nightly)], ids=["few", "many"]
)
@pytest.mark.parametrize("stalls", [1, 4, 20])
def test_buses_of_a_delayed_master_get_equal_numbers(stalls: int, seeds: range) -> None:
    for seed in seeds:
        rng = np.random.default_rng(seed)
        count = 4000
        buses = sent(rng, count, stalls)
        assembler = Assembler(STREAMS, ("a", "b", "c"), PERIOD_NS, nodes=(1, 1, 1), bus_of=tuple(range(BUSES)))
        # A reader looks at one bus after the other, every now and then.
        begin, end = T0, max(int(bus["t_ns"][-1]) for bus in buses)
        batches: list[Batch] = []
        read = [0] * BUSES
        while begin <= end:
            begin += int(rng.choice([1, 10, 300]) * PERIOD_NS)
            for bus, own in enumerate(buses):
                until = int(np.searchsorted(own["t_ns"], begin + int(rng.integers(50_000)), "right"))
                batches.append(assembler.push(own[read[bus] : until], bus=bus))
                read[bus] = max(until, read[bus])
        batches.append(assembler.finish())
        sync = np.concatenate([b.rows["samples"].sync for b in batches])
        data = np.concatenate([b.rows["samples"].data for b in batches])
        number = data[:, :, :8].copy().view("<i8")[:, :, 0]
        assert np.all(number == number[:, :1]), f"seed {seed}: values of several SYNCs in one row"
        # A delay of whole counter turns may count as missed SYNCs, on all buses.
        assert np.all((sync - number[:, 0]) % OVERFLOW == 0), seed
        assert sync.size > 0.95 * count, seed
