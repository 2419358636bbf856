"""Sequences whose items are on disk, or are computed at every use."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from armident.configs import ConfigError
from armident.identify.signals.streamed import OnDisk, Streamed, chosen, kept, mapped


def test_items_on_disk_come_back_by_number_slice_and_in_threads() -> None:
    items = [np.full((k, 2), float(k)) for k in range(20)]
    stored = OnDisk(iter(items))
    assert len(stored) == 20
    assert all(np.array_equal(a, b) for a, b in zip(stored, items, strict=True))
    assert np.array_equal(stored[-1], items[-1])
    assert [len(item) for item in stored[3:9:2]] == [3, 5, 7]
    with pytest.raises(IndexError):
        stored[20]
    with ThreadPoolExecutor(8) as pool:
        read = pool.map(stored.__getitem__, list(range(20)) * 20)
        assert all(np.array_equal(a, b) for a, b in zip(read, items * 20, strict=True))


def test_what_belongs_to_streamed_items_is_streamed_and_to_a_list_is_a_list() -> None:
    stored = OnDisk([1, 2, 3])
    doubled = mapped(lambda a, b: a + b, stored, [10, 20, 30])
    assert isinstance(doubled, Streamed)
    assert list(doubled) == [11, 22, 33]
    assert isinstance(kept(iter(doubled), like=doubled), OnDisk)
    part = chosen(doubled, [2, 0])
    assert isinstance(part, Streamed)
    assert list(part) == [33, 11]
    assert chosen([1, 2, 3], [2, 0]) == [3, 1]
    assert mapped(lambda a: 2 * a, [1, 2]) == [2, 4]
    assert kept(iter([1, 2]), like=[0]) == [1, 2]


def test_a_folder_that_cannot_be_written_is_named_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path / "missing"))
    with pytest.raises(ConfigError, match=r"missing: .* cannot be written: No such file or directory; set TMPDIR"):
        OnDisk([1])


def test_a_full_disk_is_named_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    full = Path("/dev/full").open("wb", buffering=0)  # noqa: SIM115 (the sequence closes it)
    monkeypatch.setattr("tempfile.TemporaryFile", lambda **_: full)
    with pytest.raises(ConfigError, match="No space left on device; set TMPDIR"):
        OnDisk([np.zeros(1000)])
