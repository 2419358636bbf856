"""``armident init``: robot and session from a URDF and a recording, and configurations with blanks."""

import re
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner, Result

import armident
from armident.configs import ConfigError, config_path, load_robot, load_session
from armident.configs.blanks import MARK, pattern
from armident.daq.cli import GROUP, application
from armident.daq.init.initialize import InitOptions, run_init
from armident.daq.init.questionnaire import questionnaire
from armident.daq.interchange.exporting import export_recording
from armident.daq.recording import read_recording, write_recording
from armident.virtual_robot.twin import load_twin
from tests.fixtures import arms
from tests.unit.configs.test_urdf import transform

COMMANDS = {
    "doctor": "armident.daq.commands:doctor",
    "init": "armident.daq.init.init_command:init",
    "import": "armident.daq.commands:import_",
    "identify": "armident.identify.cli:identify",
    "trajectory": "armident.identify.cli:trajectory",
}


def run(*words: str) -> Result:
    app = application(words, [EntryPoint(name, value, GROUP) for name, value in COMMANDS.items()])
    return CliRunner().invoke(app, list(words))


def urdf_of(robot: str, names: list[str], file: Path, limits: bool = True) -> Path:
    """Write the geometry of a shipped robot as a URDF, each joint behind a fixed one; joints may have no limits."""
    parts = ['<link name="l0"/>']
    for k, joint in enumerate(load_robot(robot).joints):
        m, low_high = joint.mdh, joint.limits.position
        limit = (
            f'<limit lower="{low_high[0]}" upper="{low_high[1]}" velocity="{joint.limits.velocity}" '
            f'effort="{joint.limits.torque}"/>'
        )
        parts += [
            f'<link name="s{k}"/><joint name="f{k}" type="fixed"><parent link="l{k}"/><child link="s{k}"/>'
            f'<origin rpy="{m.alpha} 0 0" xyz="{m.d} 0 0"/></joint>',
            f'<link name="l{k + 1}"/><joint name="{names[k]}" type="revolute"><parent link="s{k}"/>'
            f'<child link="l{k + 1}"/><origin rpy="0 0 {m.theta}" xyz="0 0 {m.r}"/><axis xyz="0 0 1"/>'
            f"{limit if limits else ''}</joint>",
        ]
    file.write_text(f'<robot name="My Arm">{"".join(parts)}</robot>')
    return file


AXES = [f"axis-{k}" for k in range(1, 7)]


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    return urdf_of("tx40", AXES, tmp_path / "arm.urdf")


def table(path: Path, *, rate: float = 500.0, unit: float = 1.0, time: float = 1.0, effort: str = "tau") -> Path:
    """Write a motion of 4 s of the arm in other units; torques are a tenth of the limits."""
    robot = load_robot("tx40")
    t = np.arange(round(4 * rate)) / rate
    phase = np.arange(6)
    q = 0.6 * np.sin(2 * np.pi * t[:, None] + phase)
    tau = 0.1 * np.array([joint.limits.torque for joint in robot.joints]) * np.cos(2 * np.pi * t[:, None] + phase)
    names = ["t", *(f"q{k}" for k in range(1, 7)), *(f"{effort}{k}" for k in range(1, 7))]
    values = np.column_stack([t / time, q / unit, tau])
    path.write_text("\n".join([",".join(names), *(",".join(f"{x:.9g}" for x in row) for row in values)]) + "\n")
    return path


