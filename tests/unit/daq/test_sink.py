"""Rows of lagging drives that become complete at once are written and published in pieces."""

from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from armident.daq.capture.sink import PIECE_NS, pieces
from armident.daq.matching.assembler import Batch, Rows
from armident.daq.recording import Gap

PERIOD_NS = 200_000


def batch_of(first: int, count: int, missing: list[int]) -> Batch:
    """Return samples at every SYNC and demand at every tenth, except at SYNCs that are gaps of one joint."""
    sync = np.setdiff1d(np.arange(first, first + count), missing)
    rows = {}
    for name, every in (("samples", 1), ("demand", 10)):
        here = sync[(sync + 1) % every == 0]
        data = here[:, None, None].astype(np.uint8) + np.arange(8, dtype=np.uint8)
        rows[name] = Rows(here, here * PERIOD_NS, np.repeat(data, 2, axis=1))
    return Batch(rows, tuple(Gap("samples", k, k, "joint_1") for k in sorted(missing)))


@given(
    first=st.integers(0, 10**6),
    count=st.integers(1, 12_000),
    missing=st.sets(st.integers(0, 11_999), max_size=5),
)
def test_pieces_hold_all_rows_and_gaps_once_and_in_order(first: int, count: int, missing: set[int]) -> None:
    whole = batch_of(first, count, [first + k for k in missing if k < count])
    parts = list(pieces(whole))
    for name, rows in whole.rows.items():
        for what in ("sync", "t_ns", "data"):
            got = np.concatenate([getattr(part.rows[name], what) for part in parts])
            assert np.array_equal(got, getattr(rows, what))
    assert tuple(gap for part in parts for gap in part.gaps) == whole.gaps
    for part in parts:
        samples = part.rows["samples"]
        if samples.sync.size:
            assert samples.t_ns[-1] - samples.t_ns[0] < PIECE_NS
            assert all(np.isin(rows.sync // 10, samples.sync // 10).all() for rows in part.rows.values())
    for before, after in pairwise(parts):
        assert all(gap.first < after.rows["samples"].sync[0] for gap in before.gaps)
        begin = whole.rows["samples"].t_ns[0]
        number, following = ((part.rows["samples"].t_ns[0] - begin) // PIECE_NS for part in (before, after))
        assert number < following


def test_gaps_without_rows_are_a_piece_of_their_own() -> None:
    whole = batch_of(0, 3, [0, 1, 2])
    assert list(pieces(whole)) == [whole]
