"""``import armident``: quick to import, complete, and its results print, show themselves and convert."""

import doctest
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import armident
from armident.daq.recording import write_recording
from tests.fixtures import arms

REPOSITORY = Path(__file__).resolve().parents[2]
DIAGNOSE = "armident.identify.api.diagnosis.diagnose"


@pytest.fixture(scope="module")
def recording() -> armident.Recording:
    return arms.recording("tx40", "tx40_excitation", 1)


@pytest.fixture(scope="module")
def result(recording: armident.Recording) -> armident.Identification:
    return armident.identify(recording, method="idim-ls")


def test_importing_armident_imports_nothing_heavy() -> None:
    code = (
        "import sys, armident; print([m for m in ('numpy', 'scipy', 'numba', 'pydantic', 'can') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"


def test_every_name_of_the_api_is_there_and_is_listed() -> None:
    for name in armident.__all__:
        assert getattr(armident, name) is not None
    assert set(armident.__all__) <= set(dir(armident))


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'identfy'"):
        armident.identfy  # noqa: B018 - the access is the test


@pytest.mark.slow
def test_type_checkers_see_every_name(tmp_path: Path) -> None:
    names = ", ".join(f"armident.{name}" for name in armident.__all__)
    (tmp_path / "uses.py").write_text(
        f"import armident\n\nnames = [{names}]\nresult = armident.identify('x.mcap')\nreveal_type(result.theta)\n"
    )
    # The options of `make lint`, whose cache would not serve for others.
    command = [sys.executable, "-m", "mypy", "--no-error-summary"]
    done = subprocess.run(
        [*command, str(tmp_path / "uses.py")], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert "numpy.ndarray" in done.stdout, done.stdout
    assert "error" not in done.stdout, done.stdout


def test_a_result_prints_and_shows_itself_in_a_notebook(result: armident.Identification) -> None:
    essential = [p for p in result.document.parameters if p.essential]
    assert str(result).count("\n") == len(essential) + 1
    assert f"{result.relative_error_pct:.2f} %" in str(result)
    assert result._repr_html_().count("<tr>") == len(essential) + 1


def test_parameters_are_found_by_name_and_by_column(result: armident.Identification) -> None:
    table = result.parameters
    assert table["zz1r"].value == result.theta[result.names.index("zz1r")]
    assert table["value"] == list(result.theta)
    assert table["std"] == list(result.std)
    assert table[0]["name"] == result.names[0]
    with pytest.raises(KeyError, match="zz1r"):
        table["zz1"]


def test_tables_become_pandas_frames(result: armident.Identification) -> None:
    pytest.importorskip("pandas")
    frame = result.parameters.to_pandas()
    assert frame.loc["zz1r", "value"] == result.parameters["zz1r"].value
    assert list(frame.index) == list(result.names)


def test_a_file_gives_the_same_numbers_as_the_recording(
    recording: armident.Recording, result: armident.Identification, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    write_recording(recording, path)
    assert np.array_equal(armident.identify(path, method="idim-ls").theta, result.theta)


@pytest.mark.slow
def test_the_command_line_writes_what_the_api_returns(tmp_path: Path) -> None:
    recording = arms.recording("emps", "emps_excitation", 1)
    result = armident.identify(recording, method="idim-ls")
    path = tmp_path / "run.mcap"
    write_recording(recording, path)
    command = [sys.executable, "-m", "armident.daq.cli", "identify", str(path), "--method", "idim-ls"]
    subprocess.run([*command, "--out", str(tmp_path / "out")], check=True, capture_output=True, timeout=240)
    document = json.loads((tmp_path / "out" / "identification.json").read_text())
    assert [p["value"] for p in document["parameters"]] == list(result.theta)


@pytest.mark.slow
def test_two_recordings_tell_more_than_one(recording: armident.Recording, result: armident.Identification) -> None:
    second = armident.simulate_recording("tx40", "tx40_1", seed=2)
    both = armident.identify([recording, second], method="idim-ls")
    assert both.document.further_recordings is not None
    assert both.document.further_recordings[0].sha256 == second.sha256
    assert np.median(both.std / result.std) < 0.9


@pytest.mark.slow
def test_results_are_saved_with_their_report(result: armident.Identification, tmp_path: Path) -> None:
    document, report = result.save(tmp_path / "result")
    assert json.loads(document.read_text())["robot"] == "tx40"
    assert "zz1r" in report.read_text()


@pytest.mark.slow
def test_an_unchanged_arm_compares_as_unchanged(result: armident.Identification, tmp_path: Path) -> None:
    again = armident.identify(arms.recording("tx40", "tx40_excitation", 2), method="idim-ls")
    folder = tmp_path / "baseline"
    result.save(folder)
    test = armident.compare(folder, again)
    assert not test
    assert len(test.parameters) == len(result.names)
    assert "no change" in str(test)


def test_a_model_gives_the_torques_of_its_regressor(result: armident.Identification) -> None:
    model = armident.RobotModel("tx40")
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 50, 6))
    torque = model.regressor(q, qd, qdd) @ result.theta
    assert np.allclose(model.inverse_dynamics(result.theta, q, qd, qdd), torque, rtol=1e-9, atol=1e-9)


def test_a_model_with_an_effect_needs_the_sampling_period() -> None:
    robot = armident.load_robot("emps")
    effect = {"effect": "joint_spring", "joint": robot.joints[0].name, "parameters": {"stiffness": 10.0, "q0": 0.0}}
    spring = armident.effects()["joint_spring"]
    effect["parameters"] = {p.name: 1.0 for p in spring.linear}
    model = armident.RobotModel(type(robot).model_validate({**robot.model_dump(by_alias=True), "effects": [effect]}))
    q = np.linspace(0.0, 0.2, 20)[:, None]
    theta = np.ones(len(model.names))
    with pytest.raises(ValueError, match="sampling period"):
        model.inverse_dynamics(theta, q, q, q)
    torque = model.regressor(q, q, q, dt=1e-3) @ theta
    assert np.allclose(model.inverse_dynamics(theta, q, q, q, dt=1e-3), torque, rtol=1e-9)
    with pytest.raises(armident.ConfigError, match="simulate"):
        model.forward_dynamics(theta, q, q, q)


def test_the_closed_loop_follows_its_reference(result: armident.Identification) -> None:
    run = armident.RobotModel("tx40").simulate(result.theta, "tx40_excitation", dt=1e-3)
    assert run.diverged_at is None
    reference = armident.design_trajectory("tx40", evaluations=0).trajectory.sample(1e-3)
    again = armident.RobotModel("tx40").simulate(result.theta, reference, dt=1e-3)
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
        "armident",
        "armident.identify.api.comparison",
        "armident.identify.api.diagnosis",
        "armident.identify.api.identification",
        "armident.identify.api.prediction",
        "armident.identify.api.trajectory",
        "armident.identify.robot_model",
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
    """The Python of the README has the same calls for another seed."""
    (example,) = doctest.DocTestFinder().find(armident.diagnose, DIAGNOSE)
    assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example) == (0, 4)


@pytest.mark.slow
def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testfile(str(REPOSITORY / "README.md"), module_relative=False, optionflags=doctest.ELLIPSIS)
    assert tried >= 8  # the ten lines at the top
    assert failed == 0
