"""Result documents: schema files, round trips, messages about broken files."""

import os
import stat
from pathlib import Path

import numpy as np
import pytest

from armident import configs
from armident.configs import ConfigError, DataError
from armident.configs.schema.base import DescribedModel, split_docstring
from armident.configs.schema.robot import RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.session import SessionConfig
from armident.configs.schema.trajectory import Trajectory
from armident.daq.recording import write_recording
from armident.identify.documents.base import plain
from armident.identify.documents.diagnosis import BeforeAfter, DiagnosisDocument, Gap, Gaps
from armident.identify.documents.files import from_json, load_document, to_json, write_atomically
from armident.identify.documents.identification import IdentificationDocument, parameter
from tests.evaluation.schema import SuiteConfig
from tests.tools.json_schemas import SCHEMA_FILES, schema_text
from tests.unit.daq.test_recording import make_recording


def diagnosis() -> DiagnosisDocument:
    gap = Gap(all=5.0, by_joint={"joint_1": 5.0})
    same = BeforeAfter(before=gap, after=gap)
    return DiagnosisDocument(
        robot="tx40",
        recordings=[],
        verdict="no_gap",
        findings=[],
        unexplained=[],
        gap=Gaps(train=same, validation=same),
        noise_floor=gap,
        recommended_experiment=None,
        model=None,
        timing_s={"total": 1.0},
        versions={},
        warnings=[],
    )


@pytest.mark.parametrize("name", sorted(SCHEMA_FILES))
def test_shipped_schema_is_the_one_of_the_code(name: str) -> None:
    text = (Path(configs.__file__).parent / "json_schemas" / name).read_text(encoding="utf-8")
    assert text == schema_text(SCHEMA_FILES[name]), "run: python -m tests.tools.json_schemas"


@pytest.mark.parametrize(
    "kind", [*SCHEMA_FILES.values(), RobotConfig, SessionConfig, Trajectory, Scenario, SuiteConfig]
)
def test_every_field_of_a_schema_is_described(kind: type[DescribedModel]) -> None:
    schema = kind.model_json_schema(by_alias=True)
    parts = {**schema.get("$defs", {}), kind.__name__: schema}
    missing = [
        f"{part}.{field}"
        for part, definition in parts.items()
        for field, entry in definition.get("properties", {}).items()
        if not entry.get("description")
    ]
    assert not missing, "not in the Parameters section of the docstring"


def test_names_that_share_a_description_each_have_it() -> None:
    docstring = """Return a sum.

    Parameters
    ----------
    a, b : float
        Terms of
        the sum.
    c
        Third term.
    """
    assert split_docstring(docstring) == (
        "Return a sum.",
        {"a": "Terms of the sum.", "b": "Terms of the sum.", "c": "Third term."},
    )


def test_a_document_survives_being_written_and_read(tmp_path: Path) -> None:
    path = tmp_path / "out" / "diagnosis.json"
    write_atomically(path, to_json(diagnosis()))
    assert load_document(path, DiagnosisDocument) == diagnosis()
    assert [p.name for p in path.parent.iterdir()] == ["diagnosis.json"]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o027, 0o640)])
def test_the_umask_decides_who_may_read_a_result_as_with_recordings(tmp_path: Path, umask: int, mode: int) -> None:
    before = os.umask(umask)
    try:
        write_atomically(tmp_path / "diagnosis.json", to_json(diagnosis()))
        write_recording(make_recording(10), tmp_path / "arm.mcap")
    finally:
        os.umask(before)
    assert {stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()} == {mode}


def test_the_schema_key_is_first_and_versioned() -> None:
    assert to_json(diagnosis()).splitlines()[1].strip() == '"schema":"armident/diagnosis/2",' or (
        '"schema": "armident/diagnosis/2"' in to_json(diagnosis()).splitlines()[1]
    )


@pytest.mark.parametrize("version", [1, 3])
def test_another_version_is_refused_naming_file_and_key(version: int) -> None:
    text = to_json(diagnosis()).replace("armident/diagnosis/2", f"armident/diagnosis/{version}")
    with pytest.raises(DataError, match=r"old\.json: schema"):
        from_json(text, DiagnosisDocument, "old.json")


def test_a_diagnosis_is_not_an_identification() -> None:
    with pytest.raises(DataError, match="schema"):
        from_json(to_json(diagnosis()), IdentificationDocument, "x.json")


def test_half_a_document_is_refused_with_its_line() -> None:
    with pytest.raises(DataError, match=r"x\.json: line \d+: not valid JSON"):
        from_json(to_json(diagnosis())[:50], DiagnosisDocument, "x.json")


def test_a_parameter_of_value_zero_has_no_relative_deviation() -> None:
    assert parameter("off1", 0.0, 0.1, "N m", False).relative_std_pct is None
    assert parameter("fv1", -2.0, 0.1, "N m s/rad", True).relative_std_pct == pytest.approx(5.0)


def test_numbers_that_are_not_finite_become_null() -> None:
    assert plain({"a": np.array([1.0, np.nan]), "b": (np.int64(3), np.inf)}) == {"a": [1.0, None], "b": [3, None]}


def test_a_failed_write_leaves_nothing_behind(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    target.mkdir()
    with pytest.raises(OSError):  # noqa: PT011 - which one depends on the file system
        write_atomically(target, "{}")
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_a_document_that_is_not_there_is_a_mistake_of_the_call(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.json: no such file"):
        load_document(tmp_path / "gone.json", IdentificationDocument)