@pytest.mark.slow
@pytest.mark.nightly
def test_urdf_and_csv_become_a_model_without_an_edit(tmp_path: Path, arm: Path) -> None:
    recorded = arms.recording("tx40", "tx40_excitation", 1, period=arms.FAST)
    named = zip(recorded.robot.joints, AXES, strict=True)
    joints = tuple(joint.model_copy(update={"source_name": axis}) for joint, axis in named)
    recorded = replace(recorded, robot=recorded.robot.model_copy(update={"joints": joints}))
    export_recording(recorded, tmp_path / "data.csv")
    made = run("init", str(arm), "--recording", str(tmp_path / "data.csv"), "--out", str(tmp_path / "cell"))
    assert made.exit_code == 0, made.output
    assert "1000 Hz, 8.1" in made.output
    assert " s, torques, with demand" in made.output
    lines = [line.strip() for line in made.output.splitlines()]
    commands = [line.split()[1:] for line in lines[lines.index("next:") + 1 :]]
    assert [words[0] for words in commands] == ["import", "check", "identify"]
    assert run(*commands[0]).exit_code == 0
    found = run(*commands[2], "--method", "idim-ls", "--json", "--out", str(tmp_path / "model"))
    document = yaml.safe_load(found.stdout)
    expected = arms.identified("tx40", "tx40_excitation", 1, "idim-ls", checked=False).document
    values = {p["name"]: p["value"] for p in document["parameters"]}
    # The same arm, without its coupling of joints 5 and 6, at a fifth of the rate: joint 2 is not affected. Its dry
    # friction is: the width of its sign is estimated here, and configured there.
    for name, tolerance in (("mx2r", 0.02), ("fc2", 0.05), ("fv2", 0.02)):
        known = next(p.value for p in expected.parameters if p.name == name)
        assert values[name] == pytest.approx(known, rel=tolerance)


