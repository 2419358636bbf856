"""Report of an identification: self-contained, with every essential parameter and warning."""

import re
from pathlib import Path

import pytest
from markupsafe import escape

from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument, VerdictReason
from armident.identify.documents.rounding import alike
from armident.identify.identification.identify_recording import IdentificationOutcome
from armident.identify.report.identification_report import identification_report
from armident.identify.report.robot_file import write_identification
from tests.fixtures.arms import FAST, identified


@pytest.fixture(scope="module")
def outcome() -> IdentificationOutcome:
    return identified("tx40", "tx40_excitation", 1, "idim-ls", period=FAST, checked=False)


@pytest.fixture(scope="module")
def written(outcome: IdentificationOutcome, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Document and report."""
    return write_identification(outcome, tmp_path_factory.mktemp("results") / "deep" / "out")


@pytest.fixture(scope="module")
def page(written: tuple[Path, Path]) -> str:
    return written[1].read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_report_needs_no_other_file(page: str) -> None:
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert sources
    assert all(source.startswith("data:image/svg+xml;base64,") for source in sources)


def test_every_essential_parameter_stands_in_the_report_with_its_value(
    outcome: IdentificationOutcome, page: str
) -> None:
    essential = [p for p in outcome.document.parameters if p.essential]
    assert essential
    for p in essential:
        row = '</td><td class="n">'.join(map(re.escape, alike(p.value, p.std)))
        assert re.search(rf'<td>{p.name}</td><td class="words">[^<]+</td><td class="n">{row}</td>', page), p.name


def test_warnings_reach_the_reader(outcome: IdentificationOutcome, page: str) -> None:
    assert page.count('class="warn"') == len(outcome.document.warnings)


def test_the_verdict_stands_in_a_card_before_everything_else(outcome: IdentificationOutcome, page: str) -> None:
    card = page.index(f'<div class="verdict {outcome.document.verdict}">')
    assert card < page.index('<div class="tiles">')
    for reason in outcome.document.reasons:
        assert page.count(str(escape(reason.message))) == 1 + (reason.kind in ("residual", "uncertainty"))


@pytest.mark.slow
def test_an_unusable_result_is_neither_converged_nor_white(outcome: IdentificationOutcome) -> None:
    reason = VerdictReason(
        level="unusable", kind="error", joint=None, message="The model explains nothing", next_step="x"
    )
    document = outcome.document.model_copy(
        update={"verdict": "unusable", "reasons": [reason], "converged": False, "relative_error_pct": 36767.0}
    )
    (robot, recordings), result = (outcome.robot, outcome.recordings), outcome.result
    text = identification_report(recordings, robot, result, document)
    assert '<div class="verdict unusable"><b>unusable</b>' in text
    assert "not converged" in text
    assert "They were not tested" in text


def test_the_document_is_written_beside_the_report(outcome: IdentificationOutcome, written: tuple[Path, Path]) -> None:
    document, report = written
    assert load_document(document, IdentificationDocument) == outcome.document
    assert sorted(p.name for p in report.parent.iterdir()) == ["identification.json", "report.html"]
