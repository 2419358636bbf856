"""Saved state of the recursive estimator: arrays and numbers by name, in a file with a version."""

import io
import json
import os
import tempfile
from pathlib import Path
from typing import Any, Protocol, runtime_checkable
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from armident.configs import ConfigError, DataError

SCHEMA = "armident/recursive-state/1"
"""Version of the saved state: any change of the arithmetic, and any new array, changes it."""


@runtime_checkable
class HasState(Protocol):
    """Object whose whole state is in the attributes that ``_saved`` names: arrays, numbers, or other such objects."""

    @property
    def _saved(self) -> tuple[str, ...]: ...


def state_of(owner: HasState, prefix: str = "") -> dict[str, NDArray[Any]]:
    """Return copies of the state of an object by name. ``prefix``: beginning of every name."""
    found: dict[str, NDArray[Any]] = {}
    for name in owner._saved:
        value = getattr(owner, name)
        if isinstance(value, HasState):
            found |= state_of(value, f"{prefix}{name}.")
        else:
            found[prefix + name] = np.array(value)
    return found


def restore_state(owner: HasState, arrays: dict[str, NDArray[Any]], prefix: str = "") -> None:
    """Give an object the state of `state_of`; raises DataError if an array is missing or of another dimension."""
    for name in owner._saved:
        value = getattr(owner, name)
        if isinstance(value, HasState):
            restore_state(value, arrays, f"{prefix}{name}.")
            continue
        found = arrays.get(prefix + name)
        if found is None or found.ndim != np.ndim(value):
            raise DataError(f"saved state: {prefix + name} is missing or has another shape: start without it")
        setattr(owner, name, found.copy() if isinstance(value, np.ndarray) else type(value)(found.item()))


def write_state(path: Path, arrays: dict[str, NDArray[Any]], identity: dict[str, str]) -> None:
    """Write a state (NumPy ``.npz``) of a robot and reference so that a reader sees all of it or none."""
    buffer = io.BytesIO()
    head = np.frombuffer(json.dumps({"schema": SCHEMA, **identity}).encode(), dtype=np.uint8)
    np.savez(buffer, head=head, **{f"state:{name}": value for name, value in arrays.items()})  # type: ignore[arg-type]
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(buffer.getvalue())
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def read_state(path: Path, identity: dict[str, str]) -> dict[str, NDArray[Any]]:
    """Read a state of `write_state`; raises ConfigError if it is missing, DataError if it is of another identity."""
    try:
        with np.load(path, allow_pickle=False) as content:
            head = json.loads(content["head"].tobytes())
            arrays = {name.removeprefix("state:"): content[name] for name in content.files if name != "head"}
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file") from error
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise DataError(f"{path}: not a saved state of armident watch: remove it to start anew") from error
    if not isinstance(head, dict) or head.get("schema") != SCHEMA:
        found = head.get("schema") if isinstance(head, dict) else head
        raise DataError(f"{path}: a saved state of version {found!r:.60}, this program has {SCHEMA!r}: remove it")
    for name, value in identity.items():
        if head.get(name) != value:
            raise DataError(f"{path}: the saved state belongs to another {name}: remove it to start anew")
    return arrays
