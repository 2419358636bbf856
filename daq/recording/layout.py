"""How one sample of a stream is laid out as a protobuf message inside an MCAP message record.

All fields are of fixed width and always present, so every message of a stream has the same length and the same
tag bytes: a whole batch is written and read as one numpy array. ``protoc``'s own decoders read the same bytes.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import numpy as np
from google.protobuf import descriptor_pb2
from mcap.opcode import Opcode
from numpy.typing import NDArray

from armident.configs import DataError
from armident.daq.recording.mcap_records import RECORD_HEAD
from armident.daq.recording.model import Field, Quantity, Side, Stream

_PROTO = descriptor_pb2.FieldDescriptorProto
_WIRE = {
    # raw dtype: (bytes on the wire, protobuf type, wire type)
    "int8": ("<i4", _PROTO.TYPE_SFIXED32, 5),
    "int16": ("<i4", _PROTO.TYPE_SFIXED32, 5),
    "int32": ("<i4", _PROTO.TYPE_SFIXED32, 5),
    "int64": ("<i8", _PROTO.TYPE_SFIXED64, 1),
    "uint8": ("<u4", _PROTO.TYPE_FIXED32, 5),
    "uint16": ("<u4", _PROTO.TYPE_FIXED32, 5),
    "uint32": ("<u4", _PROTO.TYPE_FIXED32, 5),
    "uint64": ("<u8", _PROTO.TYPE_FIXED64, 1),
    "float32": ("<f4", _PROTO.TYPE_FLOAT, 5),
    "float64": ("<f8", _PROTO.TYPE_DOUBLE, 1),
}
_FIRST_JOINT = 3


@dataclass(frozen=True)
class StreamLayout:
    """The layout of one stream: its joints, its fields and the dtypes of their raw values."""

    name: str
    every: int
    joints: tuple[str, ...]
    fields: tuple[Field, ...]
    dtypes: tuple[str, ...]

    def __post_init__(self) -> None:
        for field, dtype in zip(self.fields, self.dtypes, strict=True):
            if dtype not in _WIRE:
                raise DataError(f"stream {self.name}: {field.name} has dtype {dtype:.60}, which recordings do not hold")
            if len(field.scale) != len(self.joints):
                raise DataError(f"stream {self.name}: {field.name} needs {len(self.joints)} scale factors")

    @classmethod
    def of(cls, stream: Stream, joints: Sequence[str]) -> "StreamLayout":
        """The layout of a stream that is in memory."""
        fields = tuple(stream.fields.values())
        return cls(
            stream.name, stream.every, tuple(joints), fields, tuple(stream.raw[f.name].dtype.name for f in fields)
        )

    @property
    def topic(self) -> str:
        """The MCAP topic."""
        return f"/{self.name}"

    @property
    def message_name(self) -> str:
        """Full name of the protobuf message."""
        return f"armident.{self.name.title().replace('_', '')}"

    def to_json(self) -> str:
        """The layout as text: channel metadata, and the head of what is published."""
        return json.dumps(
            {
                "name": self.name,
                "every": self.every,
                "joints": self.joints,
                "fields": [
                    {
                        "name": f.name,
                        "quantity": f.quantity,
                        "unit": f.unit,
                        "side": f.side,
                        "scale": f.scale,
                        "dtype": dtype,
                    }
                    for f, dtype in zip(self.fields, self.dtypes, strict=True)
                ],
            }
        )

    @classmethod
    def from_json(cls, text: str) -> "StreamLayout":
        """The layout from its text.

        Raises
        ------
        DataError
            If the text is not a layout.
        """
        try:
            data = json.loads(text)
            fields = tuple(
                Field(_text(f["name"]), f["quantity"], _text(f["unit"]), f["side"], tuple(map(_finite, f["scale"])))
                for f in data["fields"]
            )
            dtypes = tuple(_text(f["dtype"]) for f in data["fields"])
            layout = cls(_text(data["name"]), data["every"], tuple(map(_text, data["joints"])), fields, dtypes)
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            raise DataError(f"a stream layout that cannot be understood: {_short(error)}") from error
        for what, values, known in (
            ("quantity", [f.quantity for f in fields], get_args(Quantity)),
            ("side", [f.side for f in fields], get_args(Side)),
        ):
            for value in values:
                if value not in known:
                    raise DataError(f"a stream layout with {what} {value!r:.60}; expected {', '.join(known)}")
        names = [f.name for f in fields]
        if len(set(names)) < len(names) or len(set(layout.joints)) < len(layout.joints):
            raise DataError("a stream layout that names a field or a joint twice")
        if type(layout.every) is not int or layout.every < 1 or not fields or not layout.joints:
            raise DataError("a stream layout without fields or joints, or that never comes")
        return layout

    @cached_property
    def descriptor(self) -> bytes:
        """The protobuf FileDescriptorSet of the message."""
        file = descriptor_pb2.FileDescriptorProto(
            name=f"armident/{self.name}.proto", package="armident", syntax="proto3"
        )
        top = file.message_type.add(name=self.message_name.rpartition(".")[2])
        top.field.add(name="sync", number=1, type=_PROTO.TYPE_FIXED64, label=_PROTO.LABEL_OPTIONAL)
        top.field.add(name="t_ns", number=2, type=_PROTO.TYPE_SFIXED64, label=_PROTO.LABEL_OPTIONAL)
        nested = top.nested_type.add(name="Joint")
        for k, (field, dtype) in enumerate(zip(self.fields, self.dtypes, strict=True), start=1):
            nested.field.add(name=field.name, number=k, type=_WIRE[dtype][1], label=_PROTO.LABEL_OPTIONAL)
        for k, joint in enumerate(self.joints, start=_FIRST_JOINT):
            top.field.add(
                name=joint,
                number=k,
                type=_PROTO.TYPE_MESSAGE,
                type_name=f".{self.message_name}.Joint",
                label=_PROTO.LABEL_OPTIONAL,
            )
        return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()

    @cached_property
    def record(self) -> tuple[np.dtype[Any], bytes, NDArray[np.intp]]:
        """Dtype of a message record, its constant bytes, and the positions of those that must be as they are.

        The columns of the dtype are ``sequence, log, publish, sync, t_ns`` and one ``(n,)`` column per field.
        """
        parts: list[bytes | tuple[str, str]] = [b"", ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
        parts += [_tag(1, 1), ("sync", "<u8"), _tag(2, 1), ("t_ns", "<i8")]
        joint: list[bytes | tuple[str, str]] = []
        for k, (field, dtype) in enumerate(zip(self.fields, self.dtypes, strict=True), start=1):
            wire, _, wire_type = _WIRE[dtype]
            joint += [_tag(k, wire_type), (field.name, wire)]
        joint_size = sum(len(p) if isinstance(p, bytes) else np.dtype(p[1]).itemsize for p in joint)
        for j in range(len(self.joints)):
            parts.append(_tag(_FIRST_JOINT + j, 2) + _varint(joint_size))
            parts += [p if isinstance(p, bytes) else (f"{p[0]}/{j}", p[1]) for p in joint]
        head = RECORD_HEAD.size + 2
        size = head + sum(len(p) if isinstance(p, bytes) else np.dtype(p[1]).itemsize for p in parts)
        template = bytearray(size)
        fixed = np.zeros(size, dtype=bool)
        RECORD_HEAD.pack_into(template, 0, Opcode.MESSAGE, size - RECORD_HEAD.size)
        fixed[: RECORD_HEAD.size] = True
        names, formats, offsets = ["opcode", "length", "channel"], ["u1", "<u8", "<u2"], [0, 1, RECORD_HEAD.size]
        at = head
        for part in parts:
            if isinstance(part, bytes):
                template[at : at + len(part)] = part
                fixed[at : at + len(part)] = True
                at += len(part)
            else:
                names.append(part[0])
                formats.append(part[1])
                offsets.append(at)
                at += np.dtype(part[1]).itemsize
        dtype_ = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})
        return dtype_, bytes(template), np.flatnonzero(fixed)

    def pack(
        self, channel_id: int, sync: NDArray[np.int64], t_ns: NDArray[np.int64], raw: Mapping[str, NDArray[Any]]
    ) -> NDArray[Any]:
        """Message records of a batch: ``sync`` and ``t_ns`` (N,), every ``raw`` (N, n)."""
        dtype, template, _ = self.record
        rows = np.frombuffer(bytearray(template * len(sync)), dtype=dtype)
        rows["channel"] = channel_id
        rows["sequence"] = sync & 0xFFFFFFFF
        rows["log"] = rows["publish"] = t_ns
        rows["sync"] = sync
        rows["t_ns"] = t_ns
        for field in self.fields:
            values = raw[field.name]
            for j in range(len(self.joints)):
                rows[f"{field.name}/{j}"] = values[:, j]
        return rows

    def unpack(
        self,
        rows: NDArray[Any],
        sync: NDArray[np.int64],
        t_ns: NDArray[np.int64],
        raw: Mapping[str, NDArray[Any]],
    ) -> None:
        """Put what message records hold into arrays: ``sync`` and ``t_ns`` (N,), every ``raw`` (N, n).

        Raises
        ------
        DataError
            If a record is not laid out as the stream's channel says.
        """
        octets = np.frombuffer(rows, dtype=np.uint8)
        template, mask = self._pattern(len(rows))
        whole = octets.size // 8 * 8
        # Eight bytes at a time, all of them in order: what is fixed is scattered over every record.
        differing = octets[:whole].view(np.uint64) ^ template[:whole].view(np.uint64)
        differing &= mask[:whole].view(np.uint64)
        if differing.any() or ((octets[whole:] ^ template[whole:]) & mask[whole:]).any():
            raise DataError(f"messages of topic {self.topic} are not laid out as their channel says")
        for field in self.fields:
            values = raw[field.name]
            for j in range(len(self.joints)):
                values[:, j] = rows[f"{field.name}/{j}"]
        sync[:] = rows["sync"]
        t_ns[:] = rows["t_ns"]

    def _pattern(self, count: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The fixed bytes of ``count`` records, and a mask that is FFh where bytes are fixed."""
        dtype, template, fixed = self.record
        size = count * dtype.itemsize
        if not self._patterns or self._patterns[-1][0].size < size:
            mask = np.zeros(len(template), np.uint8)
            mask[fixed] = 0xFF
            self._patterns[:] = [(np.tile(np.frombuffer(template, np.uint8), count), np.tile(mask, count))]
        wanted, mask = self._patterns[-1]
        return wanted[:size], mask[:size]

    @cached_property
    def _patterns(self) -> list[tuple[NDArray[np.uint8], NDArray[np.uint8]]]:
        """The longest pattern made so far."""
        return []

    def last_sync(self, data: bytes, at: int, count: int) -> int:
        """SYNC number of the last of ``count`` records in ``data`` from ``at`` on."""
        dtype = self.record[0]
        return int(np.frombuffer(data, dtype, count=1, offset=at + (count - 1) * dtype.itemsize)["sync"][0])

    def run_length(self, data: bytes, at: int, channel_id: int) -> int:
        """How many records of this stream follow each other in ``data`` from ``at`` on."""
        dtype, template, _ = self.record
        limit = (len(data) - at) // dtype.itemsize
        opcode, length = RECORD_HEAD.unpack_from(template)
        count, step = 0, 256
        while count < limit:
            step = min(2 * step, limit - count)
            rows = np.frombuffer(data, dtype, count=step, offset=at + count * dtype.itemsize)
            right = (rows["length"] == length) & (rows["channel"] == channel_id) & (rows["opcode"] == opcode)
            if not right.all():
                return count + int(np.argmin(right))
            count += step
        return count


def _text(value: object) -> str:
    """A text that is one, and can be written."""
    if not isinstance(value, str):
        raise TypeError(f"expected a text, found {value!r:.60}")
    value.encode()
    return value


def _finite(value: object) -> float:
    """A number that is one."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError(f"expected a number, found {value!r:.60}")
    return float(value)


def _short(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:120]}".replace("\n", " ")


def _varint(value: int) -> bytes:
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _tag(number: int, wire_type: int) -> bytes:
    return _varint(number << 3 | wire_type)
