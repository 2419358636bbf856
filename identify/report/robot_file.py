"""Writers of result documents and reports."""

from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from armident.configs import RobotConfig
from armident.identify.documents.files import write_atomically
from armident.identify.documents.signing import write_document
from armident.identify.identification.identify_recording import IdentificationOutcome

if TYPE_CHECKING:
    from armident.daq.identity.certificates import Identity


def write_identification(
    outcome: IdentificationOutcome, out: Path, identity: "Identity | None" = None
) -> tuple[Path, Path]:
    """Write ``identification.json`` and ``report.html`` into a folder; return their paths. ``identity``: signer."""
    from armident.identify.report.identification_report import identification_report

    document, report = out / "identification.json", out / "report.html"
    # The document comes last: where there is one, the report is there, too.
    write_atomically(report, identification_report(outcome.recordings, outcome.robot, outcome.result, outcome.document))
    write_document(document, outcome.document, identity)
    return document, report


def robot_yaml(robot: RobotConfig) -> str:
    """Return the YAML text of a robot configuration."""
    return yaml.safe_dump(robot.model_dump(mode="json", by_alias=True), sort_keys=False)
