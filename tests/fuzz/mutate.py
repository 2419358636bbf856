"""Ways to spoil an input: bytes of any kind, lines of text, the records of an MCAP file, trees of configuration."""

import copy
import io
import json
import random
import re
import sqlite3
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import yaml
import zstandard
from mcap.opcode import Opcode

from armident.daq.recording import mcap_records as mcap
from armident.daq.streaming.codec import VERSION

MOST_BYTES = 64 << 20
"""Largest uncompressed chunk that is spoiled, bytes."""

Mutator = Callable[[random.Random, Sequence[bytes]], bytes]
"""Makes an input of some that are known."""

EDGES = (0, 1, 2, 7, 8, 127, 128, 255, 256, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63, 2**64 - 1)
WORDS = (
    "0", "-1", "1", "1e308", "-1e308", "1e-320", "nan", ".nan", ".inf", "-.inf", "null", "~", "true", "no", "''", "[]",
    "{}", "9" * 20, "9" * 5000, "1e9", "1000000000", "0x7fffffff", "010", "1:30", "2024-13-45", "2024-01-01", "joint_1",
    "*a", "&a x", "!!python/name:os.system", "!!binary x", "\u00e9", "x" * 300, "<<", "[" * 16, "- ", "? ", "0.1.2",
    "1_000",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1e308, float("nan"), float("inf"), "", "x", [], {}, [[]], {"a": 1}, "1",
)  # fmt: skip
_CELLS: tuple[Any, ...] = (
    None, 0.0, -1.0, 1e308, float("nan"), float("inf"), -1e-320, 1e9, True, "x", b"x", [], [1.0], {"a": 1},
)  # fmt: skip
"""Values of cells of a table; those up to the eighth are numbers or none."""
_BLF_CONTAINER = 32
"""Size of the two heads of a container in a BLF log, bytes."""
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e-?\d+)?")
_TOKEN = re.compile(rb"[A-Za-z0-9_.+-]+")


