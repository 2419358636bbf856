"""Binary format of published blocks and events, and their assembly to a recording.

A block is ``ARMB``, version (u16), length of the head (u32), CRC-32 of all that follows it, the head (JSON: capture,
sequence number, rows, stream layout), then ``sync`` and ``t_ns`` as int64 and every field's raw values, little endian,
row by row. Version 2 added the name of the capture.
"""

import json
import math
import re
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig, SessionConfig
from armident.daq.recording import Gap, Mark, Recording, Stream, StreamLayout
from armident.daq.recording.layout import short_reason
from armident.daq.recording.model import gap_from, mark_from

VERSION = 2
EVENT_SCHEMA = "armident/event/1"
_MAGIC = b"ARMB"
_CAPTURE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,199}")
_NEEDED: dict[str, dict[str, type | tuple[type, ...]]] = {
    "experiment_start": {
        "capture": str, "sample_rate_hz": (int, float), "robot": dict, "session": dict, "layouts": list,
        "metadata": dict,
    },
    "experiment_end": {
        "capture": str, "blocks": int, "counters": dict, "gaps": list, "marks": list, "paths": list,
    },
}  # fmt: skip
"""Entries of events that the assembly of a capture needs, with their types."""
_HEAD = struct.Struct("<4sHII")
_LARGEST_HEAD = 1 << 16
_MOST_ROWS = 1 << 20


@dataclass(frozen=True)
class Block:
    """Consecutive rows of one stream: SYNC numbers and times (N,), ns UTC, and raw values (N, n) by field.

    ``sequence``: number in the capture, over all streams. ``capture``: its name, as in events; empty without capture.
    """

    layout: StreamLayout
    sequence: int
    sync: NDArray[np.int64]
    t_ns: NDArray[np.int64]
    raw: dict[str, NDArray[Any]]
    capture: str = ""

    @property
    def nbytes(self) -> int:
        """Memory of its samples, bytes."""
        return self.sync.nbytes + self.t_ns.nbytes + sum(values.nbytes for values in self.raw.values())


def encode_block(block: Block) -> bytes:
    """Return the bytes of a block."""
    content = {"capture": block.capture, "sequence": block.sequence, "rows": len(block.sync)}
    head = json.dumps(content | {"layout": json.loads(block.layout.to_json())}).encode()
    parts = [head, block.sync.astype("<i8").tobytes(), block.t_ns.astype("<i8").tobytes()]
    for field, dtype in zip(block.layout.fields, block.layout.dtypes, strict=True):
        parts.append(block.raw[field.name].astype(np.dtype(dtype).newbyteorder("<")).tobytes())
    body = b"".join(parts)
    return _HEAD.pack(_MAGIC, VERSION, len(head), zlib.crc32(body)) + body


