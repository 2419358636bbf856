"""Compilation of the loops that handle every frame: ahead of time in a wheel, by numba in a checkout.

A wheel has the extension module ``armident._kernels``, which ``setup.py`` compiles from the same functions; it needs
neither numba nor a compiler. Without both, the functions run interpreted: enough for imports, too slow for a bus.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, Literal, TypeVar

from armident.configs.errors import ConfigError

F = TypeVar("F", bound=Callable[..., Any])


def _imported(name: str) -> ModuleType | None:
    try:
        return __import__(name, fromlist=["*"])
    except ImportError:
        return None


_AHEAD = _imported("armident._kernels")
_NUMBA = _imported("numba") if _AHEAD is None else None
MODE: Literal["ahead of time", "by numba", "interpreted"] = (
    "ahead of time" if _AHEAD is not None else "by numba" if _NUMBA is not None else "interpreted"
)
"""Compilation of the loops in this installation."""


def kernel_name(function: Callable[..., Any]) -> str:
    """Return the name of a function in the extension module. ``function``: or numba's dispatcher of it."""
    return f"{function.__module__.rpartition('.')[2]}_{function.__name__.lstrip('_')}"


def compiled(function: F) -> F:
    """Compile a function that releases the interpreter's lock and is cached, as this installation can.

    Ahead of time, this gives the compiled function for those that ``setup.py`` lists. The others are parts of them and
    stay interpreted.

    ``function``: function of numbers, arrays and named tuples of arrays.
    """
    if _NUMBA is not None:
        found: F = _NUMBA.njit(cache=True, nogil=True)(function)
        return found
    ahead: F | None = getattr(_AHEAD, kernel_name(function), None)
    return function if ahead is None else ahead


def require_compiled() -> None:
    """Check that the loops are compiled. Raises ConfigError if they are interpreted."""
    if MODE == "interpreted":
        raise ConfigError(
            "this installation has no compiled code for the bus, because there was no C compiler when its wheel was "
            "built: pip install 'armident[identify]', which brings a compiler, or install a wheel that has the code"
        )
