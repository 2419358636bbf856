"""``armident example`` copies what is shipped; the README files of the examples run in test_docs.py."""

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from armident.daq.cli import GROUP, application
from armident.example_command import EXAMPLES


def run(*words: str) -> Result:
    app = application(words, [EntryPoint("example", "armident.example_command:example", GROUP)])
    return CliRunner().invoke(app, list(words))


def test_every_example_is_listed_and_copied_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    names = [line.split()[0] for line in run("example").stdout.splitlines()]
    assert names == sorted(folder.name for folder in EXAMPLES.iterdir())
    for name in names:
        assert f"cd {name}" in run("example", name).stdout
        shipped = {p.name: p.read_bytes() for p in (EXAMPLES / name).iterdir() if p.is_file()}
        assert {p.name: p.read_bytes() for p in (tmp_path / name).iterdir()} == shipped


def test_an_example_overwrites_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mujoco").mkdir()
    again = run("example", "mujoco")
    assert again.exit_code == 2
    assert "this folder exists" in again.output
    assert not list(Path("mujoco").iterdir())
    unknown = run("example", "mojuco")
    assert unknown.exit_code == 2
    assert "there are integration_test, lerobot, mujoco, ros2" in unknown.output
