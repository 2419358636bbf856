"""How the numeric kernels are compiled: cached on disk, no interpreter lock, ordinary IEEE arithmetic."""

from collections.abc import Callable
from typing import TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])


def compiled(function: F) -> F:
    """Compile a kernel with numba; the machine code is cached beside the source or in ``NUMBA_CACHE_DIR``."""
    return cast(F, numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})(function))


def inlined(function: F) -> F:
    """Compile a small helper into every kernel that calls it."""
    return cast(F, numba.njit(fastmath={"contract", "nsz"}, error_model="numpy")(function))
