"""Frames of Vector BLF logs, without damaged blocks; the layout is that of the reader of python-can.

A BLF file is a header and a sequence of objects. Containers hold further objects, compressed or not, and an object may
continue in the next container.
"""

import struct
import zlib
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from armident.configs import DataError
from armident.daq.interchange.log_frames import LATEST_NS, FrameCollector

_HEADER = struct.Struct("<4sLBBBBBBBBQQLL8H8H")
_OBJECT = struct.Struct("<4sHHLL")
_OBJECT_TIME = struct.Struct("<LHHQ")
_CONTAINER = struct.Struct("<H6xL4x")
_CLASSIC = struct.Struct("<HBBL8s")
_CONTAINER_TYPE = 10
_FD = struct.Struct("<HBBLLBBB5x")
"""Frame of a CAN FD channel: channel, flags, DLC, identifier, ., ., FD flags, valid bytes; data follow."""
_FD_64 = struct.Struct("<BBBBLLLLLLLHBBL")
"""The same in the later form: channel, DLC, valid bytes, ., identifier, ., flags, ..., begin of further data, .; data
follow."""
_EDL, _EDL_64, _REMOTE_64 = 0x1, 0x1000, 0x10
"""Extended data length, which classic frames of a CAN FD channel lack, and remote frames of the later form."""
_OTHER_FRAMES = (73, 104)
"""Error frames."""
_UNCOMPRESSED, _DEFLATED = 0, 2
_EXTENDED, _REMOTE = 0x8000_0000, 0x80
_IN_TEN_MICROSECONDS = 1
_LARGEST_CONTAINER = 256 * 2**20
"""Containers that expand to more are damaged, bytes; writers use 128 KiB."""


def read_blf(path: Path, into: FrameCollector) -> None:
    """Add the frames of a BLF log, and a note for what is damaged or cut off; DataError if it is no BLF file."""
    with path.open("rb") as file:
        head = file.read(_HEADER.size)
        if len(head) < _HEADER.size or head[:4] != b"LOGG":
            raise DataError(f"{path}: not a BLF log: it does not begin with LOGG")
        header = _HEADER.unpack(head)
        file.seek(max(header[1], _HEADER.size))
        reader = _Objects(into, _system_time_ns(header[14:22]))
        damaged = 0
        cut = False
        while begin := file.read(_OBJECT.size):
            if len(begin) < _OBJECT.size:
                cut = True
                break
            signature, _, _, size, kind = _OBJECT.unpack(begin)
            if signature != b"LOBJ" or not _OBJECT.size <= size <= _LARGEST_CONTAINER:
                damaged += 1
                break
            body = file.read(size - _OBJECT.size)
            cut = len(body) < size - _OBJECT.size
            file.read(size % 4)
            if kind != _CONTAINER_TYPE:
                reader.take(begin + body)
                continue
            content = _content(body, cut)
            if content is None:
                damaged += 1
                reader.resume()
            else:
                reader.take(content)
        cut = cut or header[10] > path.stat().st_size
        if not header[12] and into.count and not cut:
            into.notes.append("not finished by its writer: frames may be missing at its end")
        if cut or reader.unfinished:
            into.notes.append(f"the file is cut off: {_of_total(into, header[12])} are read")
        if damaged or reader.damaged:
            count = damaged + reader.damaged
            into.skipped += count
            into.notes.append(
                f"{count} damaged block{'s' if count > 1 else ''} left out: {_of_total(into, header[12])} are read"
            )


def _of_total(into: FrameCollector, objects: int) -> str:
    read = into.count + into.foreign
    return f"{read} of {objects} frames" if objects > read else f"{read} frames"


def _content(body: bytes, cut: bool) -> bytes | None:
    """Return the objects of a container; up to its end if it is ``cut`` off, ``None`` if it is damaged."""
    if len(body) < _CONTAINER.size:
        return b"" if cut else None
    method, size = _CONTAINER.unpack_from(body)
    packed = body[_CONTAINER.size :]
    if method == _UNCOMPRESSED:
        return packed if cut or len(packed) >= size else None
    if method != _DEFLATED:
        return None
    expand = zlib.decompressobj()
    try:
        content = expand.decompress(packed, _LARGEST_CONTAINER)
    except zlib.error:
        # The checksum is at the end: no byte of a damaged container is certain.
        return None
    return content if cut or expand.eof else None


