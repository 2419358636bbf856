"""Help, messages, docs, exports and fuzz targets know every reader."""

import inspect
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

import armident
from armident.configs import ConfigError
from armident.daq.cli import application
from armident.daq.interchange.import_options import FLAGS
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.readers import READERS, reader_of
from tests.fuzz.targets import IMPORTERS
from tests.unit.daq.formats import EXAMPLES
from tests.unit.daq.test_importing import TX40

ROOT = Path(__file__).resolve().parents[3]


def test_help_messages_docs_and_fuzz_targets_name_every_format(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.xyz").touch()
    with pytest.raises(ConfigError, match=r"cannot read \.xyz; readable: ") as refused:
        reader_of(tmp_path / "a.xyz")
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "extensions"))
    import generated_reference  # type: ignore[import-not-found]

    shown = [CliRunner().invoke(application([name]), [name, "--help"]).output for name in ("import", "init")]
    texts = [str(refused.value), generated_reference.formats_page(), *(" ".join(text.split()) for text in shown)]
    for reader in READERS:
        assert all(reader.name in text for text in texts), reader.name
    assert {f"import-{suffix[1:]}" for _, suffix in EXAMPLES} <= set(IMPORTERS)
    sys.modules.pop("generated_reference")


def test_the_python_api_and_the_command_have_the_same_options() -> None:
    parameters = inspect.signature(armident.import_recording).parameters
    assert list(parameters)[2:] == list(FLAGS)
    shown = CliRunner().invoke(application(["import"]), ["import", "--help"]).output
    assert all(flag in shown for flag in FLAGS.values())
    assert all(f"\n{name}\n" in inspect.cleandoc(armident.import_recording.__doc__ or "") for name in FLAGS)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: type(reader).__name__)
def test_an_option_that_a_format_does_not_have_is_refused(reader: object, tmp_path: Path) -> None:
    chosen = next(each for each in READERS if each is reader)
    if not chosen.suffixes or chosen.own:
        return
    path = tmp_path / f"a{chosen.suffixes[0]}"
    path.write_bytes(b"x")
    for name in set(FLAGS) - chosen.options:
        with pytest.raises(ConfigError, match=f"{FLAGS[name]} is an option of .*; not of a {chosen.name}"):
            import_recording(path, TX40, **{name: True})  # type: ignore[arg-type]
