"""Prints a hash of what the matcher makes of random streams of frames with faults.

It needs the base of armident alone, so that installations can be compared: ``python tests/tools/matched_streams.py``.
``--cost`` prints the processor time per frame of a stream without faults instead.
"""

import argparse
import hashlib
import time

import numpy as np

from armident.daq.matching.assembler import Assembler, Batch, TpdoStream
from armident.drivers.can.frames import FD_FRAME, FRAME, Frames

PERIOD_NS = 200_000
T0 = 1_700_000_000_000_000_000
SYNCS, BATCH = 1500, 50
JOINTS = 4


def main() -> None:
    """Print the hash or the cost."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cost", action="store_true", help="Print the processor time per frame, us.")
    parser.add_argument("--seeds", type=int, default=8, help="Number of random streams.")
    options = parser.parse_args()
    if options.cost:
        print(f"{cost_us():.2f} us a frame")
        return
    result = hashlib.sha256()
    for seed in range(options.seeds):
        for text in matched(seed):
            result.update(text)
    print(result.hexdigest())


def matched(seed: int) -> list[bytes]:
    """Return rows, gaps and counters of a stream with lost, late, repeated and short frames.

    ``seed``: seed of the faults; it also chooses packed samples, two buses and a foreign SYNC master.
    """
    random = np.random.default_rng(seed)
    pack, buses, foreign = (4 if seed % 3 == 2 else 1), 1 + seed % 2, seed % 4 == 3
    stream = TpdoStream("samples", 1, tuple(range(0x181, 0x181 + JOINTS)), 8 * pack, pack, 8)
    bus_of = [joint % buses for joint in range(JOINTS)]
    first = None if foreign else 1
    assembler = Assembler((stream,), "abcd"[:JOINTS], PERIOD_NS, first_counter=first, bus_of=bus_of)
    out: list[bytes] = []
    for start in range(0, SYNCS, BATCH):
        for bus in range(buses):
            joints = [joint for joint in range(JOINTS) if bus_of[joint] == bus]
            frames = faulty_frames(random, start, joints, pack)
            sent = None if foreign else start + BATCH
            out += content(assembler.push(frames, sent, dropped=bool(random.random() < 0.02), bus=bus))
    out += content(assembler.finish(SYNCS))
    return [*out, repr(assembler.counters).encode()]


def content(batch: Batch) -> list[bytes]:
    """Return what a batch holds. ``batch``: result of the matcher."""
    arrays = [array for rows in batch.rows.values() for array in (rows.sync, rows.t_ns, rows.data)]
    return [*(np.ascontiguousarray(array).tobytes() for array in arrays), repr(batch.gaps).encode()]


def faulty_frames(random: np.random.Generator, start: int, joints: list[int], pack: int) -> Frames:
    """Return the frames of a bus during `BATCH` SYNCs.

    ``start``: number of the first SYNC; ``joints``: joints whose drives are on this bus; ``pack``: samples in a TPDO.
    """
    found: list[tuple[int, int, int, int]] = []
    for k in range(start, start + BATCH):
        if random.random() > 0.003:
            found.append((k * PERIOD_NS + int(random.integers(3000)), 0x80, 1, k % 240 + 1))
        for joint in joints if (k + 1) % pack == 0 else []:
            if random.random() < 0.01:
                continue
            late = 2 * PERIOD_NS if random.random() < 0.02 else 0
            length = 3 if random.random() < 0.001 else 8 * pack
            answer = (k * PERIOD_NS + 20_000 + 1000 * joint + late, 0x181 + joint, length, k % 251)
            found += [answer] * (2 if random.random() < 0.003 else 1)
    found.sort(key=lambda frame: frame[0])
    frames = np.zeros(len(found), FRAME if pack == 1 else FD_FRAME)
    for i, (t_ns, can_id, length, value) in enumerate(found):
        frames["t_ns"][i], frames["can_id"][i], frames["length"][i] = T0 + t_ns, can_id, length
        frames["data"][i, 0] = value
    return frames


def cost_us(joints: int = 6, batches: int = 40) -> float:
    """Return the processor time per frame of a stream without faults, us.

    ``joints``, ``batches``: number of drives, and of batches of `BATCH` SYNCs.
    """
    stream = TpdoStream("samples", 1, tuple(range(0x181, 0x181 + joints)), 8)
    assembler = Assembler((stream,), [str(joint) for joint in range(joints)], PERIOD_NS)
    pushed = []
    for start in range(0, batches * BATCH, BATCH):
        frames = np.zeros(BATCH * (joints + 1), FRAME)
        k, place = np.divmod(np.arange(frames.size), joints + 1)
        frames["t_ns"] = T0 + (start + k) * PERIOD_NS + 1000 * place
        frames["can_id"] = np.where(place == 0, 0x80, 0x180 + place)
        frames["length"] = np.where(place == 0, 1, 8)
        frames["data"][:, 0] = np.where(place == 0, (start + k) % 240 + 1, 0)
        pushed.append(frames)
    assembler.warm_up(pushed[0][:2])
    begun = time.process_time()
    for number, frames in enumerate(pushed, 1):
        assembler.push(frames, number * BATCH)
    spent = time.process_time() - begun
    assert assembler.counters["frames"] == sum(frames.size for frames in pushed)
    return 1e6 * spent / assembler.counters["frames"]


if __name__ == "__main__":
    main()
