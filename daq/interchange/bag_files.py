"""Messages in the files of rosbag2: MCAP, SQLite (.db3), either compressed, and folders, without damaged parts."""

import mmap
import re
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import yaml
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import breakup_chunk

from armident.configs import ConfigError, DataError
from armident.daq.interchange.joint_messages import CDR, ROS1
from armident.daq.interchange.readers import RosBag
from armident.daq.interchange.text_files import listed as listed_names
from armident.daq.interchange.text_files import shortened
from armident.daq.recording.mcap_records import MAGIC, RECORD_HEAD, records

METADATA = "metadata.yaml"
"""File of a bag folder that lists the other files."""
ROS_1 = ".bag"
"""Suffix of the bags of ROS 1, which are refused with the command that converts them."""
SUFFIXES = tuple(suffix for suffix in RosBag.suffixes if suffix != ROS_1)
"""Suffixes of the files of a bag."""

_NUMBER_AT_END = re.compile(r"[-_.]?\d+$")
"""Number that rosbag2 adds to the name of a bag for each of its files."""
_LARGEST = 1 << 30
"""Largest uncompressed chunk or message that is read, bytes."""
_ZSTD = ".zstd"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SIDECARS = ("-wal", "-journal")
"""Suffixes of the files in which SQLite keeps what is not in the database yet."""
_DAMAGED = (sqlite3.Error, UnicodeDecodeError)
"""Errors of SQLite for damaged databases, whose names may be no text."""


class BagMessage(NamedTuple):
    """Message of a bag, recorded at ``logged_ns``, ns UTC; ``data`` is its content in CDR or ``ros1``, uncompressed."""

    topic: str
    logged_ns: int
    data: bytes
    encoding: str = CDR


def bag_files(path: Path) -> tuple[list[Path], list[str]]:
    """Return the files of a bag in the order of recording, and the names of those that its metadata lists in vain.

    ``path``: a file, or a folder with ``metadata.yaml``; without it, the order is that of the files' numbers. Raises
    ConfigError for the files of several bags, or bags of ROS 1.
    """
    if not path.is_dir():
        if not path.is_file():
            raise ConfigError(f"{path}: no such file")
        if path.suffix.lower() == ROS_1:
            raise ConfigError(_of_ros_1(path))
        return [path], []
    present = {file.name: file for file in path.iterdir() if file.is_file()}
    listed = [Path(name).name for name in _listed_files(path)]
    found = [(name, present.get(name) or present.get(_other_name(name))) for name in listed]
    there = [file for _, file in found if file is not None]
    if not there:
        there = _unlisted(path, list(present.values()))
    return there, [shortened(name) for name, file in found if file is None and name not in {f.name for f in there}]


def _other_name(name: str) -> str:
    """Return the name of a file after compression with zstd, or of a compressed one after decompression."""
    return name[: -len(_ZSTD)] if name.endswith(_ZSTD) else name + _ZSTD


def _unlisted(folder: Path, present: list[Path]) -> list[Path]:
    """Return the files of the only bag in a folder without usable metadata, in the order of their numbers."""
    found = [file for file in present if file.name.lower().endswith(SUFFIXES)]
    if not found:
        for file in present:
            if file.suffix.lower() == ROS_1:
                raise ConfigError(_of_ros_1(file))
        inner = sorted(each.parent.name for suffix in SUFFIXES for each in folder.glob(f"*/*{suffix}"))
        hint = f"; bags are in {listed_names(list(dict.fromkeys(inner)))}: give one of them" if inner else ""
        raise ConfigError(f"{folder}: no bag in this folder; expected {METADATA} or files {', '.join(SUFFIXES)}{hint}")
    bags = sorted({_NUMBER_AT_END.sub("", file.name.split(".")[0]) for file in found})
    if len(bags) > 1:
        raise ConfigError(
            f"{folder}: files of several bags without {METADATA}: {listed_names(sorted(f.name for f in found))}; "
            "give one file"
        )
    return sorted(found, key=lambda file: (len(file.name.removesuffix(_ZSTD)), file.name))


def _of_ros_1(file: Path) -> str:
    return f"{file}: a bag of ROS 1; `rosbags-convert --src {file.name} --dst {file.stem}` makes one of ROS 2"


