"""``import armident``: quick to import, complete, and its results print, show themselves and convert."""

import ast
import doctest
import importlib.metadata
import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import assert_type

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

import armident
from armident.daq.cli import application
from armident.daq.recording import write_recording
from tests.fixtures import arms

REPOSITORY = Path(__file__).resolve().parents[2]
DIAGNOSE = "armident.identify.api.diagnosis_api.diagnose"


@pytest.fixture(scope="module")
def axis() -> armident.Identification:
    found = armident.identify(arms.recording("emps", "emps_1", 1, period=arms.FAST), method="idim-ls")
    assert_type(found.theta, NDArray[np.float64])
    return found


def motion(samples: int = 1500) -> tuple[NDArray[np.float64], ...]:
    """Times, positions, torques and reference of an axis, (N,) each, within the limits of the EMPS."""
    t = np.arange(samples) / 1000.0
    return t, 0.1 * np.sin(5.0 * t), 40.0 * np.cos(5.0 * t), 0.1 * np.sin(5.0 * t + 0.01)


def test_arrays_are_the_recording_of_a_file_that_holds_them(tmp_path: Path) -> None:
    t, q, tau, reference = motion()
    made = armident.Recording.from_arrays(t, q, tau, "emps", reference)
    np.savez(tmp_path / "log.npz", t=t, q=q, tau=tau, qr=reference)
    imported = armident.import_recording(tmp_path / "log.npz", "emps")
    again = armident.read_recording(made.save(tmp_path / "run.mcap"))
    assert made.sha256 == imported.sha256 == again.sha256
    for other in (imported, again):
        assert (other.robot, other.sample_rate_hz, other.gaps) == (made.robot, made.sample_rate_hz, made.gaps)
        assert other.streams["samples"].fields == made.streams["samples"].fields
    np.testing.assert_array_equal(made.samples.si("torque")[:, 0], tau)


def test_arrays_with_uneven_times_name_the_next_step_and_can_be_resampled() -> None:
    t, q, tau, _ = motion()
    uneven = t + np.random.default_rng(1).normal(0.0, 1e-4, t.size)
    with pytest.raises(armident.DataError, match=r"jitter.*resample_hz=1000 puts the samples on an even clock"):
        armident.Recording.from_arrays(uneven, q, tau, "emps")
    assert armident.Recording.from_arrays(uneven, q, tau, "emps", resample_hz=1000.0).sample_rate_hz == 1000.0
    for wrong, message in (
        ((t, q[:-1], tau), r"position: an array of shape \(1499,\); expected \(1500, 1\)"),
        ((1000.0 * t, q, tau), "t has to be in s"),
        ((t[::-1], q, tau), "time does not increase"),
        ((t, 100.0 * q, tau), r"joint_1 reaches 10, its limit is 0\.3"),
    ):
        with pytest.raises(armident.DataError, match=message) as found:
            armident.Recording.from_arrays(*wrong, robot="emps")
        assert "--" not in str(found.value)


@pytest.mark.slow
def test_an_identification_read_back_stands_for_a_fresh_one(axis: armident.Identification, tmp_path: Path) -> None:
    axis.save(tmp_path)
    for path in (tmp_path, tmp_path / "identification.json"):
        again = armident.load_identification(path)
        assert (str(again), again.to_json(), again.verdict) == (str(axis), axis.to_json(), axis.verdict)
        np.testing.assert_array_equal(again.covariance, axis.covariance)
    assert "fv1" in again.report(tmp_path / "again.html").read_text()
    assert not armident.compare(axis, again)
    still = np.zeros((1, 1))
    np.testing.assert_array_equal(again.model.inverse_dynamics(still, still, still + 1.0), [[axis.theta[[0, 3]].sum()]])
    other = arms.recording("emps", "emps_2", 2, period=arms.FAST)
    errors = [armident.predict(other, model).relative_error_pct for model in (axis, again, again.model, tmp_path)]
    assert len(set(errors)) == 1
    assert errors[0] < 2 * axis.relative_error_pct


@pytest.mark.slow
def test_every_result_prints_and_writes_its_document_and_its_report(
    axis: armident.Identification, tmp_path: Path
) -> None:
    (recorded,) = axis.recordings
    checked = armident.check(recorded)
    for result in (axis, armident.predict(recorded, axis), armident.compare(axis, axis), checked):
        folder = tmp_path / type(result).__name__
        document, report, *_ = result.save(folder)
        assert json.loads(document.read_text()) == json.loads(result.to_json()) == result.to_dict()
        assert result.to_dict()["robot"] == "emps"
        assert report.read_text().startswith("<!DOCTYPE html>")
        assert str(result).splitlines()[0].startswith(("emps", "set-up: no mistake found"))
        assert result._repr_html_().startswith("<p>")
    assert checked.passed
    assert checked.findings == ()


