"""What a process saves that runs one command and ends."""

import atexit
import gc

import scipy

VERSIONS = ("1.16.", "1.17.")
"""Versions of scipy whose decorator `xp_capabilities` only writes a table into docstrings, 0.4 s for scipy.optimize."""


def shorten() -> None:
    """Import scipy without tables in its docstrings, which no command shows; end without a last garbage collection."""
    if scipy.__version__.startswith(VERSIONS):
        from scipy._lib import _array_api

        vars(_array_api)["xp_capabilities"] = lambda **_: lambda function: function
    atexit.register(gc.freeze)
