"""Folders of several files as one input: names and contents in a JSON document."""

import base64
import json
import random
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz.mutate import (
    Mutator,
    either,
    forge_database,
    forge_parquet,
    forge_recording,
    spoil_bytes,
    spoil_json,
    spoil_text,
)

OF_SUFFIX: dict[str, Mutator] = {
    ".mcap": either(spoil_bytes, forge_recording),
    ".db3": either(spoil_bytes, forge_database),
    ".parquet": either(spoil_bytes, forge_parquet, forge_parquet),
    ".json": either(spoil_text, spoil_json),
    ".yaml": spoil_text,
}
"""Ways to spoil files by their suffix; others are spoiled byte by byte."""


def folder_of(path: Path) -> bytes:
    """Return the files of a folder as one input."""
    return _packed({str(f.relative_to(path)): f.read_bytes() for f in sorted(path.rglob("*")) if f.is_file()})


def as_folder(data: bytes, path: Path) -> None:
    """Write the files of an input into a folder.

    ``data``: the input, of `folder_of` or `spoil_one_file`; ``path``: the folder, which is made.
    """
    for name, content in _files(data).items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)


def spoil_one_file(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Spoil one file of a folder; rarely, one is taken away."""
    files = _files(rng.choice(seeds))
    name = rng.choice(sorted(files))
    if rng.random() < 0.05:
        del files[name]
    else:
        files[name] = OF_SUFFIX.get(Path(name).suffix, spoil_bytes)(rng, [files[name]])
    return _packed(files)


def _files(data: bytes) -> dict[str, bytes]:
    return {name: base64.b64decode(content) for name, content in json.loads(data).items()}


def _packed(files: dict[str, bytes]) -> bytes:
    return json.dumps({name: base64.b64encode(content).decode() for name, content in files.items()}).encode()
