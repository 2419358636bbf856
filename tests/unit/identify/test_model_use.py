"""Commands predict, compare and simulate: an identified model on recordings, beside another model, in closed loop."""

import csv
import json
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

import armident
from armident.configs import ConfigError, DataError
from armident.daq.cli import GROUP, application
from armident.daq.recording import write_recording
from armident.identify.documents.files import load_document, to_json
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.identification.saved_model import load_model
from armident.identify.monitoring.change.comparison import joint_of
from tests.fixtures.arms import FAST, recording
from tests.fixtures.diagnoses import SPRING

pytestmark = pytest.mark.slow

COMMANDS = {
    "predict": "armident.identify.cli:predict",
    "compare": "armident.identify.cli:compare",
    "simulate": "armident.simulate_command:simulate",
}


AT_REST = {
    "level": "unusable",
    "kind": "excitation",
    "joint": None,
    "message": "it stood still",
    "next_step": "move it",
}


def call(*words: str | Path) -> Result:
    """Run a command of this page as the command line does."""
    text = [str(word) for word in words]
    return CliRunner().invoke(application(text, [EntryPoint(n, v, GROUP) for n, v in COMMANDS.items()]), text)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of the healthy EMPS, one with a spring, and the models of the first and the second."""
    folder = tmp_path_factory.mktemp("models")
    for name, motion, seed, effects in (
        ("one", "emps_1", 1, ()),
        ("two", "emps_2", 2, ()),
        ("sprung", "emps_1", 3, (SPRING,)),
    ):
        write_recording(recording("emps", motion, seed, *effects, period=FAST), folder / f"{name}.mcap")
        armident.identify(folder / f"{name}.mcap", method="idim-iv").save(folder / name)
    return folder


def test_the_recording_of_the_identification_has_the_error_of_its_document(folder: Path) -> None:
    result = call("predict", folder / "one.mcap", "--model", folder / "one", "--json")
    found, own = json.loads(result.stdout), load_document(folder / "one/identification.json", IdentificationDocument)
    assert result.exit_code == 0
    assert found["relative_error_pct"] == pytest.approx(own.relative_error_pct, rel=1e-9)
    assert found["relative_error_pct_by_joint"] == pytest.approx(own.relative_error_pct_by_joint, rel=1e-9)
    assert found["held_out"] is False


def test_another_recording_is_held_out_and_predicted_nearly_as_well(folder: Path, tmp_path: Path) -> None:
    result = call("predict", folder / "two.mcap", "--model", folder / "one", "--out", tmp_path)
    assert result.exit_code == 0
    assert "held-out data" in result.stdout
    found = json.loads((tmp_path / "prediction.json").read_text())
    assert found["held_out"] is True
    # The model is that of the plant: only noise remains.
    assert found["relative_error_pct"] < 1.5 * found["identification_error_pct"]
    with (tmp_path / "torques.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    (name,) = found["units"]
    error = np.array([float(row[f"{name}_measured"]) - float(row[f"{name}_predicted"]) for row in rows])
    assert len(rows) == found["samples"]
    assert np.sqrt(np.mean(error**2)) == pytest.approx(found["error_rms"][name], rel=1e-6)
    assert "held-out data" in (tmp_path / "report.html").read_text()


def test_several_recordings_are_predicted_and_the_worst_is_named(folder: Path, tmp_path: Path) -> None:
    files = [folder / f"{name}.mcap" for name in ("one", "two", "sprung")]
    result = call("predict", *files, "--model", folder / "one", "--out", tmp_path, "--json")
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert found == json.loads((tmp_path / "predictions.json").read_text())
    assert found["worst_recording"] == str(files[2])
    errors = [each["relative_error_pct"] for each in found["predictions"]]
    assert found["worst_error_pct"] == max(errors) == errors[2]
    assert [each["held_out"] for each in found["predictions"]] == [False, True, True]
    for each, file in zip(found["predictions"], files, strict=True):
        assert json.loads((tmp_path / file.stem / "prediction.json").read_text()) == each
    shown = call("predict", *files[:2], "--model", folder / "one", "--out", tmp_path)
    assert f"Worst torque error {max(errors[:2]):.2f} %" in shown.stdout
    assert "…" not in shown.stdout
    twice = call("predict", files[0], files[0], "--model", folder / "one", "--out", tmp_path)
    assert twice.exit_code == 2
    assert twice.stderr.count("\n") == 1


def test_one_worthless_prediction_of_several_ends_with_exit_code_4(folder: Path, tmp_path: Path) -> None:
    document = load_document(folder / "one/identification.json", IdentificationDocument)
    parameters = [p.model_copy(update={"value": -p.value}) for p in document.parameters]
    (tmp_path / "wrong.json").write_text(to_json(document.model_copy(update={"parameters": parameters})))
    files = [folder / "one.mcap", folder / "two.mcap"]
    result = call("predict", *files, "--model", tmp_path / "wrong.json", "--out", tmp_path)
    assert result.exit_code == 4
    assert "explains the torques of a recording no better than none" in result.stdout


def test_a_model_without_the_spring_is_worse_on_a_recording_with_one(folder: Path, tmp_path: Path) -> None:
    healthy, sprung = (
        json.loads(
            call("predict", folder / "sprung.mcap", "--model", folder / name, "--json", "--out", tmp_path).stdout
        )
        for name in ("one", "sprung")
    )
    assert healthy["relative_error_pct"] > 1.05 * sprung["relative_error_pct"]


def test_a_model_that_explains_nothing_ends_with_exit_code_4(folder: Path, tmp_path: Path) -> None:
    document = load_document(folder / "one/identification.json", IdentificationDocument)
    wrong = [p.model_copy(update={"value": -p.value}) for p in document.parameters]
    (tmp_path / "wrong.json").write_text(to_json(document.model_copy(update={"parameters": wrong})))
    result = call("predict", folder / "two.mcap", "--model", tmp_path / "wrong.json", "--out", tmp_path)
    assert result.exit_code == 4
    assert "no better than none" in result.stdout


def test_a_motion_beyond_the_identified_range_is_a_warning(folder: Path, tmp_path: Path) -> None:
    document = load_document(folder / "one/identification.json", IdentificationDocument)
    assert document.residual_statistics is not None
    narrow = [s.model_copy(update={"position_range": (0.0, 0.01)}) for s in document.residual_statistics]
    (tmp_path / "narrow.json").write_text(to_json(document.model_copy(update={"residual_statistics": narrow})))
    result = call("predict", folder / "two.mcap", "--model", tmp_path / "narrow.json", "--out", tmp_path)
    assert "the model was identified over [0, 0.01] m" in result.stderr


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"verdict": "unusable", "reasons": [AT_REST]}, (DataError, "it stood still. Next: move it")),
        ({"configuration": None}, (ConfigError, "add --config ROBOT")),
        ({"robot": "other"}, (DataError, "of robot 'other'")),
    ],
)
def test_a_model_that_cannot_be_used_is_refused_in_one_line(
    folder: Path, tmp_path: Path, change: dict[str, object], expected: tuple[type[Exception], str]
) -> None:
    content = json.loads((folder / "one/identification.json").read_text()) | change
    (tmp_path / "identification.json").write_text(json.dumps(content))
    with pytest.raises(expected[0], match=expected[1]):
        load_model(tmp_path)


@pytest.mark.parametrize("words", [("predict", "two.mcap", "--model", "one"), ("compare", "one", "two")])
def test_results_that_cannot_be_written_are_one_line(folder: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    (tmp_path / "file").write_text("")
    given = [word if word in ("predict", "compare", "--model") else folder / word for word in words]
    result = call(*given, "--out", tmp_path / "file")
    assert result.exit_code == 2
    assert "file: cannot be written: " in result.stderr


def test_a_recording_is_no_model(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"no identified parameters: run `armident identify .*one\.mcap"):
        load_model(folder / "one.mcap")


def test_a_configuration_is_no_model(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no identified parameters: run `armident identify RECORDING"):
        load_model(tmp_path / "model.yaml")


def test_a_diagnosed_model_is_identified_from_the_recordings_of_the_diagnosis(folder: Path, tmp_path: Path) -> None:
    armident.diagnose(folder / "sprung.mcap").save(tmp_path)
    result = call("predict", folder / "sprung.mcap", "--model", tmp_path, "--json", "--out", tmp_path / "prediction")
    rigid = json.loads(call("predict", folder / "sprung.mcap", "--model", folder / "sprung", "--json").stdout)
    found = json.loads(result.stdout)
    assert found["relative_error_pct"] < rigid["relative_error_pct"]
    assert found["held_out"] is False
    (folder / "sprung.mcap").rename(folder / "moved.mcap")
    try:
        with pytest.raises(DataError, match=r"is not here: run `armident identify` on it with --config .*model\.yaml"):
            load_model(tmp_path)
    finally:
        (folder / "moved.mcap").rename(folder / "sprung.mcap")


def test_two_models_of_an_unchanged_arm_do_not_differ(folder: Path, tmp_path: Path) -> None:
    result = call("compare", folder / "one", folder / "two", "--out", tmp_path, "--json")
    found = json.loads(result.stdout)
    assert result.exit_code == 0
    assert found["verdict"] == "unchanged"
    assert {p["joint"] for p in found["parameters"]} == {"joint_1"}
    assert json.loads((tmp_path / "comparison.json").read_text()) == found


def test_a_changed_parameter_is_named_with_exit_code_4(folder: Path, tmp_path: Path) -> None:
    document = load_document(folder / "two/identification.json", IdentificationDocument)
    (first, *rest) = document.parameters
    changed = [first.model_copy(update={"value": first.value + 10 * first.std}), *rest]
    (tmp_path / "two.json").write_text(to_json(document.model_copy(update={"parameters": changed})))
    result = call("compare", folder / "one", tmp_path / "two.json", "--out", tmp_path)
    assert result.exit_code == 4
    # Ten standard deviations of the mass, said as what it is.
    assert re.search(rf"{document.robot} has changed: 0\.\d+ ± 0\.\d+ kg more on the link of joint_1", result.stdout)
    (line,) = [line for line in result.stdout.splitlines() if line.strip().startswith(f"{first.name} ")]
    assert "± " in line
    assert "changed, p < 1e-12" in line
    assert "…" not in result.stdout
    page = (tmp_path / "report.html").read_text()
    assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org", "")
    assert page.index("has changed") < page.index("<table>")
    assert page.index("armident diagnose") < page.index("<table>")
    (plot,) = json.loads(
        re.findall(r'<div class="plots"><script type="application/json">(.*?)</script>', page, re.DOTALL)[0]
    )
    assert plot["names"] == [p.name for p in document.parameters]
    marked = [series for series in plot["series"] if series["name"] == "now, changed"]
    assert [value is not None for value in marked[0]["y"]] == [True] + [False] * len(rest)
    assert plot["readings"][0].startswith(f"{first.name} (")
    assert plot["readings"][0].endswith(first.unit)


def test_models_with_other_parameters_are_refused_or_compared_on_the_common_ones(folder: Path, tmp_path: Path) -> None:
    document = load_document(folder / "two/identification.json", IdentificationDocument)
    (*kept, last) = document.parameters
    more = last.model_copy(update={"name": "stiffness1"})
    (tmp_path / "two.json").write_text(to_json(document.model_copy(update={"parameters": [*kept, more]})))
    refused = call("compare", folder / "one", tmp_path / "two.json", "--out", tmp_path)
    assert refused.exit_code == 3
    assert "--common" in refused.stderr
    common = call("compare", folder / "one", tmp_path / "two.json", "--common", "--json", "--out", tmp_path)
    found = json.loads(common.stdout)
    assert common.exit_code == 0
    assert found["left_out"] == sorted([last.name, "stiffness1"])
    assert [p["name"] for p in found["parameters"]] == [p.name for p in kept]
    assert "without" in found["warnings"][0]


def test_an_effect_of_another_shape_is_another_parameter(folder: Path, tmp_path: Path) -> None:
    robot = armident.load_robot("emps")
    for name, velocity in (("one", 0.02), ("two", 0.04)):
        stribeck = {"effect": "stribeck_friction", "joint": "joint_1", "parameters": {"velocity": velocity}}
        shaped = type(robot).model_validate({**robot.model_dump(by_alias=True), "effects": [stribeck]})
        armident.identify(folder / f"{name}.mcap", shaped, method="idim-ls").save(tmp_path / name)
    refused = call("compare", tmp_path / "one", tmp_path / "two")
    assert refused.exit_code == 3
    assert "(fst1)" in refused.stderr
    found = call("compare", tmp_path / "one", tmp_path / "two", "--common", "--json")
    assert json.loads(found.stdout)["left_out"] == ["fst1"]


def differences(folder: Path, tmp_path: Path, **changes: object) -> list[str]:
    """Return the warnings of differences between the first model and the second one after changes of its document."""
    document = load_document(folder / "two/identification.json", IdentificationDocument)
    (tmp_path / "two.json").write_text(to_json(document.model_copy(update=changes)))
    result = call("compare", folder / "one", tmp_path / "two.json", "--json", "--out", tmp_path / "out")
    return [line for line in json.loads(result.stdout)["warnings"] if "different" in line]


def test_two_models_of_one_kind_carry_no_warning_of_a_difference(folder: Path, tmp_path: Path) -> None:
    assert differences(folder, tmp_path) == []


def test_another_smoothing_of_friction_is_a_warning_if_it_shifts_the_friction(folder: Path, tmp_path: Path) -> None:
    own = load_document(folder / "two/identification.json", IdentificationDocument).sign_smoothing
    assert own is not None
    # Coulomb friction of the EMPS is known to a percent: a sign thirty times as wide is far beyond.
    (line,) = differences(folder, tmp_path, sign_smoothing={"joint_1": own["joint_1"] / 30})
    assert "different friction.sign_smoothing: joint_1" in line
    assert differences(folder, tmp_path, sign_smoothing={"joint_1": 1.001 * own["joint_1"]}) == []


def test_other_effects_and_another_structure_are_warnings(folder: Path, tmp_path: Path) -> None:
    document = load_document(folder / "two/identification.json", IdentificationDocument)
    assert document.configuration is not None
    (joint,) = document.configuration["joints"]
    changed = {
        "gravity": [0.0, 0.0, 9.81],
        "joints": [{**joint, "drive": {**joint["drive"], "gain": 2 * joint["drive"]["gain"]}}],
        "effects": [{"effect": "drive_gain_error", "joint": "joint_1", "parameters": {"gain_error": 0.1}}],
    }
    found = differences(folder, tmp_path, configuration={**document.configuration, **changed})
    assert len(found) == 2
    assert "different effects: drive_gain_error of joint_1" in found[0]
    assert "only in the later model" in found[0]
    assert "(gravity, joints.joint_1.drive.gain)" in found[1]


def test_models_of_one_recording_carry_a_warning(folder: Path, tmp_path: Path) -> None:
    result = call("compare", folder / "one", folder / "one", "--out", tmp_path, "--json")
    assert any("same recording" in line for line in json.loads(result.stdout)["warnings"])


@pytest.mark.parametrize(
    ("name", "joint"), [("zz1r", "shoulder"), ("fva2_2", "elbow"), ("iam6", "m6"), ("off2", "elbow"), ("k12", "k12")]
)
def test_parameters_belong_to_the_joint_of_their_number(name: str, joint: str) -> None:
    assert joint_of(name, ["shoulder", "elbow"], ["m6"]) == joint


def test_a_simulated_model_is_identified_again(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "again.mcap"
    assert call("simulate", "--model", folder / "one", "--trajectory", "emps_2.yaml", "--out", out).exit_code == 0
    model, again = load_model(folder / "one"), armident.identify(out, method="idim-ls", derivatives="irwsm")
    assert again.names == tuple(p.name for p in model.document.parameters)
    # Without noise, only the filters of the derivatives differ; fc and off of the EMPS exceed the tolerance by far.
    assert again.theta == pytest.approx(model.theta, rel=0.01, abs=0.01 * np.abs(model.theta).min())
    assert again.relative_error_pct < 1.0


def test_the_virtual_arm_takes_the_masses_of_a_model(folder: Path, tmp_path: Path) -> None:
    armident.identify(folder / "one.mcap", method="idim-ls", physical=True).save(tmp_path / "model")
    words = ("simulate", "--model", str(tmp_path / "model"), "--trajectory", "emps_2.yaml", "--rate", "1000")
    for physics, more in (("virtual", ("--noise", "0")), ("identified", ())):
        out = tmp_path / f"{physics}.mcap"
        assert call(*words, "--physics", physics, "--out", out, *more).exit_code == 0
    virtual, identified = (
        armident.identify(tmp_path / f"{physics}.mcap", method="idim-ls", derivatives="irwsm").theta
        for physics in ("virtual", "identified")
    )
    # The same parameters in two engines and two control loops.
    assert virtual == pytest.approx(identified, rel=0.05)


def test_the_virtual_arm_is_simulated_with_its_hidden_effect(tmp_path: Path) -> None:
    words = ["simulate", "--config", "emps.yaml", "--trajectory", "emps_1.yaml", "--seed", "3"]
    assert call(*words, "--out", tmp_path / "a.npz").exit_code == 0
    assert call(*words, "--scenario", "emps_dry_screw.yaml", "--out", tmp_path / "b.npz").exit_code == 0
    healthy, dry = np.load(tmp_path / "a.npz"), np.load(tmp_path / "b.npz")
    assert set(healthy) >= {"t", "q1", "tau1", "qr1"}
    assert healthy["t"].shape == healthy["q1"].shape
    assert np.std(dry["tau1"]) > np.std(healthy["tau1"])


@pytest.mark.parametrize("kind", ["mcap", "npz"])
def test_a_simulation_prints_its_document_and_nothing_else(kind: str, tmp_path: Path) -> None:
    out = tmp_path / f"a.{kind}"
    words = ["simulate", "--config", "emps.yaml", "--trajectory", "emps_1.yaml", "--rate", "1000", "--json"]
    result = call(*words, "--out", out)
    assert result.exit_code == 0
    found = json.loads(result.stdout)
    assert (found["robot"], found["physics"], found["seed"], found["noise"]) == ("emps", "virtual", 0, 1.0)
    assert found["recording"]["path"] == str(out)
    assert found["duration_s"] == pytest.approx((found["recording"]["samples"] - 1) / 1000)
    if kind == "mcap":
        assert armident.read_recording(out).sha256 == found["recording"]["sha256"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--out", "x.csv", "--config", "emps.yaml"], "ends in .mcap or .npz"),
        (["--out", "x.npz"], "--config: give the robot"),
        (["--out", "x.npz", "--model", "m.json", "--seed", "1"], "belong to --physics virtual"),
        (["--out", "x.npz", "--config", "emps.yaml", "--physics", "identified"], "by --model"),
        (["--out", "x.npz", "--config", "emps.yaml", "--trajectory", "tx40_1.yaml"], "emps"),
    ],
)
def test_contradictory_options_of_a_simulation_are_one_line(
    words: list[str], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = words if "--trajectory" in words else [*words, "--trajectory", "emps_1.yaml"]
    result = call("simulate", *given)
    assert result.exit_code == 2
    assert expected in result.stderr
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "x.npz").exists()


def test_the_measured_emps_is_predicted_with_the_published_errors(shared_data: Path) -> None:
    """Janot, Gautier, Brunot 2019: the fit has an error of 4.0834 %, and of 5.9824 % on the recording with pulses."""
    files = [shared_data / "emps" / name for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")]
    if not all(file.is_file() for file in files):
        pytest.skip("no recordings of the EMPS in the measured data")
    seen, pulses = (armident.import_recording(file, "emps") for file in files)
    found = armident.predict(pulses, armident.identify(seen, method="idim-ls")).document
    assert found.held_out
    assert round(found.identification_error_pct, 4) == 4.0834
    assert round(found.relative_error_pct, 4) == 5.9824
