"""An example file of every format that is imported, from the list of readers."""

import importlib
from pathlib import Path

from armident.daq.interchange.exporting import export_recording
from armident.daq.interchange.readers import READERS, Reader, written
from armident.daq.recording import Recording

EXAMPLES = [(each, suffix) for each in READERS if not each.own for suffix in written(each) or each.suffixes[:1]]
"""Formats with the suffixes of their examples: those that are written, or the first one."""


def example(reader: Reader, suffix: str, folder: Path, recording: Recording) -> Path:
    """Write a file of a format: by its writer, or else by ``example(path)`` in the test module of the reader's class.

    The test module of a class ``Xyz`` is ``test_xyz``.
    """
    path = folder / f"example{suffix}"
    if reader.writer:
        export_recording(recording, path)
    else:
        importlib.import_module(f"tests.unit.daq.test_{type(reader).__name__.lower()}").example(path)
    return path
