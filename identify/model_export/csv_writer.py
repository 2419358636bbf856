"""Parameters of an exported model as a table."""

import csv
import io
from pathlib import Path

import numpy as np

from armident.identify.documents.files import write_atomically
from armident.identify.identification.identification_result import unit
from armident.identify.model_export.code_writer import EVERY_PART
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.sheet import LimitationSheet, limitation_sheet

COLUMNS = ("name", "value", "std", "unit", "identifiable", "remark")
"""Heads of the columns."""


def write_csv(model: ExportedModel, path: Path) -> tuple[list[Path], LimitationSheet]:
    """Write the standard parameters in modified Denavit-Hartenberg frames, with those of the effects.

    ``identifiable``: ``alone``, ``group`` or ``no``; ``std`` is empty where the parameter is not determined alone.
    """
    found = model.consistent
    rigid = len(found.names) - model.arm.e
    units = [unit(name, model.robot) for name in found.names[:rigid]]
    units += [one for term in model.arm.terms for one in term.units]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(COLUMNS)
    for name, value, std, one, how in zip(found.names, found.theta, found.std, units, found.identifiable, strict=True):
        known = repr(float(std)) if np.isfinite(std) else ""
        writer.writerow([name, repr(float(value)), known, one, how, model.undetermined.get(name, "")])
    write_atomically(path, stream.getvalue())
    effects = [effect for effect in model.effects if not effect.of_recording]
    return [path], limitation_sheet(model, "csv", EVERY_PART, effects=effects)
