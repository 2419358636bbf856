"""Inputs that failed once, and new ones of every kind, are taken as they were written or refused in one line."""

import itertools
from pathlib import Path

import pytest

from tests.fuzz.harness import CORPUS, Finding, attempt
from tests.fuzz.targets import TARGETS

pytestmark = pytest.mark.slow

NEW = 4
"""Inputs besides the corpus; `python -m tests.fuzz` tries as many as there is time for."""


@pytest.mark.parametrize("name", TARGETS)
def test_no_input_is_misread_or_breaks_its_reader(name: str, tmp_path: Path) -> None:
    target = TARGETS[name]
    target.warm_up(tmp_path)
    inputs = [path.read_bytes() for path in target.corpus()] + list(itertools.islice(target.inputs(0), NEW))
    findings = [found for data in inputs if isinstance(found := attempt(target, data, tmp_path), Finding)]
    assert [(found.where, found.trace) for found in findings] == []


@pytest.mark.parametrize("name", TARGETS)
def test_what_is_well_formed_is_accepted(name: str, tmp_path: Path) -> None:
    """A reader that refused everything would pass the other test."""
    target = TARGETS[name]
    assert any(attempt(target, data, tmp_path) is True for data in target.seeds)


def test_every_input_in_the_corpus_is_tried() -> None:
    assert {path.name for path in CORPUS.iterdir()} <= set(TARGETS)
