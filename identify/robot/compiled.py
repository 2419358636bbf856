"""Compilation of the numeric kernels: cached on disk, without the interpreter lock, ordinary IEEE arithmetic."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., object])

_ARITHMETIC: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
# No reference counts: the caller keeps the arrays alive, and an atomic increment costs as much as the arithmetic.
_UNCOUNTED: dict[str, Any] = {"_nrt": False}


def compiled(function: F) -> F:
    """Compile a kernel with numba; the machine code is cached beside the source or in ``NUMBA_CACHE_DIR``."""
    return cast(F, numba.njit(cache=True, nogil=True, **_ARITHMETIC)(function))


def inlined(function: F) -> F:
    """Compile a helper that allocates no memory, inlined into every kernel that calls it.

    In the caller the compiler sees which arrays are distinct and which loops are short; a call would hide both.
    """
    return cast(F, numba.njit(forceinline=True, **_ARITHMETIC, **_UNCOUNTED)(function))