class _Objects:
    """Takes the objects of a log in pieces."""

    def __init__(self, into: FrameCollector, start_ns: int) -> None:
        self._into, self._start_ns = into, start_ns
        self._rest = b""
        self._lost = False
        self.damaged = 0

    @property
    def unfinished(self) -> bool:
        """``True`` if an object has begun and not ended."""
        return len(self._rest.rstrip(b"\0")) >= 4

    def resume(self) -> None:
        """Continue at the next object: bytes between were lost."""
        self._rest, self._lost = b"", True

    def take(self, piece: bytes) -> None:
        """Add the frames of a piece; an object at its end may continue in the next one."""
        data = self._rest + piece
        at = 0
        while True:
            # Objects are padded to four bytes, after a loss the next one may be anywhere.
            found = data.find(b"LOBJ", at) if self._lost else data.find(b"LOBJ", at, at + 8)
            if found < 0:
                if not self._lost and len(data) - at >= 8:
                    self.damaged, self._lost = self.damaged + 1, True
                    continue
                self._rest = b"" if self._lost else data[at:]
                return
            self._lost = False
            at = found
            if len(data) - at < _OBJECT.size:
                break
            size, kind = struct.unpack_from("<LL", data, at + 8)
            if not _OBJECT.size <= size <= _LARGEST_CONTAINER:
                self.damaged, self._lost = self.damaged + 1, True
                at += 4
                continue
            if at + size > len(data):
                break
            self._object(data[at : at + size], kind)
            at += size
        self._rest = data[at:]

    def _object(self, data: bytes, kind: int) -> None:
        if kind in _OTHER_FRAMES:
            self._into.foreign += 1
            return
        read = _FRAMES.get(kind)
        if read is None:
            return
        header_size = int.from_bytes(data[4:6], "little")
        if header_size < _OBJECT.size + _OBJECT_TIME.size:
            self.damaged += 1
            return
        try:
            channel, can_id, octets = read(data, header_size)
        except struct.error:
            self.damaged += 1
            return
        unit, _, _, time = _OBJECT_TIME.unpack_from(data, _OBJECT.size)
        t_ns = self._start_ns + time * (10_000 if unit == _IN_TEN_MICROSECONDS else 1)
        if can_id & _EXTENDED or octets is None:
            self._into.foreign += 1
        elif can_id > 0x7FF or t_ns > LATEST_NS:
            self.damaged += 1
        else:
            self._into.add(t_ns, can_id, octets[:8], str(channel - 1))


_Frame = tuple[int, int, bytes | None]
"""Channel from 1, identifier with its flags, data; ``None`` for the data of a remote or CAN FD frame."""


def _classic(data: bytes, at: int) -> _Frame:
    channel, flags, length, can_id, octets = _CLASSIC.unpack_from(data, at)
    return channel, can_id, None if flags & _REMOTE else octets[: min(length, 8)]


def _fd(data: bytes, at: int) -> _Frame:
    channel, flags, _, can_id, _, _, fd_flags, valid = _FD.unpack_from(data, at)
    begin = at + _FD.size
    return channel, can_id, None if flags & _REMOTE or fd_flags & _EDL else data[begin : begin + valid]


def _fd_64(data: bytes, at: int) -> _Frame:
    channel, _, valid, _, can_id, _, flags, *_, extra, _ = _FD_64.unpack_from(data, at)
    begin = at + _FD_64.size
    # Zeros at the end may be absent, and further data may follow from ``extra`` on.
    octets = data[begin : min(begin + valid, extra or len(data))].ljust(valid, b"\0")
    return channel, can_id, None if flags & (_EDL_64 | _REMOTE_64) else octets


_FRAMES: Mapping[int, Callable[[bytes, int], _Frame]] = {1: _classic, 86: _classic, 100: _fd, 101: _fd_64}
"""Readers of frames by type of the object."""


def _system_time_ns(parts: tuple[int, ...]) -> int:
    """Return a SYSTEMTIME (year, month, day of the week, day, hour, minute, second, ms) in ns; 0 if it is none."""
    year, month, _, day, hour, minute, second, milliseconds = parts
    try:
        seconds = int(datetime(year, month, day, hour, minute, second, tzinfo=UTC).timestamp())
    except ValueError:
        return 0
    return max(0, seconds) * 1_000_000_000 + min(milliseconds, 999) * 1_000_000
