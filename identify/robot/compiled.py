"""How the numeric kernels are compiled: cached on disk, no interpreter lock, ordinary IEEE arithmetic."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])

_ARITHMETIC: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
# Without reference counts: the caller holds the arrays, and an atomic increment each costs as much as the arithmetic.
_UNCOUNTED: dict[str, Any] = {"_nrt": False}


def compiled(function: F) -> F:
    """Compile a kernel with numba; the machine code is cached beside the source or in ``NUMBA_CACHE_DIR``."""
    return cast(F, numba.njit(cache=True, nogil=True, **_ARITHMETIC)(function))


def inlined(function: F) -> F:
    """Compile a helper that allocates nothing into every kernel that calls it.

    There the compiler knows which arrays are distinct and which loops are short, which a call would hide from it.
    """
    return cast(F, numba.njit(forceinline=True, **_ARITHMETIC, **_UNCOUNTED)(function))
