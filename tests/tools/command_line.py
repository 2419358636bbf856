"""Command lines of the laboratory, with the errors and exit codes of ``armident``."""

import sys
from importlib.metadata import EntryPoint

import typer

from armident.daq.cli import GROUP, application

NAME = "run"
"""Word before the arguments; a call does not contain it."""


def laboratory(function: str) -> typer.Typer:
    """Application with one command, `NAME`, of ``module:function``."""
    return application([NAME], [EntryPoint(NAME, function, GROUP)])


def run(module: str, function: str) -> None:
    """Run the command ``module:function`` of ``python -m module`` with the arguments of the process."""
    laboratory(function)(args=[NAME, *sys.argv[1:]], prog_name=f"python -m {module}")
