"""Signatures of documents, and ``armident verify``."""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from armident.configs import ConfigError
from armident.daq.identity import VARIABLE
from armident.daq.identity.certificates import Role, new_authority, pem_of, write_identity, write_whole
from armident.daq.identity.folder import KeyFolder
from armident.identify.documents.files import load_document, to_json
from armident.identify.documents.prediction import PredictionsDocument
from armident.identify.documents.signing import sign_file, verify_command, write_document

NOW = datetime.now(UTC)
AUTHORITY = new_authority("plant", 365)
DOCUMENT = PredictionsDocument(robot="emps", model="m", worst_recording=None, worst_error_pct=1e-7, predictions=[])


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    """Folder of a plant with a worker, an operator, and a viewer."""
    folder = tmp_path / "keys"
    folder.mkdir()
    write_whole(folder / "authority.pem", pem_of(AUTHORITY.certificate), 0o644)
    roles: list[tuple[Role, str]] = [("worker", "line_3"), ("operator", "line_3"), ("viewer", "*")]
    for role, cell in roles:
        write_identity(folder, AUTHORITY.issue(role, cell, f"{role}.{cell.replace('*', 'ann')}", [], 30))
    return folder


def verified(path: Path, keys: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    code = verify_command([path], keys, as_json=True)
    (found,) = json.loads(capsys.readouterr().out)
    return code, found


def test_a_signed_document_says_who_wrote_it(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "predictions.json"
    write_document(path, DOCUMENT, KeyFolder(plant).identity("worker", "line_3"))
    code, found = verified(path, plant, capsys)
    assert (code, found["verified"]) == (0, True)
    assert (found["name"], found["role"], found["cell"]) == ("worker.line_3", "worker", "line_3")
    assert abs(datetime.fromisoformat(found["time"]) - datetime.now(UTC)) < timedelta(minutes=1)
    # The signature is of the file: what is loaded and written again has the same content, and none.
    loaded = load_document(path, PredictionsDocument)
    assert loaded.signature is not None
    assert to_json(loaded) == to_json(DOCUMENT)


def changed(text: str, **changes: Any) -> str:
    return json.dumps(json.loads(text) | changes)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: text.replace('"predictions": []', '"predictions": [ ]'), None),
        (lambda text: json.dumps(json.loads(text), indent=4), None),
        (lambda text: changed(text, predictions=[1]), "does not fit"),
        (lambda text: changed(text, more=None), "does not fit"),
        (lambda text: changed(text, provenance=json.loads(text)["provenance"] | {"host": "x"}), "does not fit"),
        (lambda text: changed(text, provenance=None), "damaged"),
        (lambda text: changed(text, provenance={"time": "x"}), "damaged"),
        (lambda text: changed(text, provenance=json.loads(text)["provenance"] | {"time": "2026-01-01"}), "damaged"),
        (lambda text: changed(text, signature={"certificate": "", "value": ""}), "not a certificate"),
        (lambda text: changed(text, signature={"certificate": "%", "value": ""}), "damaged"),
        (lambda text: changed(text, signature=[]), "damaged"),
        (lambda text: json.dumps({k: v for k, v in json.loads(text).items() if k != "signature"}), "not signed"),
        (lambda text: text[: len(text) // 2], "not valid JSON"),
        (lambda text: text.replace("{", '{"predictions": [1],', 1), "not valid JSON: the key 'predictions' twice"),
        (lambda text: text.replace("{", '{"n": ' + "1" * 5000 + ",", 1), "not valid JSON"),
        (lambda text: "[" * 100_000, "not valid JSON"),
    ],
)
def test_every_change_of_the_content_is_found(
    change: Any, reason: str | None, plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "predictions.json"
    write_document(path, DOCUMENT, KeyFolder(plant).identity("worker", "line_3"))
    path.write_text(change(path.read_text()))
    code, found = verified(path, plant, capsys)
    assert (code, found["verified"]) == (int(reason is not None), reason is None)
    assert reason is None or reason in found["reason"]


def test_a_signer_who_may_not_sign_is_refused(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, ends = tmp_path / "predictions.json", NOW - timedelta(days=5)
    foreign = new_authority("plant", 365).issue("worker", "line_3", "worker.line_3", [], 30)
    expired = AUTHORITY.issue("worker", "line_3", "worker.line_3", [], 30, ends - timedelta(days=30))
    viewer = KeyFolder(plant).identity("viewer", "line_3")
    for identity, reason in ((foreign, "another authority"), (expired, "expired on"), (viewer, "may not sign")):
        write_document(path, DOCUMENT, identity)
        code, found = verified(path, plant, capsys)
        assert code == 1
        assert reason in found["reason"]


def test_a_person_signs_with_a_key_of_the_plant_and_not_without(
    plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "predictions.json"
    monkeypatch.delenv(VARIABLE, raising=False)
    write_document(path, DOCUMENT)
    assert path.read_text() == to_json(DOCUMENT)
    assert verified(path, plant, capsys)[1]["reason"].startswith("not signed")
    monkeypatch.setenv(VARIABLE, str(plant))
    write_document(path, DOCUMENT)
    assert verified(path, plant, capsys)[1]["role"] == "operator"
    for file in plant.glob("operator.*"):
        file.unlink()
    write_document(path, DOCUMENT)
    assert path.read_text() == to_json(DOCUMENT)


def test_a_signed_document_that_is_signed_again_has_one_signature(
    plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "predictions.json"
    write_document(path, DOCUMENT, KeyFolder(plant).identity("operator", "line_3"))
    assert sign_file(path, KeyFolder(plant).identity("worker", "line_3")) == path.read_text()
    assert verified(path, plant, capsys)[1]["role"] == "worker"


def test_the_command_prints_one_line_for_each_file(
    plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        write_document(tmp_path / f"{name}.json", DOCUMENT, KeyFolder(plant).identity("worker", "line_3"))
    (tmp_path / "b.json").write_text(changed((tmp_path / "b.json").read_text(), predictions=[2]))
    assert verify_command([tmp_path / "a.json", tmp_path / "b.json"], plant, as_json=False) == 1
    first, second = capsys.readouterr().out.splitlines()
    assert "unchanged, signed by worker.line_3 (worker of line_3) on" in first
    assert second.endswith("b.json: NOT VERIFIED: the signature of worker.line_3 does not fit: changed or forged")
    for missing in ((tmp_path / "c.json", plant), (tmp_path / "a.json", tmp_path / "none")):
        with pytest.raises(ConfigError):
            verify_command([missing[0]], missing[1], as_json=False)