def test_a_check_remarks_positions_outside_their_limits(axis: armident.Identification) -> None:
    robot = armident.load_robot("emps")
    joint = robot.joints[0]
    limits = joint.limits.model_copy(update={"position": (-0.01, 0.01)})
    narrow = robot.model_copy(update={"joints": (joint.model_copy(update={"limits": limits}),)})
    checked = armident.check(axis.recordings, narrow)
    assert "outside its limits [-0.01, 0.01]: wrong unit, order of joints, or limits?" in str(checked)


def test_a_check_remarks_that_a_recording_is_torn(axis: armident.Identification) -> None:
    torn = replace(axis.recordings[0], missing="the file was not finished")
    assert "remark: " in (words := str(armident.check(torn)))
    assert "the recording is torn: the file was not finished" in words


def test_a_model_without_parameters_says_where_they_come_from() -> None:
    with pytest.raises(ValueError, match=r"emps: .* give theta, or use result\.model"):
        armident.RobotModel("emps").mass_matrix([[0.0]])


def test_arguments_of_identify_replace_those_of_its_options() -> None:
    recording = arms.recording("emps", "emps_1", 1, period=arms.FAST)
    options = armident.Options(method="idim-iv", nvr="likelihood", bandwidth_hz=20.0)
    used = armident.identify(recording, method="idim-ls", options=options).document.options
    assert (used["method"], used["nvr"], used["bandwidth_hz"]) == ("idim-ls", "likelihood", 20.0)


def test_importing_armident_imports_nothing_heavy() -> None:
    code = (
        "import sys, armident; print([m for m in ('numpy', 'scipy', 'numba', 'pydantic', 'can') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_every_name_of_the_api_is_there_and_is_listed() -> None:
    for name in armident.__all__:
        assert getattr(armident, name) is not None
    assert {*armident.__all__, "__version__"} <= set(dir(armident))
    assert armident.__version__ == importlib.metadata.version("armident")
    assert all(name in (armident.__doc__ or "") for name in armident.__all__)


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'identfy'"):
        armident.identfy  # noqa: B018 - the access is the test


def test_type_checkers_see_every_name() -> None:
    """``make lint`` checks that the modules have these names; here, that none is left out."""
    (block,) = (node for node in ast.parse(Path(armident.__file__).read_text()).body if isinstance(node, ast.If))
    seen = {name.asname for node in block.body if isinstance(node, ast.ImportFrom) for name in node.names}
    assert ast.unparse(block.test) == "TYPE_CHECKING"
    # The package of this name is callable, see `armident.identify`.
    assert seen == set(armident.__all__)
    assert (Path(armident.__file__).parent / "py.typed").is_file()


def test_a_result_prints_and_shows_itself_in_a_notebook(axis: armident.Identification) -> None:
    essential = [p for p in axis.document.parameters if p.essential]
    assert str(axis).count("\n") == len(essential) + 1
    assert f"{axis.relative_error_pct:.2f} %" in str(axis)
    assert axis._repr_html_().count("<tr>") == len(essential) + 1


def test_parameters_are_found_by_name_and_by_column(axis: armident.Identification) -> None:
    table = axis.parameters
    assert table["fv1"].value == axis.theta[axis.names.index("fv1")]
    assert table["value"] == list(axis.theta)
    assert table["std"] == list(axis.std)
    assert table[0]["name"] == axis.names[0]
    with pytest.raises(KeyError, match="fv1"):
        table["fv"]


def test_tables_become_pandas_frames(axis: armident.Identification) -> None:
    pytest.importorskip("pandas")
    frame = axis.parameters.to_pandas()
    assert frame.loc["fv1", "value"] == axis.parameters["fv1"].value
    assert list(frame.index) == list(axis.names)


def test_a_file_gives_the_same_numbers_as_the_recording(axis: armident.Identification, tmp_path: Path) -> None:
    (recording,) = axis.recordings
    path = tmp_path / "run.mcap"
    write_recording(recording, path)
    assert np.array_equal(armident.identify(path, method="idim-ls").theta, axis.theta)


@pytest.mark.slow
def test_the_command_line_writes_what_the_api_returns(axis: armident.Identification, tmp_path: Path) -> None:
    (recording,) = axis.recordings
    path = tmp_path / "run.mcap"
    write_recording(recording, path)
    words = ["identify", str(path), "--method", "idim-ls", "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(application(words), words).exit_code == 0
    document = json.loads((tmp_path / "out" / "identification.json").read_text())
    assert [p["value"] for p in document["parameters"]] == list(axis.theta)


@pytest.mark.slow
def test_two_recordings_tell_more_than_one(axis: armident.Identification) -> None:
    second = arms.recording("emps", "emps_2", 2, period=arms.FAST)
    both = armident.identify([*axis.recordings, second], method="idim-ls")
    assert both.document.further_recordings is not None
    assert both.document.further_recordings[0].sha256 == second.sha256
    assert np.median(both.std / axis.std) < 0.9


@pytest.mark.slow
def test_results_are_saved_with_their_report(axis: armident.Identification, tmp_path: Path) -> None:
    document, report = axis.save(tmp_path / "result")
    assert json.loads(document.read_text())["robot"] == "emps"
    assert "fv1" in report.read_text()


@pytest.mark.slow
def test_an_unchanged_arm_compares_as_unchanged(axis: armident.Identification, tmp_path: Path) -> None:
    again = armident.identify(arms.recording("emps", "emps_1", 2, period=arms.FAST), method="idim-ls")
    folder = tmp_path / "baseline"
    axis.save(folder)
    test = armident.compare(folder, again)
    assert not test
    assert len(test.parameters) == len(axis.names)
    assert "has not changed" in str(test)


def test_a_model_gives_the_torques_of_its_regressor(axis: armident.Identification) -> None:
    model = armident.RobotModel("emps")
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 50, 1))
    torque = model.regressor(q, qd, qdd) @ axis.theta
    assert np.allclose(model.inverse_dynamics(q, qd, qdd, theta=axis.theta), torque, rtol=1e-9, atol=1e-9)


