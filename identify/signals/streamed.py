"""Sequences of large items of which only those in use are in memory: the stretches of a long recording."""

import os
import pickle
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np

from armident.configs import ConfigError

T = TypeVar("T")


class Streamed(Sequence[T]):
    """Sequence that makes or reads an item whenever it is asked for."""

    @overload
    def __getitem__(self, k: int) -> T: ...

    @overload
    def __getitem__(self, k: slice) -> Sequence[T]: ...

    def __getitem__(self, k: int | slice) -> T | Sequence[T]:
        if isinstance(k, slice):
            return [self._item(i) for i in range(*k.indices(len(self)))]
        return self._item(range(len(self))[k])

    def _item(self, k: int) -> T:
        raise NotImplementedError


class OnDisk(Streamed[T]):
    """Items in a file without a name, which disappears with the sequence or the process; each is written and freed."""

    def __init__(self, items: Iterable[T]) -> None:
        folder = Path(os.environ.get("TMPDIR") or "/var/tmp")  # which is no memory disk
        self._places: list[tuple[int, list[int]]] = []
        end = 0
        try:
            self._file = tempfile.TemporaryFile(dir=folder, prefix="armident-", buffering=0)  # noqa: SIM115
        except OSError as error:
            raise _not_written(folder, error) from error
        for item in items:
            # Arrays follow their item as they are: neither writing nor reading copies them.
            arrays: list[pickle.PickleBuffer] = []
            head = pickle.dumps(item, protocol=5, buffer_callback=arrays.append)
            parts = [memoryview(head), *(array.raw() for array in arrays)]
            sizes = [part.nbytes for part in parts]
            try:
                for part in parts:
                    while part:
                        part = part[self._file.write(part) :]
            except OSError as error:
                self._file.close()
                raise _not_written(folder, error) from error
            self._places.append((end, sizes))
            end += sum(sizes)

    def __len__(self) -> int:
        return len(self._places)

    def _item(self, k: int) -> T:
        # Threads read at the same time, so the position of the file is not used.
        begin, sizes = self._places[k]
        head, *arrays = (np.empty(size, dtype=np.uint8).data for size in sizes)
        read = os.preadv(self._file.fileno(), [head, *arrays], begin)
        assert read == sum(sizes)
        item: T = pickle.loads(head, buffers=arrays)
        return item


class Mapped(Streamed[T]):
    """Results of a function of the items of other sequences of one length, computed whenever they are asked for."""

    def __init__(self, function: Callable[..., T], *sequences: Sequence[Any]) -> None:
        self._function, self._sequences = function, sequences

    def __len__(self) -> int:
        return min(len(sequence) for sequence in self._sequences)

    def _item(self, k: int) -> T:
        return self._function(*(sequence[k] for sequence in self._sequences))


def kept(items: Iterable[T], like: Sequence[Any]) -> Sequence[T]:
    """Return the items, consumed at once, as a list, or on disk where ``like`` (the experiments) is streamed."""
    return OnDisk(items) if isinstance(like, Streamed) else list(items)


def mapped(function: Callable[..., T], *sequences: Sequence[Any]) -> Sequence[T]:
    """Return the results of a function as a list, or computed again at every use where a sequence is streamed."""
    if any(isinstance(sequence, Streamed) for sequence in sequences):
        return Mapped(function, *sequences)
    return [function(*items) for items in zip(*sequences, strict=True)]


def chosen(items: Sequence[T], numbers: Sequence[int]) -> Sequence[T]:
    """Return the items of these numbers as a list, or read again at every use where the sequence is streamed."""
    if isinstance(items, Streamed):
        return Mapped(items.__getitem__, numbers)
    return [items[k] for k in numbers]


def _not_written(folder: Path, error: OSError) -> ConfigError:
    return ConfigError(
        f"{folder}: the intermediate results of a long recording cannot be written: {error.strerror}; "
        "set TMPDIR to a folder with more space, or identify a part of the recording"
    )
