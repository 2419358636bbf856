"""HTML report of a check of the set-up: mistakes with their corrections, torque errors by joint."""

from armident.identify.documents.setup import SetupDocument
from armident.identify.report.page import render
from armident.identify.setup.result import SetupCheck


def setup_report(document: SetupDocument, result: SetupCheck) -> str:
    """Return the HTML page of a check of the set-up, complete in one file."""
    shift = result.torque_shift
    return render("setup.html", document=document, remark="" if shift is None else shift.remark, glossary=None)