class BagReader:
    """Iterates over the messages of one type, such as ``sensor_msgs/msg/JointState``, in the order of a bag's files.

    ``topics``: type by topic so far; ``losses``: descriptions of what is missing or damaged, after the iteration. It
    raises ConfigError if a file cannot be read, DataError if none is a bag file.
    """

    def __init__(self, path: Path, message_type: str) -> None:
        self.topics: dict[str, str] = {}
        self.losses: list[str] = []
        self._type = message_type
        self._path = path
        self._expected: Counter[str] = Counter()
        self._read: Counter[str] = Counter()

    def __iter__(self) -> Iterator[BagMessage]:
        """Yield the messages of the type, of every topic."""
        files, absent = bag_files(self._path)
        self.losses += [f"{name}, which {METADATA} lists, is missing" for name in absent]
        unusable: list[DataError] = []
        for file in files:
            try:
                for message in self._file(file, file.name if len(files) > 1 else ""):
                    self._read[message.topic] += 1
                    yield message
            except OSError as error:
                raise ConfigError(f"{file}: cannot be read: {error.strerror or 'damaged'}") from error
            except DataError as error:
                unusable.append(error)
                self.losses.append(f"{shortened(file.name)} is left out: {str(error).removeprefix(f'{file}: ')}")
        if len(unusable) == len(files):
            raise unusable[0]
        self._expected |= _listed_counts(self._path)
        for topic, expected in sorted(self._expected.items()):
            read = self._read[topic]
            if self.topics.get(topic, self._type) == self._type and read < expected:
                self.losses.append(f"{expected - read} of {expected} messages of {shortened(topic)} are missing")

    def _file(self, file: Path, name: str) -> Iterator[BagMessage]:
        if file.stat().st_size == 0:
            raise DataError(f"{file}: empty, not a bag")
        where, opened = f"{name}: " if name else "", file
        with tempfile.TemporaryDirectory() as folder:
            if file.suffix.lower() == _ZSTD:
                opened = Path(folder, file.stem)
                self._decompress(file, opened, where)
            try:
                if opened.suffix.lower() == ".db3":
                    yield from self._database(_without_sidecars(opened, Path(folder)), where)
                else:
                    yield from self._mcap(opened, where)
            except DataError as error:
                raise DataError(f"{file}: {error}") from error

    def _decompress(self, file: Path, inner: Path, where: str) -> None:
        """Write the content of a compressed file, up to the first damaged block."""
        with file.open("rb") as packed, inner.open("wb") as plain:
            try:
                zstandard.ZstdDecompressor().copy_stream(packed, plain)
            except zstandard.ZstdError:
                self.losses.append(f"{where}the compressed file is damaged after {plain.tell()} bytes of its content")
            if plain.tell() == 0:
                raise DataError(f"{file}: truncated zstd file")

    def _mcap(self, file: Path, where: str) -> Iterator[BagMessage]:
        """Yield the messages of the undamaged records of an MCAP file, in file order."""
        with file.open("rb") as opened:
            data = memoryview(mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ))
        if bytes(data[: len(MAGIC)]) != MAGIC:
            raise DataError("not an MCAP file")
        channels = self._summary(file)
        schemas: dict[int, Schema] = {}
        end, finished = len(MAGIC), False
        for opcode, at, body in records(data, len(MAGIC)):
            end = at + RECORD_HEAD.size + len(body)
            if opcode == Opcode.DATA_END:
                finished = True
                break
            try:
                parts = _records(opcode, body)
            except Exception:  # the readers of MCAP, zstd and lz4 raise various errors for damaged records
                kind = "chunk" if opcode == Opcode.CHUNK else "record"
                self.losses.append(f"{where}the {kind} at byte {at} is damaged")
                continue
            for part in parts:
                if isinstance(part, Schema):
                    schemas[part.id] = part
                elif isinstance(part, Channel):
                    channels[part.id] = part
                    self._add(part, schemas.get(part.schema_id))
                elif isinstance(part, Message) and part.channel_id in channels:
                    channel = channels[part.channel_id]
                    if self.topics.get(channel.topic) == self._type:
                        yield BagMessage(channel.topic, part.log_time, _plain(part.data), channel.message_encoding)
        if not finished:
            self.losses.append(
                f"{where}the file is torn: the recorder did not finish it, and its last {len(data) - end} bytes are no "
                "complete record (`mcap recover` repairs files)"
            )

    def _summary(self, file: Path) -> dict[int, Channel]:
        """Return the channels in the summary of an MCAP file, and add its number of messages; {} without one."""
        summary = None
        with (
            suppress(Exception),
            file.open("rb") as opened,
        ):  # a torn file has none, a damaged one raises various errors
            summary = make_reader(opened).get_summary()
        if summary is None:
            return {}
        for channel in summary.channels.values():
            self._add(channel, summary.schemas.get(channel.schema_id))
        if summary.statistics is not None:
            for number, count in summary.statistics.channel_message_counts.items():
                if number in summary.channels and self.topics.get(summary.channels[number].topic) == self._type:
                    self._expected[summary.channels[number].topic] += count
        return dict(summary.channels)

    def _add(self, channel: Channel, schema: Schema | None) -> None:
        encoding, name = channel.message_encoding, "" if schema is None else schema.name
        if encoding == ROS1:
            # Types of ROS 1 are named without a folder: sensor_msgs/JointState.
            name = re.sub(r"^(\w+)/(\w+)$", r"\1/msg/\2", name)
        if schema is not None:
            encoded = "" if encoding in (CDR, ROS1) else f" in {encoding or 'unknown encoding'}"
            self.topics[channel.topic] = name + encoded

    def _database(self, file: Path, where: str) -> Iterator[BagMessage]:
        """Yield the messages of a SQLite file in the order of writing, up to the first damaged page."""
        try:
            with closing(sqlite3.connect(f"file:{quote(str(file.resolve()))}?mode=ro", uri=True)) as database:
                # Without it, SQLite refuses to read a truncated database at all.
                database.execute("PRAGMA writable_schema=ON")
                database.text_factory = lambda text: text.decode(errors="replace")
                chosen = self._database_topics(database)
                marks = ", ".join("?" * len(chosen))
                query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
                for number, logged, data in database.execute(query, list(chosen)):
                    if isinstance(data, bytes) and isinstance(logged, int):
                        yield BagMessage(chosen[number], logged, _plain(data))
        except _DAMAGED:
            self.losses.append(f"{where}the database is damaged: later messages are missing")

    def _database_topics(self, database: sqlite3.Connection) -> dict[int, str]:
        """Return the topics of the type by their number in a SQLite file."""
        try:
            rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except _DAMAGED as error:
            raise DataError("not a readable bag in SQLite: damaged, or without its table of topics") from error
        chosen: dict[int, str] = {}
        for number, topic, kind, encoding in rows:
            self.topics[str(topic)] = str(kind) + ("" if encoding == CDR else f" in {encoding}")
            if kind == self._type and encoding == CDR:
                chosen[number] = str(topic)
        return chosen


