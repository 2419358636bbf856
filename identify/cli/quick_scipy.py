"""Import of scipy by a command, in a third of the time: without a table that it writes into its docstrings."""

import scipy

VERSIONS = ("1.16.", "1.17.")
"""Versions of scipy whose decorator `xp_capabilities` does nothing but write the table, into 700 docstrings: 1 s."""


def omit_docstring_tables() -> None:
    """Let what this process imports of scipy from now on keep its docstrings as they are: no command shows them."""
    if scipy.__version__.startswith(VERSIONS):
        from scipy._lib import _array_api

        _array_api.xp_capabilities = lambda **_: lambda function: function
