"""JSON Schemas of the result documents: ``python -m tests.tools.json_schemas`` writes ``configs/json_schemas``."""

import json
from pathlib import Path

from armident import configs
from armident.identify.documents.base import Document
from armident.identify.documents.characterisation import CharacterisationDocument
from armident.identify.documents.commissioning import CommissioningDocument
from armident.identify.documents.comparison import ComparisonDocument
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import write_atomically
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.investigation import InvestigationDocument
from armident.identify.documents.prediction import PredictionDocument, PredictionsDocument
from armident.identify.documents.setup import SetupDocument
from armident.identify.documents.simulation import SimulationDocument

SCHEMA_FILES: dict[str, type[Document]] = {
    "identification.schema.json": IdentificationDocument,
    "diagnosis.schema.json": DiagnosisDocument,
    "investigation.schema.json": InvestigationDocument,
    "commissioning.schema.json": CommissioningDocument,
    "characterisation.schema.json": CharacterisationDocument,
    "prediction.schema.json": PredictionDocument,
    "predictions.schema.json": PredictionsDocument,
    "comparison.schema.json": ComparisonDocument,
    "simulation.schema.json": SimulationDocument,
    "check.schema.json": SetupDocument,
}
"""Documents that have a JSON Schema in ``configs/json_schemas``, by the name of its file."""


def schema_text(kind: type[Document]) -> str:
    """Return the JSON Schema of a document as it stands in ``configs/json_schemas``."""
    return json.dumps(kind.model_json_schema(by_alias=True), indent=2) + "\n"


def write_schemas() -> None:
    """Write the schema files of all documents."""
    for name, kind in SCHEMA_FILES.items():
        write_atomically(Path(configs.__file__).parent / "json_schemas" / name, schema_text(kind))


if __name__ == "__main__":
    write_schemas()
