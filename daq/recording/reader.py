"""Reads recordings, complete or truncated, in file order and chunk by chunk, straight into arrays."""

import json
import mmap
import os
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import make_reader
from pydantic import ValidationError

from armident.configs import ConfigError, DataError, RobotConfig, SessionConfig
from armident.configs.yaml_loader import is_file
from armident.daq.recording import mcap_records as mcap
from armident.daq.recording.growing_rows import GrowingRows
from armident.daq.recording.layout import StreamLayout, short_reason
from armident.daq.recording.model import Gap, Mark, Recording, Stream, gap_from, mark_from
from armident.daq.recording.names import (
    CHECK,
    COUNTERS,
    CRC_OF,
    FACTS,
    GAPS_TOPIC,
    LAYOUT_KEY,
    MARKS_TOPIC,
    RECORDING,
    RECOVERED,
    ROBOT,
    SAMPLE_RATE,
    SCHEMA,
    SESSION,
    head_texts,
)
from armident.daq.recording.objects import ObjectUrl, located, opened
from armident.daq.recording.scan import LARGEST_CHUNK, ChunkItem, RecordingScan
from armident.daq.recording.stretch import chunk_table, copied, stretch_of, window

_LEAST_ROW, _MOST_RESERVED = 2, 1 << 25
"""Least share of a compressed file that a row takes, bytes, and largest number of rows for which memory is reserved."""
_HEAD = 4096
"""Number of bytes at the begin of a recording that contain the name of its first metadata record."""
_RELEASE_EVERY = 1 << 26
"""Number of bytes read between two releases of the mapped file's pages."""


def read_recording(path: Path | str, between_s: tuple[float, float] | None = None) -> Recording:
    """Read a recording, or a stretch of it; of a truncated one, all complete chunks.

    Parameters
    ----------
    path
        The MCAP file, or the URL of an object such as ``s3://bucket/run.mcap`` (extra ``objects``).
    between_s
        Begin and end of the stretch to read, s after the first sample; of a file or object little else is read.

    Returns
    -------
    Recording
        Raw values in the dtypes they were captured in; ``missing`` is ``None`` if the file is complete. A stretch has
        no counters, and its ``sha256`` is that of its own samples.

    Raises
    ------
    ConfigError
        If there is no such file or object, or it cannot be read.
    DataError
        If it is not a recording of armident, or has no sample in the stretch.
    """
    path = located(path)
    table = None
    try:
        with opened(path) as file:
            size = file.seek(0, os.SEEK_END)
            if size == 0:
                raise DataError(f"{path}: empty, not a recording")
            if between_s is not None:
                table = chunk_table(file)
            if table is not None and between_s is not None:
                data = copied(file, table.needed(window(table.begin_ns, between_s)))
            elif isinstance(path, ObjectUrl):
                data = copied(file, [(0, size)])
            else:
                data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such recording") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    recording = _read(path, data, part=table is not None)
    if between_s is None:
        return recording
    begin_ns = int(min(recording.samples.t_ns, default=0)) if table is None else table.begin_ns
    found = stretch_of(recording, window(begin_ns, between_s))
    if not found.samples.sync.size:
        raise DataError(f"{path}: no sample between {between_s[0]:g} s and {between_s[1]:g} s after its begin")
    return found


def is_recording(path: Path) -> bool:
    """Return True if a file begins like a recording of armident, complete or not.

    Parameters
    ----------
    path
        The file.
    """
    if not is_file(path):
        # A named pipe would be waited for.
        return False
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
            return RECORDING.encode() in head or (head.startswith(mcap.MAGIC) and _is_listed(file))
    except OSError:
        return False


def unpacked_bytes(path: Path) -> int:
    """Return the bytes of a recording's records if its chunks were unpacked; a damaged chunk counts nothing."""
    with path.open("rb") as file:
        if path.stat().st_size == 0:
            return 0
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        return sum(_unpacked(opcode, body) for opcode, _, body in mcap.records(data, len(mcap.MAGIC)))


