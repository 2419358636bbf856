"""Check of a recording against the frames on the bus."""

import numpy as np
from numpy.typing import NDArray

from armident.daq.recording import Recording
from armident.daq.recording.model import Stream
from tests.faults.farm import current_of, demand_of, position_of
from tests.faults.plan import Outcome


def violations(
    done: Outcome, syncs_by_bus: list[list[int]], seen: list[NDArray[np.int64]], producing: bool, turns: bool
) -> list[str]:
    """Return the violations of a recording; there should be none.

    Parameters
    ----------
    done
        Recording, counters and log of the capture.
    syncs_by_bus
        Per bus the numbers of all SYNCs, as the drives or the master counted them.
    seen
        Per bus time (ns) and counter of every SYNC, (N, 2), as an independent socket received them.
    producing
        True if the capture sent the SYNCs.
    turns
        True if the numbers may differ by turns of the counter: those cannot be distinguished from a paused master.
    """
    found = []
    for b, (syncs, received) in enumerate(zip(syncs_by_bus, seen, strict=True)):
        if len(syncs) != len(received):
            found.append(f"bus {b}: {len(received)} SYNCs received, {len(syncs)} answered")
    if found:
        return found
    number: dict[int, int] = {}
    for syncs, received in zip(reversed(syncs_by_bus), reversed(seen), strict=True):
        number |= dict(zip(received[:, 0].tolist(), syncs, strict=True))
    counters, samples = done.counters, done.recording.samples
    found += _accounted(done.recording, samples, counters["samples.expected"])
    try:
        k = np.array([number[t] for t in samples.t_ns.tolist()], np.int64)
    except KeyError as error:
        return [*found, f"a row has the time {error} of no SYNC"]
    shift = samples.sync - k
    if not turns and np.any(shift):
        found.append(f"row of SYNC {k[shift != 0][0]} is numbered {samples.sync[shift != 0][0]}")
    if np.any(np.diff(shift) < 0):
        found.append("SYNC numbers go back")
    last = max((syncs[-1] for syncs in syncs_by_bus if syncs), default=-1)
    if counters["samples.expected"] < last + 1 + (int(shift[-1]) if shift.size else 0):
        found.append(f"{last + 1} SYNCs went over the bus, {counters['samples.expected']} are accounted for")
    # The frames that the kernel dropped after the last one may all be SYNCs, or none of them.
    surplus = counters["samples.expected"] - last - 1
    if not turns and not producing and not 0 <= surplus <= counters["sync_unseen"]:
        found.append(f"{last + 1} SYNCs were sent, {counters['samples.expected']} are accounted for")
    if producing and counters["samples.expected"] != counters["sync_sent"]:
        found.append(f"{counters['sync_sent']} SYNCs sent, {counters['samples.expected']} accounted for")
    joints = np.arange(6)
    found += _values("position", samples, position_of(k[:, None], joints))
    found += _values("current", samples, current_of(k[:, None], joints))
    demand = done.recording.streams["demand"]
    k = np.array([number.get(t, -1) for t in demand.t_ns.tolist()], np.int64)
    found += _values("demand", demand, demand_of(k[:, None], joints))
    found += _accounted(done.recording, demand, None)
    lost_rows = sum(
        g.last - g.first + 1 for g in done.recording.gaps if g.stream == "samples" and g.reason == "not written"
    )
    if counters["samples.rows"] != samples.sync.size + lost_rows:
        found.append(f"{counters['samples.rows']} rows counted, {samples.sync.size} there, {lost_rows} not written")
    return found


def _accounted(recording: Recording, stream: Stream, expected: int | None) -> list[str]:
    rows = stream.sync
    gaps = [np.arange(g.first, g.last + 1, stream.every) for g in recording.gaps if g.stream == stream.name]
    missing = np.unique(np.concatenate(gaps)) if gaps else np.zeros(0, np.int64)
    found = []
    if np.any(np.diff(rows) <= 0):
        found.append(f"{stream.name}: a row is there twice, or out of order")
    if (both := np.intersect1d(rows, missing)).size:
        found.append(f"{stream.name}: SYNC {both[0]} and {both.size - 1} more are received and in a gap")
    together = np.union1d(rows, missing)
    if expected is not None and not np.array_equal(together, np.arange(expected)):
        absent = np.setdiff1d(np.arange(expected), together)
        found.append(
            f"{stream.name}: of {expected} SYNCs {absent.size} are neither received nor in a gap: {absent[:5]}"
        )
    if expected is None and together.size and np.any(np.diff(together) != stream.every):
        at = together[:-1][np.diff(together) != stream.every]
        found.append(f"{stream.name}: SYNCs behind {at[:5]} are neither received nor in a gap")
    return found


def _values(name: str, stream: Stream, expected: NDArray[np.int64]) -> list[str]:
    wrong = stream.raw[name] != expected
    if not wrong.any():
        return []
    row, joint = np.argwhere(wrong)[0]
    return [
        f"{wrong.sum()} values of {name} are not of their SYNC, the first at {stream.sync[row]}, joint_{joint + 1}: "
        f"{stream.raw[name][row, joint]} instead of {expected[row, joint]}"
    ]