def _records(opcode: int, body: memoryview) -> list[McapRecord]:
    """Return the schemas, channels and messages in a record of the data section; others give none."""
    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.SCHEMA:
        return [Schema.read(stream)]
    if opcode == Opcode.CHANNEL:
        return [Channel.read(stream)]
    if opcode == Opcode.MESSAGE:
        return [Message.read(stream, len(body))]
    if opcode != Opcode.CHUNK:
        return []
    chunk = Chunk.read(stream)
    if chunk.uncompressed_size > _LARGEST:
        raise ValueError(f"{chunk.uncompressed_size} bytes uncompressed")
    if chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) not in (-1, chunk.uncompressed_size):
        raise ValueError("two different lengths")
    return breakup_chunk(chunk, validate_crc=True)


def _plain(data: bytes) -> bytes:
    """Return a message without the compression of rosbag2 (mode ``message``); CDR never begins like zstd."""
    if not data.startswith(_ZSTD_MAGIC):
        return data
    try:
        if zstandard.frame_content_size(data) > _LARGEST:
            return data
        return zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except (zstandard.ZstdError, MemoryError):
        return data


def _without_sidecars(file: Path, folder: Path) -> Path:
    """Return a database that SQLite can open for reading: a copy in ``folder`` if a journal must be applied first."""
    sidecars = [Path(f"{file}{suffix}") for suffix in _SIDECARS]
    sidecars = [sidecar for sidecar in sidecars if sidecar.is_file() and sidecar.stat().st_size]
    if not sidecars:
        return file
    for source in (file, *sidecars):
        shutil.copyfile(source, folder / source.name)
    with suppress(sqlite3.Error), closing(sqlite3.connect(folder / file.name)) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        database.execute("SELECT count(*) FROM sqlite_master").fetchone()
    return folder / file.name


def _listed_files(folder: Path) -> list[str]:
    """Return the names of files in the metadata of a bag folder."""
    listed = _metadata(folder).get("relative_file_paths")
    return [str(name) for name in listed] if isinstance(listed, list) else []


def _listed_counts(path: Path) -> Counter[str]:
    """Return the number of messages by topic in the metadata of a bag folder."""
    counts: Counter[str] = Counter()
    listed = _metadata(path).get("topics_with_message_count") if path.is_dir() else None
    for entry in listed if isinstance(listed, list) else []:
        with suppress(KeyError, TypeError, ValueError, OverflowError):
            counts[str(entry["topic_metadata"]["name"])] += int(entry["message_count"])
    return counts


def _metadata(folder: Path) -> dict[str, object]:
    """Return the entries of ``metadata.yaml``; {} if there is none, or it is not readable."""
    try:
        content = yaml.safe_load((folder / METADATA).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError):  # a date may be none, such as 2024-13-01
        return {}
    entries = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    return entries if isinstance(entries, dict) else {}
