"""Bags of ROS 2 for tests, message by message: MCAP with the ROS 2 writer, SQLite with the tables of rosbag2."""

import sqlite3
import struct
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from armident.configs import load_robot
from armident.daq.interchange.joint_messages import DEFINITION, MESSAGE_TYPE

TX40 = load_robot("tx40.yaml")
NAMES = [joint.name for joint in TX40.joints]
TOPIC = "/joint_states"
T0 = 1_700_000_000_000_000_000
STEP_NS = 2_000_000
ROWS = 120


def motion(rows: int = ROWS, joints: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Positions and torques that differ in every row and joint, within the limits of the TX40."""
    rng = np.random.default_rng(6)
    q = rng.uniform(-1, 1, joints) + rng.uniform(-1e-3, 1e-3, (rows, joints))
    return q, rng.uniform(-3, 3, (rows, joints))


Q, TAU = motion()


@dataclass(frozen=True)
class State:
    """A message of joint states; the recorder gets it a little after its stamp."""

    at: int
    names: Sequence[str] = tuple(NAMES)
    q: Sequence[float] | np.ndarray = ()
    tau: Sequence[float] | np.ndarray = ()
    topic: str = TOPIC
    delay: int = 1000
    stamped: bool = True


def states(names: Sequence[str] = NAMES, columns: Sequence[int] = range(6), **more: Any) -> list[State]:
    """One message for each row of the motion, with these columns under these names."""
    columns = list(columns)
    return [State(T0 + k * STEP_NS, names, Q[k, columns], TAU[k, columns], **more) for k in range(ROWS)]


def mcap_bag(
    path: Path,
    messages: Sequence[State],
    *,
    chunk_size: int = 4096,
    compression: CompressionType = CompressionType.ZSTD,
    pack: Callable[[bytes], bytes] = lambda data: data,
    message_type: str = MESSAGE_TYPE,
    ros_1: bool = False,
) -> Path:
    """Write messages to an MCAP file in the order of recording. ``ros_1``: as `mcap convert` does of a bag of ROS 1."""
    name, encoded = ("ros1", of_ros_1) if ros_1 else ("cdr", cdr)
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=chunk_size, compression=compression)
        writer.start(profile="ros1" if ros_1 else "ros2", library="test")
        type_name, kind = (message_type.replace("/msg/", "/"), "ros1msg") if ros_1 else (message_type, "ros2msg")
        schema = writer.register_schema(type_name, kind, DEFINITION.encode())
        channels = {
            topic: writer.register_channel(topic, name, schema) for topic in dict.fromkeys(m.topic for m in messages)
        }
        for message in sorted(messages, key=lambda m: m.at + m.delay):
            at = message.at + message.delay
            writer.add_message(channels[message.topic], at, pack(encoded(message)), at)
        writer.finish()
    return path


def sqlite_bag(path: Path, messages: Sequence[State], *, pack: Callable[[bytes], bytes] = lambda data: data) -> Path:
    """Write messages to the tables of rosbag2 in SQLite."""
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute(
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
        )
        database.execute("INSERT INTO topics VALUES (1, '/rosout', 'rcl_interfaces/msg/Log', 'cdr')")
        topics = {topic: k for k, topic in enumerate(dict.fromkeys(m.topic for m in messages), start=2)}
        for topic, number in topics.items():
            database.execute("INSERT INTO topics VALUES (?, ?, ?, 'cdr')", (number, topic, MESSAGE_TYPE))
        for message in messages:
            row = (topics[message.topic], message.at + message.delay, pack(cdr(message)))
            database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    return path


def metadata(folder: Path, files: Sequence[str], count: int) -> None:
    """Write the metadata of a bag folder."""
    listed = "".join(f"    - {name}\n" for name in files)
    (folder / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n{listed}"
        f"  topics_with_message_count:\n    - topic_metadata: {{name: {TOPIC}, type: {MESSAGE_TYPE}}}\n"
        f"      message_count: {count}\n",
        encoding="utf-8",
    )


def zstd(data: bytes) -> bytes:
    """Compress a message or file."""
    return zstandard.ZstdCompressor().compress(data)


def cdr(message: State) -> bytes:
    """Return the content of a message in little-endian CDR (OMG DDSI-RTPS, representation 00 01)."""
    stamp = message.at if message.stamped else 0
    body = struct.pack("<iI", stamp // 10**9, stamp % 10**9) + _string("base")
    body = _aligned(body, 4) + struct.pack("<I", len(message.names))
    for name in message.names:
        body = _aligned(body, 4) + _string(name)
    for values in (message.q, (), message.tau):
        body = _aligned(body, 4) + struct.pack("<I", len(values))
        if len(values):
            body = _aligned(body, 8) + np.asarray(values, dtype="<f8").tobytes()
    return b"\x00\x01\x00\x00" + body


def of_ros_1(message: State) -> bytes:
    """Return the content of a message as ROS 1 serializes it: a number first, no alignment."""
    stamp = message.at if message.stamped else 0
    body = struct.pack("<3I", 7, stamp // 10**9, stamp % 10**9)
    for text in ("base", None, *message.names):
        body += (
            struct.pack("<I", len(message.names))
            if text is None
            else struct.pack("<I", len(text.encode())) + text.encode()
        )
    for values in (message.q, (), message.tau):
        body += struct.pack("<I", len(values)) + np.asarray(values, dtype="<f8").tobytes()
    return body


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def _aligned(body: bytes, size: int) -> bytes:
    return body + bytes(-len(body) % size)