def spoil_bytes(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Flips, cuts, doubles, exchanges and splices bytes, and writes numbers that are edges of something."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(len(data) + 1)
        match rng.randrange(8):
            case 0 if data:
                data[at % len(data)] ^= 1 << rng.randrange(8)
            case 1 if data:
                data[at % len(data)] = rng.randrange(256)
            case 2:
                del data[at : at + _span(rng)]
            case 3:
                data[at:at] = data[at : at + _span(rng)]
            case 4:
                width = rng.choice((1, 2, 4, 8))
                number = rng.choice(EDGES) + rng.randrange(-2, 3)
                data[at : at + width] = (number % 2 ** (8 * width)).to_bytes(width, "little")
            case 5:
                other = rng.choice(seeds)
                data[at:] = other[rng.randrange(len(other) + 1) :]
            case 6:
                other = rng.choice(seeds)
                begin = rng.randrange(len(other) + 1)
                data[at:at] = other[begin : begin + _span(rng)]
            case _:
                del data[at:]
    return bytes(data)


def spoil_text(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Puts words in the place of others, and doubles, deletes, exchanges and indents lines."""
    data = rng.choice(seeds)
    for _ in range(rng.choice((1, 1, 2, 4))):
        lines = data.split(b"\n")
        k = rng.randrange(len(lines))
        match rng.randrange(8):
            case 0:
                del lines[k]
            case 1:
                lines.insert(k, rng.choice(lines))
            case 2:
                other = rng.randrange(len(lines))
                lines[k], lines[other] = lines[other], lines[k]
            case 3:
                lines[k] = b" " * rng.randrange(4) + lines[k]
            case 4 | 5:
                lines[k] = _exchanged(rng, lines[k], _NUMBER)
            case 6:
                lines[k] = _exchanged(rng, lines[k], _TOKEN)
            case _:
                return spoil_bytes(rng, [data, *seeds])
        data = b"\n".join(lines)
    return data


def spoil_tree(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Changes what a YAML or JSON document says, in a document that is well-formed."""
    try:
        tree = copy.deepcopy(yaml.safe_load(rng.choice(seeds)))
    except (yaml.YAMLError, ValueError):
        return spoil_text(rng, seeds)
    for _ in range(rng.choice((1, 1, 2, 3))):
        _spoil_node(rng, tree)
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True).encode(errors="surrogateescape")


def spoil_json(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Changes what a JSON document says, in a document that is well-formed."""
    try:
        tree = json.loads(rng.choice(seeds))
        for _ in range(rng.choice((1, 1, 2, 3))):
            _spoil_node(rng, tree)
        return json.dumps(tree).encode()
    except ValueError:
        return spoil_text(rng, seeds)


def forge_recording(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Spoils what is inside the records of an MCAP file, and makes lengths and checksums right again."""
    data = memoryview(rng.choice(seeds))
    records = [(opcode, bytes(body)) for opcode, _, body in mcap.records(data, len(mcap.MAGIC))]
    for _ in range(rng.choice((1, 1, 2))):
        if not records:
            return spoil_bytes(rng, seeds)
        k = rng.randrange(len(records))
        opcode, body = records[k]
        match rng.randrange(6):
            case 0:
                records.insert(k, rng.choice(records))
            case 1:
                del records[k]
            case 2:
                records[k] = rng.randrange(256), body
            case _ if opcode == Opcode.CHUNK:
                records[k] = opcode, _forged_chunk(rng, body)
            case _ if opcode in (Opcode.METADATA, Opcode.CHANNEL) and b"{" in body and rng.random() < 0.7:
                records[k] = opcode, _forged_json(rng, body)
            case _:
                records[k] = opcode, spoil_bytes(rng, [body])
    return mcap.MAGIC + b"".join(mcap.record(opcode, body) for opcode, body in records) + mcap.MAGIC


def forge_block(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Spoils the head or the body of a block of samples, and makes its checksum right again."""
    data = rng.choice(seeds)
    size = struct.unpack_from("<I", data, 6)[0]
    head, body = data[14 : 14 + size], data[14 + size :]
    if rng.random() < 0.6:
        head = spoil_json(rng, [head])
    elif rng.random() < 0.5:
        head = spoil_text(rng, [head])
    else:
        body = spoil_bytes(rng, [body])
    return struct.pack("<4sHII", b"ARMB", VERSION, len(head), zlib.crc32(head + body)) + head + body


def forge_zip(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Spoils one file of a ZIP archive, such as NPZ, and makes its checksums right again."""
    try:
        with zipfile.ZipFile(io.BytesIO(rng.choice(seeds))) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
    except (zipfile.BadZipFile, zlib.error, ValueError, OSError):
        return spoil_bytes(rng, seeds)
    if not files:
        return spoil_bytes(rng, seeds)
    name = rng.choice(sorted(files))
    files[name] = spoil_bytes(rng, [files[name], *files.values()])
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return made.getvalue()


def forge_blf(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Spoils what is inside the first container of a BLF log, and packs it again."""
    data = rng.choice(seeds)
    begin = data.find(b"LOBJ")
    size = int.from_bytes(data[begin + 8 : begin + 12], "little")
    if begin < 0 or size < _BLF_CONTAINER:
        return spoil_bytes(rng, seeds)
    try:
        content = zlib.decompress(data[begin + _BLF_CONTAINER : begin + size])
    except zlib.error:
        return spoil_bytes(rng, seeds)
    content = spoil_bytes(rng, [content])
    packed = zlib.compress(content)
    head = bytearray(data[begin : begin + _BLF_CONTAINER])
    struct.pack_into("<L", head, 8, _BLF_CONTAINER + len(packed))
    struct.pack_into("<L", head, 24, len(content))
    return data[:begin] + bytes(head) + packed + bytes(size % 4) + data[begin + size + size % 4 :]


def forge_database(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Spoils values of rows in a SQLite database."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "a.db3")
        path.write_bytes(rng.choice(seeds))
        with suppress(sqlite3.Error, OverflowError), closing(sqlite3.connect(path)) as database, database:
            tables = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            for _ in range(rng.choice((1, 1, 2, 5))):
                table = rng.choice(tables)
                columns = [row[1] for row in database.execute(f"PRAGMA table_info({table})")]
                column, rows = rng.choice(columns), database.execute(f"SELECT rowid FROM {table}").fetchall()
                (row,) = rng.choice(rows)
                (value,) = database.execute(f"SELECT {column} FROM {table} WHERE rowid = ?", (row,)).fetchone()
                if isinstance(value, bytes) and rng.random() < 0.8:
                    value = spoil_bytes(rng, [value])
                else:
                    value = rng.choice((None, -1, 0, 2**62, -(2**63), 1.5, "x", b"\xff", "cdr", value))
                database.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (value, row))
        return path.read_bytes()


def forge_parquet(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Changes values, types and names of columns of a Parquet file."""
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.read_table(io.BytesIO(rng.choice(seeds)))
    except (pyarrow.ArrowException, OSError, ValueError):
        return spoil_bytes(rng, seeds)
    columns = {name: table.column(name).to_pylist() for name in table.column_names}
    for _ in range(rng.choice((1, 1, 2, 4))):
        name = rng.choice(sorted(columns))
        match rng.randrange(6):
            case 0 if len(columns) > 1:
                del columns[name]
            case 1:
                columns[rng.choice((*WORDS, *columns))] = columns.pop(name)
            case 2:
                columns[name] = [rng.choice(_CELLS)] * len(columns[name])
            case _:
                _spoil_cell(rng, columns[name])
    made = io.BytesIO()
    try:
        pyarrow.parquet.write_table(pyarrow.table(columns), made)
    except (pyarrow.ArrowException, ValueError, OverflowError, TypeError):
        return spoil_bytes(rng, seeds)
    return made.getvalue()


def either(*mutators: Mutator) -> Mutator:
    """One of several ways, by chance."""
    return lambda rng, seeds: rng.choice(mutators)(rng, seeds)


def _forged_chunk(rng: random.Random, body: bytes) -> bytes:
    try:
        chunk = mcap.read_chunk(memoryview(body))
        size = min(max(chunk.size, 1), MOST_BYTES)
        raw = zstandard.ZstdDecompressor().decompress(bytes(chunk.data), max_output_size=size)
    except (mcap.MalformedRecord, zstandard.ZstdError):
        # A known input that is spoiled inside its chunk already.
        return spoil_bytes(rng, [body])
    raw = spoil_bytes(rng, [raw])
    forged = mcap.chunk(chunk.start_ns, chunk.end_ns, raw, zstandard.ZstdCompressor().compress(raw))
    content = bytearray(forged[mcap.RECORD_HEAD.size :])
    if rng.random() < 0.2:
        struct.pack_into("<Q", content, 16, rng.choice(EDGES))
    return bytes(content)


def _forged_json(rng: random.Random, body: bytes) -> bytes:
    """A record with a JSON text in it, the text spoiled, the lengths before it (of text and of its map) made right."""
    begin = body.index(b"{")
    end = body.rfind(b"}") + 1
    try:
        text = spoil_json(rng, [body[begin:end]])
    except ValueError:
        return spoil_bytes(rng, [body])
    grown = len(text) - (end - begin)
    out = bytearray(body[:begin] + text + body[end:])
    (length,) = struct.unpack_from("<I", out, begin - 4)
    struct.pack_into("<I", out, begin - 4, length + grown)
    # The map begins with its length, then the length of the key, then the key.
    for at in range(begin - 9, -1, -1):
        if struct.unpack_from("<I", out, at)[0] == len(body) - at - 4:
            struct.pack_into("<I", out, at, len(body) - at - 4 + grown)
            break
    return bytes(out)


def _spoil_node(rng: random.Random, tree: Any) -> None:
    """Change one place of a tree of dictionaries and lists."""
    places: list[tuple[Any, Any]] = []
    todo = [tree]
    while todo:
        node = todo.pop()
        if isinstance(node, dict | list):
            keys = list(node) if isinstance(node, dict) else range(len(node))
            places += [(node, key) for key in keys]
            todo += [node[key] for key in keys]
    if not places:
        return
    node, key = rng.choice(places)
    other, other_key = rng.choice(places)
    match rng.randrange(7):
        case 0:
            del node[key]
        case 1:
            node[key] = copy.deepcopy(other[other_key])
        case 2 if isinstance(node, dict):
            node[rng.choice(WORDS)] = node.pop(key)
        case 3 if isinstance(node[key], int | float):
            number = node[key] if abs(node[key]) < 10**300 else 1
            node[key] = rng.choice((-number, 0, number * 1e9, number * 1e-9, 10**400, *EDGES))
        case 4 if isinstance(node, list):
            node.insert(key, copy.deepcopy(node[key]))
        case _:
            node[key] = copy.deepcopy(rng.choice((*VALUES, *EDGES, rng.choice(WORDS))))


def _spoil_cell(rng: random.Random, column: list[Any]) -> None:
    """Change a value of a column, or one of the values that a cell is made of."""
    if not column:
        return
    k = rng.randrange(len(column))
    if isinstance(column[k], list) and column[k] and rng.random() < 0.8:
        column[k] = [*column[k]]
        if rng.random() < 0.3:
            del column[k][rng.randrange(len(column[k]))]
        else:
            column[k][rng.randrange(len(column[k]))] = rng.choice(_CELLS[:8])
    else:
        column[k] = rng.choice(_CELLS[:8])


def _exchanged(rng: random.Random, line: bytes, pattern: re.Pattern[bytes]) -> bytes:
    found = list(pattern.finditer(line))
    if not found:
        return line
    match = rng.choice(found)
    word = rng.choice((rng.choice(WORDS).encode(), str(rng.choice(EDGES)).encode(), match[0] + match[0]))
    return line[: match.start()] + word + line[match.end() :]


def _span(rng: random.Random) -> int:
    return rng.choice((1, 2, 4, 9, 16, 100, 1000, rng.randrange(1, 20_000)))