def has_end(path: Path) -> bool:
    """Return True if a file ends like a finished MCAP file; raises OSError if it cannot be read."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - len(mcap.MAGIC)))
        return file.read() == mcap.MAGIC


def _unpacked(opcode: int, body: memoryview) -> int:
    if opcode != Opcode.CHUNK:
        return len(body)
    try:
        size = mcap.read_chunk(body).size
    except mcap.MalformedRecord:
        return 0
    return size if size <= LARGEST_CHUNK else 0


def _is_listed(file: BinaryIO) -> bool:
    """Return True if the summary of an MCAP file, as other tools write it, lists the metadata of a recording."""
    file.seek(0)
    summary = None
    with suppress(Exception):  # of the library and of the decompressors: a damaged file raises various errors
        summary = make_reader(file).get_summary()
    return summary is not None and any(index.name == RECORDING for index in summary.metadata_indexes)


def recovered_words(metadata: dict[str, dict[str, str]]) -> list[str]:
    """Return a description of what a recovered file lacks, by its metadata records; empty if it was not recovered."""
    entries = metadata.get(RECOVERED) or {}
    return [entries["missing"]] if "missing" in entries else []


@dataclass
class _Content:
    """Rows and events of a file so far."""

    scan: RecordingScan
    most_rows: int
    rows: dict[str, GrowingRows] = field(default_factory=dict)
    layouts: dict[str, StreamLayout] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)

    def rows_of(self, channel: int) -> GrowingRows:
        """Return the rows of a channel; those of one stream share them. DataError if their layouts differ."""
        layout = self.scan.layouts[channel]
        if layout.name not in self.rows:
            expected = min((self.scan.expected or {}).get(channel, 0), self.most_rows)
            self.rows[layout.name], self.layouts[layout.name] = GrowingRows(layout, expected), layout
        if self.layouts[layout.name] != layout:
            raise DataError(f"topic {layout.topic} has two channels with different layouts")
        return self.rows[layout.name]

    def add_chunk(self, chunk: ChunkItem) -> None:
        """Add all messages of a chunk."""
        for run in chunk.runs:
            layout = self.scan.layouts.get(run.channel_id)
            if layout is not None:
                records = np.frombuffer(chunk.raw, layout.record[0], count=run.number, offset=run.start)
                self.rows_of(run.channel_id).append(records)
                continue
            topic = self.scan.channels[run.channel_id].topic
            if topic in (GAPS_TOPIC, MARKS_TOPIC):
                self._add_event(topic, chunk.raw[run.start + mcap.RECORD_HEAD.size + mcap.MESSAGE_HEAD.size : run.end])

    def _add_event(self, topic: str, data: bytes) -> None:
        try:
            entries = json.loads(data)
            if topic == GAPS_TOPIC:
                self.gaps.append(gap_from(entries))
            else:
                self.marks.append(mark_from(entries))
        except (ValueError, RecursionError) as error:
            raise DataError(f"topic {topic}: an invalid event: {short_reason(error)}") from error


def _read(path: Path, mapped: mmap.mmap, *, part: bool) -> Recording:
    """Read the records of a file, or ``part`` of it: its chunks are then fewer than its summary says."""
    data = memoryview(mapped)
    released = 0
    try:
        scan = RecordingScan(data, part=part)
        # The size of the file bounds the memory that its statistics can have us reserve.
        content = _Content(scan, min(len(data) // _LEAST_ROW, _MOST_RESERVED))
        for item in scan:
            if isinstance(item, ChunkItem):
                content.add_chunk(item)
            if item.end - released > _RELEASE_EVERY:
                # Read pages leave our memory; the kernel keeps them in its cache.
                released = item.end // mmap.PAGESIZE * mmap.PAGESIZE
                mapped.madvise(mmap.MADV_DONTNEED, 0, released)
        return _recording(path, content)
    except mcap.MalformedRecord as error:
        raise DataError(f"{path}: damaged: {error}") from error
    except DataError as error:
        if str(path) in str(error):
            raise
        raise DataError(f"{path}: {error}") from error


def _recording(path: Path, content: _Content) -> Recording:
    scan = content.scan
    head = scan.metadata.get(RECORDING)
    if head is None:
        reason = f"no metadata {RECORDING!r}" if scan.finished else "truncated before its first chunk"
        if scan.finished and scan.layouts:
            reason = "another tool left out its metadata; copy them too, as mcap filter --include-metadata does"
        raise DataError(f"{path}: an MCAP file, but not a recording of armident ({reason})")
    if head.get("check") == CHECK and scan.head_crc is None and not scan.rewritten:
        raise DataError(f"{path}: truncated before its first chunk, or its head is damaged")
    if head.get("schema") != SCHEMA:
        raise DataError(f"{path}: a recording of schema {head.get('schema')!r}, this version reads {SCHEMA}")
    _check_head(path, scan)
    first = {layout.name: k for k, layout in reversed(scan.layouts.items())}
    streams = {
        name: _stream(content.rows_of(k), scan.layouts[k], scan.rewritten)
        for name, k in sorted(first.items(), key=itemgetter(1))
    }
    if "samples" not in streams:
        raise DataError(f"{path}: no topic /samples")
    try:
        robot = RobotConfig.model_validate_json(scan.metadata[ROBOT]["json"])
        stored = scan.metadata.get(SESSION)
        session = SessionConfig.model_validate_json(stored["json"]) if stored else None
        rate = float(head[SAMPLE_RATE])
        counters = {key: int(value) for key, value in scan.metadata.get(COUNTERS, {}).items()}
    except (KeyError, ValidationError, ValueError) as error:
        raise DataError(f"{path}: its configuration is invalid: {short_reason(error)}") from error
    joints = tuple(joint.name for joint in robot.joints)
    for layout in scan.layouts.values():
        if layout.joints != joints:
            raise DataError(f"{path}: topic {layout.topic} has other joints than its robot {robot.name}")
    sync = streams["samples"].sync
    missing = recovered_words(scan.metadata) + scan.missing(int(sync[-1]) if sync.size else None)
    return Recording(
        path=path,
        robot=robot,
        session=session,
        sample_rate_hz=rate,
        streams=streams,
        gaps=tuple(content.gaps),
        marks=tuple(content.marks),
        counters=counters,
        metadata=scan.metadata.get(FACTS, {}),
        missing="; ".join(missing) or None,
    )


def _check_head(path: Path, scan: RecordingScan) -> None:
    """Refuse a file with configurations, layouts or a rate that do not fit their own checksums."""
    layouts = {c.topic: c.metadata[LAYOUT_KEY] for c in scan.channels.values() if LAYOUT_KEY in c.metadata}
    head = scan.metadata[RECORDING]
    if not any(key.startswith(CRC_OF) for key in head):
        return  # a recording of version 0.2 or earlier
    for name, text in head_texts(scan.metadata, layouts).items():
        if head.get(f"{CRC_OF}{name}") != str(zlib.crc32(text.encode())):
            raise DataError(f"{path}: its head is damaged: wrong checksum of {name}")


def _stream(rows: GrowingRows, layout: StreamLayout, rewritten: bool) -> Stream:
    """Return the rows of a stream; those of a file that another tool has sorted by time are put in order again."""
    sync, t_ns, raw = rows.arrays()
    if rewritten and np.any(sync[1:] < sync[:-1]):
        order = np.argsort(sync, kind="stable")
        sync, t_ns, raw = sync[order], t_ns[order], {name: values[order] for name, values in raw.items()}
    if np.any(sync[1:] <= sync[:-1]):
        raise DataError(
            f"topic {layout.topic}: SYNC numbers do not increase: "
            "duplicate messages, or several recordings in one file; give each recording by itself"
        )
    return Stream(layout.name, layout.every, sync, t_ns, {f.name: f for f in layout.fields}, raw)