def decode_block(data: bytes) -> Block:
    """Return the block in these bytes; every length is checked, and a DataError refuses what is no block."""
    if len(data) < _HEAD.size:
        raise DataError(f"a block of {len(data)} bytes is too short")
    magic, version, head_size, crc = _HEAD.unpack_from(data)
    if magic != _MAGIC:
        raise DataError("not a block of samples")
    if version != VERSION:
        raise DataError(f"a block of version {version}, this program reads {VERSION}")
    body = memoryview(data)[_HEAD.size :]
    if head_size > min(len(body), _LARGEST_HEAD):
        raise DataError("a block shorter than its head states")
    if zlib.crc32(body) != crc:
        raise DataError("a block whose checksum is wrong")
    try:
        head = json.loads(bytes(body[:head_size]))
        capture, sequence, rows = head["capture"], _count(head["sequence"]), _count(head["rows"])
        if not isinstance(capture, str) or (capture and not _CAPTURE.fullmatch(capture)):
            raise TypeError(f"a capture named {capture!r:.60}")
        layout = StreamLayout.from_json(json.dumps(head["layout"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(f"a block with an invalid head: {short_reason(error)}") from error
    shape = rows, len(layout.joints)
    dtypes = [np.dtype(dtype).newbyteorder("<") for dtype in layout.dtypes]
    size = rows * (16 + sum(dtype.itemsize for dtype in dtypes) * len(layout.joints))
    if not 0 <= rows <= _MOST_ROWS or len(body) - head_size != size:
        raise DataError(f"a block of {len(body) - head_size} bytes where {rows} rows of {layout.topic} need {size}")
    at = _HEAD.size + head_size
    sync = np.frombuffer(data, "<i8", rows, at).astype(np.int64)
    t_ns = np.frombuffer(data, "<i8", rows, at + 8 * rows).astype(np.int64)
    at += 16 * rows
    raw = {}
    for field, dtype in zip(layout.fields, dtypes, strict=True):
        values = np.frombuffer(data, dtype, shape[0] * shape[1], at)
        raw[field.name] = values.reshape(shape).astype(dtype.newbyteorder("="))
        at += values.nbytes
    return Block(layout, sequence, sync, t_ns, raw, capture)


def encode_event(kind: str, content: Mapping[str, Any]) -> bytes:
    """Return the bytes of an event: JSON with ``schema`` and ``kind``."""
    return json.dumps({"schema": EVENT_SCHEMA, "kind": kind, **content}).encode()


def decode_event(data: bytes) -> dict[str, Any]:
    """Return the entries of the event in these bytes; DataError if they are no event of this version."""
    try:
        event = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise DataError(f"an event that is not JSON: {short_reason(error)}") from error
    if not isinstance(event, dict) or event.get("schema") != EVENT_SCHEMA or not isinstance(event.get("kind"), str):
        raise DataError(f"not an event of schema {EVENT_SCHEMA}")
    needed = _NEEDED.get(event["kind"], {})
    for key, kinds in needed.items():
        if key not in event or not isinstance(event[key], kinds) or isinstance(event[key], bool):
            raise DataError(f"an event {event['kind']} whose {key!r} is missing or invalid")
    # Listeners use the name of the capture as a file name.
    if "capture" in needed and not _CAPTURE.fullmatch(event["capture"]):
        raise DataError(f"an event of a capture named {event['capture']!r:.60}")
    return event


def start_content(
    capture: str,
    robot: RobotConfig,
    session: SessionConfig,
    sample_rate_hz: float,
    layouts: Iterable[StreamLayout],
    metadata: Mapping[str, str],
) -> dict[str, Any]:
    """Return the content of an ``experiment_start`` event: all that a listener needs to decode the following blocks."""
    return {
        "capture": capture,
        "sample_rate_hz": sample_rate_hz,
        "robot": robot.model_dump(mode="json", by_alias=True),
        "session": session.model_dump(mode="json", by_alias=True),
        "layouts": [json.loads(layout.to_json()) for layout in layouts],
        "metadata": dict(metadata),
    }


def end_content(
    capture: str,
    blocks: int,
    counters: Mapping[str, int],
    gaps: Iterable[Gap],
    marks: Iterable[Mark],
    paths: Sequence[Path],
) -> dict[str, Any]:
    """Return the content of an ``experiment_end`` event: the required blocks, and the files."""
    return {
        "capture": capture,
        "blocks": blocks,
        "counters": dict(counters),
        "gaps": [asdict(gap) for gap in gaps],
        "marks": [asdict(mark) for mark in marks],
        "paths": [str(path) for path in paths],
    }


def assemble(start: Mapping[str, Any], blocks: Iterable[Block], end: Mapping[str, Any]) -> Recording:
    """Return the recording of a published capture from its events and its blocks, in any order, with duplicates."""
    if start.get("capture") != end.get("capture"):
        raise DataError("the start and the end are of different captures")
    try:
        robot = RobotConfig.model_validate_json(json.dumps(start["robot"]))
        session = SessionConfig.model_validate_json(json.dumps(start["session"]))
        layouts = [StreamLayout.from_json(json.dumps(layout)) for layout in start["layouts"]]
        rate, total = float(start["sample_rate_hz"]), _count(end["blocks"])
        gaps = tuple(gap_from(gap) for gap in end["gaps"])
        marks = tuple(mark_from(mark) for mark in end["marks"])
        counters = {str(key): int(value) for key, value in end["counters"].items()}
        metadata = {str(key): str(value) for key, value in start["metadata"].items()}
        path = Path(end["paths"][-1]) if end["paths"] else None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise DataError(f"an invalid event: {short_reason(error)}") from error
    if not 0.0 < rate < math.inf:
        raise DataError(f"an invalid event: a rate of {rate} samples/s")
    joints = tuple(joint.name for joint in robot.joints)
    if {layout.joints for layout in layouts} != {joints} or len({la.name for la in layouts}) < len(layouts):
        raise DataError("an invalid event: its streams have other joints than its robot")
    if "samples" not in {layout.name for layout in layouts}:
        raise DataError("an invalid event: no stream of samples")
    by_number = {block.sequence: block for block in blocks if 0 <= block.sequence < total}
    ordered = [by_number[k] for k in sorted(by_number)]
    known = {layout.name: layout for layout in layouts}
    for block in ordered:
        if block.capture != start["capture"]:
            raise DataError(f"a block of capture {block.capture or 'none'!r:.60}, not of {start['capture']}")
        if known.get(block.layout.name) != block.layout:
            raise DataError(f"a block of stream {block.layout.name!r} does not have the layout of the start event")
    lost = total - len(by_number)
    return Recording(
        path=path,
        robot=robot,
        session=session,
        sample_rate_hz=rate,
        streams={
            layout.name: _stream(layout, [b for b in ordered if b.layout.name == layout.name]) for layout in layouts
        },
        gaps=gaps,
        marks=marks,
        counters=counters,
        metadata=metadata,
        missing=f"{lost} of {total} blocks did not arrive" if lost else None,
    )


def _count(value: object) -> int:
    """Return the value if it is a non-negative integer."""
    if type(value) is not int or value < 0:
        raise TypeError(f"expected a count, found {value!r:.60}")
    return value


def _stream(layout: StreamLayout, blocks: list[Block]) -> Stream:
    fields = {f.name: f for f in layout.fields}
    empty = np.empty(0, np.int64)
    sync = np.concatenate([empty, *(b.sync for b in blocks)])
    if np.any(np.diff(sync) <= 0):
        raise DataError(f"stream {layout.name}: SYNC numbers do not increase")
    raw = {
        f.name: np.concatenate([np.empty((0, len(layout.joints)), dtype), *(b.raw[f.name] for b in blocks)])
        for f, dtype in zip(layout.fields, layout.dtypes, strict=True)
    }
    return Stream(layout.name, layout.every, sync, np.concatenate([empty, *(b.t_ns for b in blocks)]), fields, raw)
