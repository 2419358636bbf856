"""Walk through a synthetic packet ring: order, wrap-around, filters, sizes and dropped frames."""

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.drivers.can import packet_ring
from armident.drivers.can.frames import ERROR_FLAG, FD_FLAG, FRAME, Frames, frames
from armident.drivers.can.mmsg import frame_bytes

CLASSIC, FD = 16, 72
ALL = np.ones(2048, np.bool_)
COPIED = "<u4 status, <u4 length, <u4 captured, <u2 mac, <u2 net, <u4 seconds, <u4 nanoseconds"
HEADER = np.dtype([(name, kind) for kind, name in (field.split() for field in COPIED.split(", "))])


def ring(count: int, size: int = 96) -> NDArray[np.int64]:
    """Empty ring of so many slots."""
    return np.zeros((count, size // 8), np.int64)


def fill(
    slots: NDArray[np.int64], k: int, can_id: int, data: bytes = b"", length: int = CLASSIC, flags: int = 0
) -> None:
    """Write a frame to slot ``k`` as the kernel does (struct tpacket2_hdr, then the frame at ``tp_mac``)."""
    octets = slots.view(np.uint8)[k]
    header = octets[: HEADER.itemsize].view(HEADER)
    header["length"] = header["captured"] = length
    header["mac"] = header["net"] = packet_ring.HEADER_BYTES
    header["seconds"], header["nanoseconds"] = 3_000_000_000, 999_999_000 + k
    header["status"] = packet_ring.STATUS_USER | 1 << 29 | flags
    start = packet_ring.HEADER_BYTES
    octets[start : start + 4] = np.frombuffer(np.uint32(can_id).tobytes(), np.uint8)
    octets[start + 4] = len(data)
    octets[start + 8 : start + 8 + len(data)] = np.frombuffer(data, np.uint8)


def copied(slots: NDArray[np.int64], first: int, count: int, accept: NDArray[np.bool_] = ALL, **how: bool) -> Frames:
    """Frames copied from filled slots."""
    batch = frames(count, how.get("fd", False))
    into = frame_bytes(batch).view(np.int64)
    written, _ = packet_ring.copy_frames(slots, first, count, accept, how.get("errors", False), into)
    return batch[:written]


def test_filled_slots_are_counted_up_to_the_first_empty_one_and_around_the_end() -> None:
    slots = ring(5)
    for k in (3, 4, 0):
        fill(slots, k, 0x181)
    assert packet_ring.filled(slots, 3, 10) == 3
    assert packet_ring.filled(slots, 3, 2) == 2
    assert packet_ring.filled(slots, 1, 10) == 0
    for k in (1, 2):
        fill(slots, k, 0x181)
    assert packet_ring.filled(slots, 3, 10) == 5


def test_frames_are_copied_in_order_around_the_end_with_times_of_64_bits() -> None:
    slots = ring(4)
    for k, value in ((2, 10), (3, 11), (0, 12)):
        fill(slots, k, 0x180 + value, bytes([value]) * 8)
    got = copied(slots, 2, 3)
    assert got["can_id"].tolist() == [0x18A, 0x18B, 0x18C]
    assert got["data"][:, 7].tolist() == [10, 11, 12]
    assert got["length"].tolist() == [8, 8, 8]
    assert got["t_ns"].tolist() == [3_000_000_000 * 10**9 + 999_999_000 + k for k in (2, 3, 0)]
    packet_ring.release(slots, 2, 3)
    assert packet_ring.filled(slots, 2, 4) == 0


@pytest.mark.parametrize("errors", [False, True])
def test_error_frames_and_unwanted_identifiers_are_skipped(errors: bool) -> None:
    slots, accept = ring(4), np.zeros(2048, np.bool_)
    accept[0x80] = True
    for k, can_id in enumerate((0x80, 0x81, ERROR_FLAG | 0x20, 0x80)):
        fill(slots, k, can_id)
    wanted = [0x80, *([ERROR_FLAG | 0x20] if errors else []), 0x80]
    assert copied(slots, 0, 4, accept, errors=errors)["can_id"].tolist() == wanted


def test_frames_of_can_fd_are_marked_and_classic_ones_are_padded_with_zeros() -> None:
    slots = ring(2, 160)
    slots[:] = -1
    fill(slots, 0, 0x181, bytes(range(64)), FD)
    fill(slots, 1, 0x182, b"\x07" * 8)
    # Bytes of the frame that the kernel writes, too: flags and reserved.
    slots.view(np.uint8)[:, packet_ring.HEADER_BYTES + 5 : packet_ring.HEADER_BYTES + 8] = 0
    got = copied(slots, 0, 2, fd=True)
    assert got["flags"].tolist() == [FD_FLAG, 0]
    assert got["data"][0].tolist() == list(range(64))
    assert got["data"][1].tolist() == [7] * 8 + [0] * 56


def test_frames_of_other_sizes_are_skipped() -> None:
    slots = ring(3, 160)
    for k, length in enumerate((CLASSIC, 2060, FD)):
        fill(slots, k, 0x181 + k, length=length)
    assert copied(slots, 0, 3)["can_id"].tolist() == [0x181]
    assert copied(slots, 0, 3, fd=True)["can_id"].tolist() == [0x181, 0x183]


def test_a_slot_behind_dropped_frames_is_reported() -> None:
    slots = ring(3)
    for k in range(3):
        fill(slots, k, 0x181, flags=packet_ring.STATUS_LOSING if k == 2 else 0)
    into = np.zeros((3, FRAME.itemsize // 8), np.int64)
    assert packet_ring.copy_frames(slots, 0, 2, ALL, False, into) == (2, False)
    assert packet_ring.copy_frames(slots, 1, 2, ALL, False, into) == (2, True)