def test_a_model_with_an_effect_needs_the_sampling_period() -> None:
    robot = armident.load_robot("emps")
    effect = {"effect": "joint_spring", "joint": robot.joints[0].name, "parameters": {"stiffness": 10.0, "q0": 0.0}}
    spring = armident.effects()["joint_spring"]
    effect["parameters"] = {p.name: 1.0 for p in spring.linear}
    model = armident.RobotModel(type(robot).model_validate({**robot.model_dump(by_alias=True), "effects": [effect]}))
    q = np.linspace(0.0, 0.2, 20)[:, None]
    theta = np.ones(len(model.names))
    with pytest.raises(ValueError, match="sampling period"):
        model.inverse_dynamics(q, q, q, theta=theta)
    torque = model.regressor(q, q, q, dt=1e-3) @ theta
    assert np.allclose(model.inverse_dynamics(q, q, q, theta=theta, dt=1e-3), torque, rtol=1e-9)
    with pytest.raises(armident.ConfigError, match="simulate"):
        model.forward_dynamics(q, q, q, theta=theta)


def test_the_closed_loop_follows_its_reference(axis: armident.Identification) -> None:
    run = armident.RobotModel("emps").simulate("emps_excitation", theta=axis.theta, dt=1e-3)
    assert run.diverged_at is None
    reference = armident.design_trajectory("emps", evaluations=0).trajectory.sample(1e-3)
    again = armident.RobotModel("emps").simulate(reference, theta=axis.theta, dt=1e-3)
    assert np.abs(again.q - reference).max() < 0.1


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda: armident.identify([]), "no recording"),
        (lambda: armident.identify("nowhere.mcap"), "nowhere.mcap"),
        (lambda: armident.RobotModel("no_such_robot"), "no_such_robot"),
        (lambda: armident.compare("nowhere.json", "nowhere.json"), "nowhere.json: no such file"),
        (lambda: armident.design_trajectory("emps", effect="no_such_effect"), "no_such_effect"),
    ],
)
def test_a_mistake_is_one_clear_line(call: object, expected: str) -> None:
    assert callable(call)
    with pytest.raises(armident.ArmidentError, match=expected) as found:
        call()
    assert "\n" not in str(found.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    "module",
    [
        pytest.param("armident", marks=pytest.mark.nightly),
        "armident.configs.loading",
        "armident.daq.recording.model",
        pytest.param("armident.identify.api.comparison_api", marks=pytest.mark.nightly),
        "armident.identify.api.diagnosis_api",
        pytest.param("armident.identify.api.identification_api", marks=pytest.mark.nightly),
        "armident.identify.api.prediction_api",
        "armident.identify.api.setup_api",
        "armident.identify.api.trajectory_api",
        "armident.identify.identification.robot_model",
        "armident.virtual_robot.api",
        "armident.identify.robot.arm",
    ],
)
def test_the_examples_of_the_docstrings_run(module: str) -> None:
    __import__(module)
    examples = [e for e in doctest.DocTestFinder().find(sys.modules[module]) if e.examples and e.name != DIAGNOSE]
    assert examples
    assert [e.name for e in examples if doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(e).failed] == []


@pytest.mark.nightly
def test_the_example_of_a_diagnosis_runs() -> None:
    (example,) = doctest.DocTestFinder().find(armident.diagnose, DIAGNOSE)
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example) == (0, 4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("block", "least"), [(0, 8), pytest.param(1, 4, marks=pytest.mark.nightly)], ids=["an axis", "a diagnosis"]
)
def test_the_python_of_the_readme_runs(block: int, least: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall("```python\n(.*?)```", (REPOSITORY / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    example = doctest.DocTestParser().get_doctest(blocks[block], {"armident": armident}, "README.md", None, None)
    failed, tried = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example)
    assert tried >= least
    assert failed == 0