def test_limits_of_the_urdf_stay_and_the_acceleration_is_that_reached(tmp_path: Path, arm: Path) -> None:
    made = run("init", str(arm), "--recording", str(table(tmp_path / "d.csv")), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    tx40 = load_robot("tx40")
    for joint, known in zip(load_robot(tmp_path / "robot.yaml", "trajectory").joints, tx40.joints, strict=True):
        assert joint.limits.position == pytest.approx(known.limits.position)
        assert joint.limits.torque == known.limits.torque
        assert joint.limits.acceleration == pytest.approx(0.6 * (2 * np.pi) ** 2, rel=0.02)


def test_limits_that_the_recording_passes_are_those_reached_and_said_with_their_line(tmp_path: Path) -> None:
    low = urdf_of("tx40", AXES, tmp_path / "low.urdf")
    lines = low.read_text().replace("<joint", "\n<joint").replace("<limit", "\n<limit").splitlines()
    number = next(k for k, line in enumerate(lines) if line.startswith("<limit"))
    lines[number] = re.sub(r'effort="[^"]*"', 'effort="3"', lines[number])
    low.write_text("\n".join(lines))
    made = run("init", str(low), "--recording", str(table(tmp_path / "d.csv")), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert f"3 N m, reached 9 (low.urdf, line {number + 1})" in made.output
    written = load_robot(tmp_path / "robot.yaml", "trajectory").joints
    assert written[0].limits.torque == pytest.approx(9.0, rel=0.01)
    assert written[1].limits.torque == load_robot("tx40").joints[1].limits.torque


def test_other_limits_are_blank_with_what_was_reached_beside_them(tmp_path: Path) -> None:
    bare, path = urdf_of("tx40", AXES, tmp_path / "bare.urdf", limits=False), table(tmp_path / "d.csv")
    header, *rows = [line.split(",") for line in path.read_text().splitlines()]
    resting = [[*row[:6], "0.5", *row[7:]] for row in rows]
    path.write_text("\n".join(",".join(row) for row in [header, *resting]))
    made = run("init", str(bare), "--recording", str(path), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    of_all = "joints[].limits.{} of all joints, for trajectory"
    assert all(of_all.format(key) in made.output for key in ("position", "velocity", "torque"))
    assert "joints[].limits.acceleration of axis-6, for trajectory" in made.output
    assert "in d.csv: -0.6 to 0.6 rad, 3.77 rad/s, 23.5 rad/s^2, 11 N m" in (tmp_path / "robot.yaml").read_text()


@pytest.mark.parametrize(
    ("unit", "time", "options"),
    [
        (1.0, 1.0, ""),
        (np.pi / 180, 1.0, " --units position=deg"),
        (1.0, 1e-3, " --time-unit ms"),
        (np.pi / 180, 1e-6, " --units position=deg --time-unit us"),
    ],
)
def test_units_are_found_by_magnitude_and_the_import_gets_them(
    tmp_path: Path, arm: Path, unit: float, time: float, options: str
) -> None:
    path = table(tmp_path / "d.csv", unit=unit, time=time)
    made = run("init", str(arm), "--recording", str(path), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    command = next(line.split()[1:] for line in made.output.splitlines() if line.startswith("  armident import"))
    assert f"robot.yaml{options} --out" in " ".join(command)
    assert run(*command).exit_code == 0
    q = read_recording(tmp_path / "d.mcap").samples.si("position")
    assert np.abs(q).max() == pytest.approx(0.6, rel=1e-3)
    assert load_session(tmp_path / "session.yaml", "").sync.period_us == 2000


def test_jittering_times_are_resampled(tmp_path: Path, arm: Path) -> None:
    path = table(tmp_path / "d.csv")
    rng = np.random.default_rng(0)
    lines = path.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    late = [f"{float(row[0]) + rng.uniform(0, 8e-4):.6f}" for row in rows]
    path.write_text("\n".join([lines[0], *(",".join([t, *row[1:]]) for t, row in zip(late, rows, strict=True))]) + "\n")
    made = run("init", str(arm), "--recording", str(path), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert " --resample 500 " in made.output


def test_every_blank_is_listed_once_and_asked_for_when_needed(tmp_path: Path, arm: Path) -> None:
    path = table(tmp_path / "d.csv", effort="current")
    made = run("init", str(arm), "--recording", str(path), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    for key in ("joints[].drive.gain", "joints[].drive.rated", "drives[].node_id", "drives[].eds", "bus.bitrate"):
        assert made.output.count(f": {key}") == 1
    assert "joints[].drive.gain of all joints, for identify, capture, robot" in made.output
    imported = run("import", str(path), "--config", str(tmp_path / "robot.yaml"), "--out", str(tmp_path / "d.mcap"))
    assert imported.exit_code == 0, imported.output
    # The recording has the blanks of its robot, and the configuration has them, too.
    for config in ([], ["--config", str(tmp_path / "robot.yaml")]):
        refused = run("identify", str(tmp_path / "d.mcap"), *config)
        assert refused.exit_code == 2
        assert "drive.gain of axis-1, axis-2, axis-3, axis-4, axis-5, axis-6 (torque constant" in refused.stderr
        assert "rated" not in refused.stderr
    with pytest.raises(ConfigError, match=r"drives\[\]\.node_id of axis_1.*joints\[\]\.drive\.counts_per_unit"):
        load_session(tmp_path / "session.yaml", "capture")
    assert load_session(tmp_path / "session.yaml", "command").cell == "my_arm_cell"
    with pytest.raises(ConfigError, match=r"bus\.bitrate"):
        load_session(tmp_path / "session.yaml")


def test_a_filled_in_configuration_has_no_blanks(tmp_path: Path, arm: Path) -> None:
    cell = ["--channel", "can0", "--bitrate", "1000000", "--node-ids", "1,2,3,4,5,6", "--eds", "eds/cia402_servo.eds"]
    path = table(tmp_path / "d.csv")
    assert run("init", str(arm), "--recording", str(path), "--out", str(tmp_path), *cell).exit_code == 0
    file = tmp_path / "robot.yaml"
    text = file.read_text().replace(f"rated: {MARK}", "rated: 2.0").replace(f"unit: {MARK}", "unit: 65536")
    file.write_text(text)
    session = load_session(tmp_path / "session.yaml", "capture")
    assert session.blanks == ()
    assert "blanks" not in session.model_dump()
    assert load_robot(file).joints[0].drive.counts_per_unit == 65536


def test_a_data_sheet_is_found_from_the_working_directory_and_a_missing_one_leaves_no_files(
    tmp_path: Path, arm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["init", str(arm), "--eds", "drive.eds", "--out", "cell"]
    missing = run(*words)
    assert missing.exit_code == 2
    assert "drive.eds: no such file (shipped with armident: cia402_servo.eds" in missing.output
    assert not Path("cell").exists()
    Path("drive.eds").write_text(config_path("cia402_servo.eds").read_text())
    assert run(*words).exit_code == 0
    assert load_session("cell/session.yaml", "command").drives[0].eds.resolve() == tmp_path / "drive.eds"
    bus = run(*words, "--overwrite", "--channel", "can0")
    assert bus.stdout.endswith("next:\n  armident doctor --for capture --config cell/session.yaml\n")


def test_a_mark_in_a_list_makes_the_list_blank_and_unknown_keys_are_always_needed(tmp_path: Path) -> None:
    content: dict[str, Any] = yaml.safe_load(
        (Path(load_robot.__code__.co_filename).parent / "robots/emps.yaml").read_text()
    )
    content["joints"][0]["limits"]["position"] = [MARK, 0.3]
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(content))
    assert load_robot(tmp_path / "a.yaml", "identify").blanks == ("joints[joint_1].limits.position",)
    with pytest.raises(ConfigError, match=r"limits\.position of joint_1 \(\[low, high\]"):
        load_robot(tmp_path / "a.yaml", "trajectory")
    content["bandwidth_hz"] = MARK
    (tmp_path / "b.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(ConfigError, match="bandwidth_hz"):
        load_robot(tmp_path / "b.yaml", "identify")


@pytest.mark.slow
def test_python_takes_what_init_wrote_and_refuses_it_where_a_value_is_needed(tmp_path: Path, arm: Path) -> None:
    assert run("init", str(arm), "--out", str(tmp_path / "cell")).exit_code == 0
    robot = armident.load_robot(tmp_path / "cell")
    assert robot.blanks
    assert robot == armident.load_robot(tmp_path / "cell/robot.yaml")
    assert armident.RobotModel(tmp_path / "cell").n == armident.RobotModel(robot).n == 6
    t = np.arange(1000) / 500.0
    q = 0.6 * np.sin(2 * np.pi * t[:, None] + np.arange(6))
    recording = armident.Recording.from_arrays(t, q, 5.0 * q, robot=tmp_path / "cell")
    assert armident.check(recording).document.robot == robot.name
    assert run("init", "--axes", "2", "--out", str(tmp_path / "bare")).exit_code == 0
    bare = armident.load_robot(tmp_path / "bare")
    for call in (
        armident.RobotModel,
        armident.design_trajectory,
        lambda one: armident.simulate_recording(one, "emps_1"),
    ):
        for given in (bare, tmp_path / "bare"):
            with pytest.raises(ConfigError, match=r"joints\[\]\.mdh of"):
                call(given)


def test_existing_files_are_kept(tmp_path: Path, arm: Path) -> None:
    assert run("init", str(arm), "--out", str(tmp_path)).exit_code == 0
    again = run("init", str(arm), "--out", str(tmp_path))
    assert again.exit_code == 2
    assert "exists already; --overwrite" in again.stderr
    assert run("init", str(arm), "--out", str(tmp_path), "--overwrite").exit_code == 0


def test_without_a_recording_limits_are_blank(tmp_path: Path, arm: Path) -> None:
    made = run("init", str(arm), "--out", str(tmp_path))
    assert "joints[].limits.acceleration of all joints, for trajectory" in made.output
    refused = run("trajectory", "--config", str(tmp_path / "robot.yaml"), "--out", str(tmp_path / "t.yaml"))
    assert refused.exit_code == 2
    assert "joints[].limits.acceleration of axis-1" in refused.stderr


def test_no_source_and_two_sources_are_refused(tmp_path: Path, arm: Path) -> None:
    assert "expected one source" in run("init", "--out", str(tmp_path)).stderr
    assert "a URDF and --robot" in run("init", str(arm), "--robot", "tx40", "--out", str(tmp_path)).stderr


def test_a_robot_of_the_library_keeps_what_it_knows(tmp_path: Path) -> None:
    made = run("init", "--robot", "tx40", "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert load_robot(tmp_path / "robot.yaml") == load_robot("tx40")


FORK = """<robot name="arm"><link name="a"/><link name="b"/><link name="c"/><link name="d"/><link name="e"/>
<joint name="j1" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
<joint name="j2" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/><origin xyz="0 0 .3"/></joint>
<joint name="f1" type="prismatic"><parent link="c"/><child link="d"/><axis xyz="0 1 0"/></joint>
<joint name="f2" type="prismatic"><parent link="c"/><child link="e"/><axis xyz="0 -1 0"/></joint></robot>"""


def test_a_gripper_ends_the_chain_and_is_named(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(FORK)
    made = run("init", str(tmp_path / "arm.urdf"), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert "2 joints (j1, j2)" in made.output
    assert "chain up to link c" in made.output
    assert load_robot(tmp_path / "robot.yaml", "identify").n == 2


def test_of_two_arms_the_recorded_one_is_taken(tmp_path: Path) -> None:
    (tmp_path / "arms.urdf").write_text(
        '<robot name="two"><link name="a"/>'
        + "".join(
            f'<link name="{s}1"/><link name="{s}2"/>'
            f'<joint name="{s}_j1" type="revolute"><parent link="a"/><child link="{s}1"/><axis xyz="0 0 1"/></joint>'
            f'<joint name="{s}_j2" type="revolute"><parent link="{s}1"/><child link="{s}2"/><axis xyz="0 1 0"/></joint>'
            for s in ("left", "right")
        )
        + "</robot>"
    )
    refused = run("init", str(tmp_path / "arms.urdf"), "--out", str(tmp_path / "x"))
    assert refused.exit_code == 2
    assert "--tip left2 (left_j1, left_j2); --tip right2 (right_j1, right_j2)" in refused.stderr
    names = [f"right_j{k}/{q}" for q in ("position", "effort") for k in (1, 2)]
    t = np.arange(1000) / 500
    rows = np.column_stack([t, np.sin(t), np.cos(t), np.cos(t), np.sin(t)])
    lines = [",".join(["t", *names]), *(",".join(f"{x:.6f}" for x in row) for row in rows)]
    (tmp_path / "d.csv").write_text("\n".join(lines))
    made = run(
        "init", str(tmp_path / "arms.urdf"), "--recording", str(tmp_path / "d.csv"), "--out", str(tmp_path / "y")
    )
    assert made.exit_code == 0, made.output
    assert [joint.name for joint in load_robot(tmp_path / "y/robot.yaml", "identify").joints] == [
        "right_j1",
        "right_j2",
    ]


def test_recorded_joints_behind_a_fork_are_no_load(tmp_path: Path) -> None:
    links = [
        ("turret", "base", "0 0 1"),
        ("boom", "turret", "0 1 0"),
        ("stick", "boom", "0 1 0"),
        ("mast", "turret", "1 0 0"),
    ]
    elements = [
        f'<link name="{name}"/><joint name="j_{name}" type="revolute"><parent link="{parent}"/><child link="{name}"/>'
        f'<origin xyz="0.1 0 0.3"/><axis xyz="{axis}"/></joint>'
        for name, parent, axis in links
    ]
    arms = {
        "mast.urdf": (
            ["turret", "boom", "stick"],
            elements,
            "link 'turret' branches into joints 'j_boom' and 'j_mast'",
        ),
        "torso.urdf": (["boom", "stick"], elements, ""),
    }
    for file, (recorded, written_elements, said) in arms.items():
        (tmp_path / file).write_text(f'<robot name="r"><link name="base"/>{"".join(written_elements)}</robot>')
        t = np.arange(1000) / 500
        columns = [f"j_{name}/{q}" for q in ("position", "effort") for name in recorded]
        rows = np.column_stack([t, *(np.sin(t + k) for k in range(len(columns)))])
        lines = [",".join(["t", *columns]), *(",".join(f"{x:.6f}" for x in row) for row in rows)]
        (tmp_path / "d.csv").write_text("\n".join(lines))
        out = tmp_path / file.removesuffix(".urdf")
        made = run("init", str(tmp_path / file), "--recording", str(tmp_path / "d.csv"), "--out", str(out))
        assert made.exit_code == (2 if said else 0), made.output
        assert said in made.stderr
    assert [joint.name for joint in load_robot(out / "robot.yaml", "").joints] == ["j_boom", "j_stick"]


@pytest.mark.slow
def test_a_recording_keeps_the_blanks_of_its_robot(tmp_path: Path) -> None:
    recorded = arms.recording("emps", "emps_1", 0)
    robot = recorded.robot.model_copy(update={"blanks": ("joints[joint_1].drive.rated",)})
    write_recording(type(recorded)(**{**vars(recorded), "robot": robot}), tmp_path / "a.mcap")
    assert read_recording(tmp_path / "a.mcap").robot.blanks == ("joints[joint_1].drive.rated",)


def test_doctor_names_what_the_command_in_mind_lacks(tmp_path: Path, arm: Path) -> None:
    path = table(tmp_path / "d.csv", effort="current")
    assert run("init", str(arm), "--recording", str(path), "--out", str(tmp_path)).exit_code == 0
    robot, session = str(tmp_path / "robot.yaml"), str(tmp_path / "session.yaml")
    found = {command: run("doctor", "--for", command, "--config", robot) for command in ("import", "identify", "robot")}
    assert {command: one.exit_code for command, one in found.items()} == {"import": 0, "identify": 2, "robot": 2}
    assert "failed   blank: joints[].drive.gain of axis-1" in found["identify"].stdout
    assert "not needed yet: joints[].drive.rated, joints[].drive.counts_per_unit" in found["identify"].stdout
    assert "identify would not run: blank" in found["identify"].stderr
    assert found["robot"].stdout.count("failed   blank") == 1
    capture = run("doctor", "--config", session)
    assert capture.exit_code == 2
    assert capture.stdout.count("failed   blank") == 7
    assert run("doctor", "--for", "trajectory", "--config", robot).exit_code == 0
    assert run("doctor", "--for", "identify", "--config", session).exit_code == 2


UR5E = """joint; theta [rad]; d [mm]; a [mm]; alpha
pan; 0; 162.5; 0; pi/2
lift; 0; 0; -425; 0
elbow; 0; 0; -392.2; 0
wrist_1; 0; 133.3; 0; pi/2
wrist_2; 0; 99.7; 0; -pi/2
wrist_3; 0; 99.6; 0; 0
"""
PANDA = """# a and d in m, angles in degrees
a,d,alpha,theta
0,0.333,0,0
0,0,-90,0
0,0.316,90,0
0.0825,0,90,0
-0.0825,0.384,-90,0
0,0,90,0
0.088,0,90,0
"""
EMPS = "type,alpha,d,theta,r\nprismatic,0,0,0,0\n"


@pytest.mark.parametrize(
    ("text", "name", "options", "said"),
    [
        (UR5E, "ur5e", [], "classical parameters"),
        (UR5E.replace("pi/2", "\u03c0/2").replace("theta", "\u03b8"), "ur5e", [], "classical parameters"),
        (PANDA, "panda", ["--convention", "modified"], "angles are in degrees by their magnitude"),
        (EMPS, "emps", [], "modified parameters"),
    ],
)
def test_a_table_of_parameters_gives_the_geometry(
    tmp_path: Path, text: str, name: str, options: list[str], said: str
) -> None:
    (tmp_path / "arm.csv").write_text(text)
    made = run("init", "--dh", str(tmp_path / "arm.csv"), *options, "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert f"note: {said}" in made.output
    found, shipped = load_robot(tmp_path / "robot.yaml", "identify"), load_robot(name)
    zero = np.linspace(-1.0, 1.0, shipped.n)
    # The last frame of a classical table is the flange; only its place on the last axis may differ.
    flange = np.linalg.inv(transform(shipped, zero)) @ transform(found, zero)
    for q in np.random.default_rng(0).uniform(-2, 2, (5, shipped.n)):
        assert transform(found, q) == pytest.approx(transform(shipped, q) @ flange, abs=1e-9)
    assert [joint.type for joint in found.joints] == [joint.type for joint in shipped.joints]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("theta,d,a\n0,0,0\n", "no column alpha; found theta, d, a"),
        ("theta,d,a,alpha\n0,0,0\n", "line 2: 3 values, the header has 4"),
        ("theta,d,a,alpha\n0,0,0,north\n", "line 2, column alpha: .*north"),
        ("theta,d,a [inch],alpha\n0,0,0,0\n", "unknown unit; expected rad, deg, m or mm"),
        ("theta,d,a,alpha\n0,0,1e9,0\n", "lengths: 1e\\+09 is beyond every arm"),
        ("name,theta,d,a,alpha\nx,0,0,1,0\nX,0,0,1,0\n", "joint names differ only in case"),
        ("theta,d,a,alpha,type\n0,0,0,0,screw\n", "type 'screw'; expected revolute or prismatic"),
        ("", "expected a header line"),
    ],
)
def test_a_wrong_table_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "arm.csv").write_text(text)
    refused = run("init", "--dh", str(tmp_path / "arm.csv"), "--out", str(tmp_path))
    assert refused.exit_code == 2
    assert re.search(said, refused.stderr)
    assert len(refused.stderr.splitlines()) == 1


def test_the_geometry_may_be_blank_until_it_is_needed(tmp_path: Path) -> None:
    path = table(tmp_path / "d.csv")
    assert run("init", "--axes", "6", "--recording", str(path), "--out", str(tmp_path)).exit_code == 0
    config = str(tmp_path / "robot.yaml")
    assert run("import", str(path), "--config", config, "--out", str(tmp_path / "d.mcap")).exit_code == 0
    refused = run("identify", str(tmp_path / "d.mcap"), "--config", config)
    assert refused.exit_code == 2
    assert "joints[].mdh of joint_1, joint_2, joint_3, joint_4, joint_5, joint_6 (modified" in refused.stderr


def test_answers_on_a_terminal_are_the_options(tmp_path: Path, arm: Path) -> None:
    asked: list[str] = []
    said: list[str] = []
    of_arm = [str(arm), "", "curr", "yes", "on the moon", "ceiling"]
    of_cell = ["yes", "can0", "fast", "500000", "1,2,3,4,5,6", ""]
    answers = iter([*of_arm, *of_cell, str(tmp_path / "cell")])

    def ask(question: str, default: str) -> str:
        asked.append(question)
        return next(answers) or default

    options = questionnaire(InitOptions(Path()), ask, said.append)
    assert said[-1] == "expected one of floor, ceiling, wall"
    assert asked[-1] == "Folder of the files"
    run_init(options)
    robot = load_robot(tmp_path / "cell" / "robot.yaml", "")
    assert robot.gravity == (0.0, 0.0, 9.81)
    assert {(joint.drive.signal, joint.rotor_inertia) for joint in robot.joints} == {("current", False)}
    session = load_session(tmp_path / "cell" / "session.yaml", "")
    assert (session.bus.channel, session.bus.bitrate) == ("can0", 500000)
    assert [drive.node_id for drive in session.drives] == [1, 2, 3, 4, 5, 6]
    assert {key.rpartition(".")[2] for key in session.blanks} == {"eds", "period_us"}


def test_answers_left_empty_are_blanks(tmp_path: Path) -> None:
    options = questionnaire(InitOptions(Path()), lambda _, default: default, lambda _: None)
    assert (options.axes, options.out) == (6, Path("arm"))
    run_init(replace(options, out=tmp_path))
    blanks = {pattern(key) for key in load_session(tmp_path / "session.yaml", "").blanks}
    assert blanks == {"bus.channel", "bus.bitrate", "sync.period_us", "drives[].node_id", "drives[].eds"}


LIFT = """<robot name="lift"><link name="a"/><link name="b"/><link name="c"/>
<joint name="lift" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<limit lower="0" upper="0.8" velocity="0.5" effort="900"/></joint>
<joint name="turn" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/><origin xyz="0 0 .3"/>
<limit lower="-3" upper="3" velocity="3" effort="60"/></joint></robot>"""


def test_a_lift_in_millimetres_beside_a_joint_in_degrees(tmp_path: Path) -> None:
    (tmp_path / "lift.urdf").write_text(LIFT)
    t = np.arange(2000) / 1000
    rows = np.column_stack([t, 400 + 300 * np.sin(3 * t), 90 * np.cos(3 * t), 2e5 * np.cos(t), 4e4 * np.sin(t)])
    names = "t,lift/position,turn/position,lift/effort,turn/effort"
    (tmp_path / "d.csv").write_text("\n".join([names, *(",".join(f"{x:.6f}" for x in row) for row in rows)]))
    made = run("init", str(tmp_path / "lift.urdf"), "--recording", str(tmp_path / "d.csv"), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert "--units 'position=deg|mm,torque=mnm'" in made.output
    robot = load_robot(tmp_path / "robot.yaml", "trajectory")
    assert [joint.type for joint in robot.joints] == ["prismatic", "revolute"]
    assert robot.joints[0].limits.acceleration == pytest.approx(0.3 * 9, rel=0.02)
    assert robot.joints[1].limits.acceleration == pytest.approx(np.pi / 2 * 9, rel=0.02)


@pytest.mark.parametrize("units", ["position=grad", "speed=deg", "position"])
def test_a_unit_that_is_none_is_one_line(tmp_path: Path, units: str) -> None:
    path = table(tmp_path / "d.csv")
    refused = run("import", str(path), "--config", "tx40", "--units", units, "--out", str(tmp_path / "d.mcap"))
    assert refused.exit_code == 2
    assert "--units" in refused.stderr.splitlines()[-1]


@pytest.mark.slow
def test_joints_that_were_not_recorded_are_left_out(tmp_path: Path, arm: Path) -> None:
    path = table(tmp_path / "d.csv")
    rows = [line.split(",") for line in path.read_text().splitlines()[1:]]
    kept = [0, *range(2, 6), *range(8, 12)]
    named = ["t", *(f"axis_{k}/{quantity}" for quantity in ("position", "effort") for k in range(2, 6))]
    path.write_text("\n".join(",".join(row) for row in [named, *([row[k] for k in kept] for row in rows)]))
    made = run("init", str(arm), "--recording", str(path), "--out", str(tmp_path))
    assert made.exit_code == 0, made.output
    assert "note: chain from link s1 up to link l5" in made.output
    robot = load_robot(tmp_path / "robot.yaml", "identify")
    assert [joint.source_name for joint in robot.joints] == AXES[1:5]
    # Gravity along the axes of the part, whose base lies on its side, is as in the whole arm.
    whole = load_robot("tx40")
    for count in range(1, 5):
        part = robot.model_copy(update={"joints": robot.joints[:count]})
        same = whole.model_copy(update={"joints": whole.joints[: count + 1]})
        found = transform(part, np.zeros(count))[:3, 2] @ robot.gravity
        assert found == pytest.approx(transform(same, np.zeros(count + 1))[:3, 2] @ whole.gravity, abs=1e-8)
    assert np.linalg.norm(robot.gravity) == pytest.approx(9.81)
    # Numbers are no names: they do not tell the recorded joints.
    numbered = ["t", *(f"{quantity}{k}" for quantity in ("q", "tau") for k in range(1, 5))]
    path.write_text("\n".join(",".join(row) for row in [numbered, *([row[k] for k in kept] for row in rows)]))
    refused = run("init", str(arm), "--recording", str(path), "--out", str(tmp_path / "x"))
    assert refused.exit_code == 3
    assert "no column q5, the robot has 6 joints" in refused.stderr


def test_the_virtual_arm_assumes_what_is_blank(tmp_path: Path, arm: Path) -> None:
    path = table(tmp_path / "d.csv")
    assert run("init", str(arm), "--recording", str(path), "--out", str(tmp_path)).exit_code == 0
    twin = load_twin(tmp_path / "robot.yaml")
    assert twin.robot.blanks == ()
    assert all(any(key in text for text in twin.assumed) for key in ("drive.rated", "drive.counts_per_unit"))
    assert all(joint.drive.counts_per_unit is not None for joint in twin.robot.joints)
    with pytest.raises(ConfigError, match="armident robot needs values"):
        load_twin(tmp_path / "session.yaml")
