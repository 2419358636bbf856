"""Position set points for the SYNC producer."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class SetpointPlan:
    """Position set points of all n drives, counts, int32 rows (M, n), one row per ``every`` SYNCs.

    ``cob_ids`` (n,): of the drives' set point RPDOs. ``bus_of`` (n,): numbers of their buses; empty: all on one.
    """

    rows: NDArray[np.int32]
    cob_ids: tuple[int, ...]
    every: int = 5
    bus_of: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.rows.ndim != 2 or self.rows.shape[1] != len(self.cob_ids) or not self.rows.size:
            raise ValueError(f"rows of shape {self.rows.shape} for {len(self.cob_ids)} drives")
        if self.rows.dtype != np.int32:
            raise ValueError(f"rows must be int32, not {self.rows.dtype}")
        if self.bus_of and len(self.bus_of) != len(self.cob_ids):
            raise ValueError(f"{len(self.bus_of)} buses for {len(self.cob_ids)} drives")
