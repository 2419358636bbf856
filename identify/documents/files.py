"""Reading and writing of result documents, and of other files as a whole."""

import json
import os
import secrets
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from armident.configs import ConfigError, DataError
from armident.daq.recording.layout import short_reason

T = TypeVar("T", bound=BaseModel)


def to_json(document: BaseModel) -> str:
    """Return the JSON text of a document, keys in the order of the schema."""
    return document.model_dump_json(by_alias=True, indent=1) + "\n"


def from_json(text: str, kind: type[T], where: str) -> T:
    """Return the document of a JSON text; DataError names ``where``, the key and the expected value."""
    try:
        return kind.model_validate(_parsed(text, where))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "document"
        raise DataError(f"{where}: {key}: {first['msg'][0].lower() + first['msg'][1:]}") from error


def load_document(path: Path, kind: type[T]) -> T:
    """Read a document from a file; ConfigError if there is none, DataError if it is no such document."""
    return from_json(_text(path), kind, str(path))


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object of a file; ConfigError if there is none, DataError if it is no JSON object."""
    found = _parsed(_text(path), str(path))
    if not isinstance(found, dict):
        raise DataError(f"{path}: expected a JSON object")
    return found


def _parsed(text: str, where: str) -> Any:
    """Return the content of a JSON text; one in which a key stands twice has two meanings, and is refused."""
    try:
        return json.loads(text, object_pairs_hook=_unique)
    except json.JSONDecodeError as error:
        raise DataError(f"{where}: line {error.lineno}: not valid JSON: {error.msg}") from error
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: not valid JSON: {short_reason(error)}") from error


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError(f"the key {Counter(key for key, _ in pairs).most_common(1)[0][0]!r} twice")
    return found


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a JSON document") from error
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror}") from error


def write_atomically(path: Path, content: str | bytes) -> None:
    """Write a file so that a reader sees all of it or none of it; missing folders are created."""
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(content if isinstance(content, bytes) else content.encode())
        stream.flush()
        os.fsync(stream.fileno())


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield the name of an empty file that takes the place of ``path`` in the end; after an error there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Created like any other file, so that the umask decides who may read it.
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        temporary.open("x").close()
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        temporary.unlink(missing_ok=True)
