"""Configuration files: accepted values, and one-line messages for every mistake."""

import math
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import yaml

from armident.configs import (
    ConfigError,
    RobotConfig,
    config_path,
    load_robot,
    load_scenario,
    load_session,
    load_trajectory,
)
from armident.configs.loading import HERE, parse
from armident.configs.yaml_loader import read_yaml

TX40 = yaml.safe_load((HERE / "robots" / "tx40.yaml").read_text())


def robot_with(**changes: object) -> str:
    return yaml.safe_dump(TX40 | changes)


KINDS: dict[str, Callable[[Path], object]] = {
    "robots": load_robot,
    "cells": load_session,
    "trajectories": load_trajectory,
    "scenarios": load_scenario,
}


@pytest.mark.parametrize(
    "path", sorted(p for folder in KINDS for p in (HERE / folder).glob("*.yaml")), ids=lambda p: p.name
)
def test_every_shipped_configuration_loads(path: Path) -> None:
    load = KINDS[path.parent.name]
    assert load(path) == load(path)


@pytest.mark.parametrize(
    "name", ["tx40", "tx40.yaml", "configs/tx40.yaml", "robots/tx40.yaml", str(HERE / "robots" / "tx40.yaml")]
)
def test_a_shipped_configuration_is_found_by_its_short_names(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_robot(name).n == 6


@pytest.mark.parametrize("given", ["{kind}/{name}", "{name}", "configs/{kind}/{name}", "configs/{name}"])
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("robots", "emps.yaml"),
        ("cells", "tx40_cell.yaml"),
        ("trajectories", "tx40_excitation.yaml"),
        ("scenarios", "tx40_worn_joint2.yaml"),
        ("eds", "cia402_servo.eds"),
        ("zenoh", "client.json5"),
    ],
)
def test_shipped_files_of_every_kind_are_found_from_any_folder(
    kind: str, name: str, given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert config_path(given.format(kind=kind, name=name)) == HERE / kind / name


def test_a_session_in_any_folder_finds_shipped_files_by_their_names(tmp_path: Path) -> None:
    data = yaml.safe_load((HERE / "cells" / "tx40_cell.yaml").read_text())
    data |= {"robot": "tx40", "zenoh": {"config": "client.json5"}, "setpoints": {"trajectory": "tx40_1.yaml"}}
    for drive in data["drives"]:
        drive["eds"] = "cia402_servo.eds"
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(data))
    session = load_session(tmp_path / "cell.yaml")
    assert session.setpoints is not None
    assert session.robot == HERE / "robots" / "tx40.yaml"
    assert session.drives[3].eds == HERE / "eds" / "cia402_servo.eds"
    assert session.zenoh.config == HERE / "zenoh" / "client.json5"
    assert session.setpoints.trajectory == HERE / "trajectories" / "tx40_1.yaml"


def test_a_file_in_the_working_directory_wins_over_the_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tx40.yaml").write_text(robot_with(description="mine"))
    assert load_robot("tx40.yaml").description == "mine"


def test_motor_six_turns_with_joint_five_as_on_the_tx40() -> None:
    matrix = load_robot("tx40").transmission_matrix
    assert matrix[5, 4] == matrix[5, 5] == 32.0
    assert np.allclose(np.linalg.solve(matrix, matrix @ np.arange(6.0)), np.arange(6.0), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (robot_with(transmision=[[1.0]]), "transmision: unknown key; did you mean 'transmission'?"),
        (robot_with(bandwidth_hz=-1), "bandwidth_hz: input should be greater than 0, found -1"),
        (robot_with(bandwidth_hz=float("nan")), "bandwidth_hz: "),
        (robot_with(transmission=[[1.0]]), "transmission: expected 6 rows of 6 numbers"),
        (robot_with(transmission=[[0.0] * 6] * 6), "transmission: the matrix is singular"),
        (
            robot_with(joints=[*TX40["joints"][:5], TX40["joints"][4]]),
            "joints: names must be unique, without regard to case",
        ),
        (
            robot_with(couplings=[{"name": "m6", "joints": ["joint_5", "joint_7"]}]),
            "couplings: no joint named 'joint_7'",
        ),
        (robot_with(schema="armident/robot/2"), "schema: input should be 'armident/robot/1'"),
        ("joints: [", "line 1"),
        ("- a\n- b\n", "expected keys and values, found a list"),
    ],
)
def test_a_mistake_is_named_in_one_line_with_file_key_and_expectation(text: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse(text, RobotConfig, "robot.yaml")
    message = str(caught.value)
    assert message.startswith("robot.yaml:")
    assert expected in message
    assert "\n" not in message


def test_all_missing_keys_are_listed_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        parse("joints: [{mdh: {alpha: 0, d: 0}}, {name: j2}]", RobotConfig, "robot.yaml")
    assert str(caught.value) == (
        "robot.yaml: schema, name, joints[0].name, joints[0].mdh.theta, joints[0].mdh.r, joints[1].mdh: missing"
    )


def one_joint(tmp_path: Path, **changes: object) -> Path:
    mdh = {"alpha": 0.0, "d": 0.0, "theta": 0.0, "r": 0.0}
    data = {"schema": "armident/robot/1", "name": "arm", "joints": [{"name": "j1", "mdh": mdh} | changes]}
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(data))
    return tmp_path / "arm.yaml"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"mdh": {"alpha": 180, "d": 0, "theta": 0, "r": 0}}, "joints[0].mdh.alpha: 180 looks like degrees"),
        ({"mdh": {"alpha": 0, "d": 0, "theta": -90, "r": 0}}, "joints[0].mdh.theta: -90 looks like degrees"),
        (
            {"mdh": {"alpha": 0, "d": 325, "theta": 0, "r": 0}},
            "joints[0].mdh.d: 325 looks like millimetres (in m: 0.325)",
        ),
        ({"limits": {"position": [-132, 132]}}, "joints[0].limits.position: [-132, 132] looks like degrees"),
        ({"limits": {"position": [-45.5, 30]}}, "joints[0].limits.position: [-45.5, 30] looks like degrees"),
        ({"type": "prismatic", "limits": {"position": [0, 500]}}, "[0, 500] looks like millimetres (in m: [0, 0.5])"),
    ],
)
def test_suspected_degrees_and_millimetres_are_named(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_robot(one_joint(tmp_path, **changes))
    assert said in str(caught.value)
    assert "arm.yaml: expected rad and m: " in str(caught.value)


def test_gravity_in_millimetres_is_named(tmp_path: Path) -> None:
    path = one_joint(tmp_path)
    path.write_text(path.read_text() + "gravity: [0, 0, -9810]\n")
    with pytest.raises(ConfigError, match=r"looks like mm/s\^2 \(in m/s\^2: \[0, 0, -9\.81\]\)"):
        load_robot(path)


@pytest.mark.parametrize(
    "changes",
    [
        {"limits": {"position": [-62.83, 62.83]}},
        {"limits": {"position": [-12.5, 12.5]}},
        {"limits": {"position": [-1e16, 1e16]}},
        {"limits": {"position": [-math.inf, math.inf]}},
        {"limits": {"position": [-10000, 10000]}},
        {"type": "prismatic", "limits": {"position": [0, 60]}},
        {"mdh": {"alpha": -6.2832, "d": 15, "theta": 0, "r": 0}},
    ],
)
def test_many_turns_and_long_axes_are_no_suspicion(tmp_path: Path, changes: dict[str, object]) -> None:
    assert load_robot(one_joint(tmp_path, **changes)).n == 1


def test_an_endless_joint_has_the_range_of_two_turns(tmp_path: Path) -> None:
    for none in (1e16, math.inf):
        joint = load_robot(one_joint(tmp_path, limits={"position": [-none, none]})).joints[0]
        assert joint.limits.position == pytest.approx((-2 * np.pi, 2 * np.pi))


def test_limits_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    for changes in ({"position": [math.nan, 1.0]}, {"position": [1.0, 1.0]}, {"velocity": math.nan}):
        with pytest.raises(ConfigError, match=r"joints\[0\]\.limits"):
            load_robot(one_joint(tmp_path, limits=changes))


def test_a_drive_finds_its_joint_without_regard_to_case(tmp_path: Path) -> None:
    data = yaml.safe_load((HERE / "robots" / "tx40.yaml").read_text())
    data["joints"][0]["name"] = "Joint_1"
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(data))
    session = load_session(session_with(tmp_path, robot="mine.yaml"))
    assert [drive.joint for drive in session.drives][:2] == ["Joint_1", "joint_2"]


def test_a_missing_file_names_what_is_shipped() -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: no such file .*tx40\.yaml"):
        config_path("nowhere.yaml")


def session_with(tmp_path: Path, **changes: object) -> Path:
    data = yaml.safe_load((HERE / "cells" / "tx40_cell.yaml").read_text())
    data["robot"] = str(HERE / "robots" / "tx40.yaml")
    data["setpoints"]["trajectory"] = str(HERE / "trajectories" / "tx40_excitation.yaml")
    for drive in data["drives"]:
        drive["eds"] = str(HERE / "eds" / "cia402_servo.eds")
    for key, value in changes.items():
        data[key] = value(data[key]) if callable(value) else value
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("robot", "nowhere.yaml", "robot: no such file nowhere.yaml"),
        ("streams", lambda s: s | {"more": {"tpdo": 1, "objects": ["torque"]}}, "each stream needs a tpdo of its own"),
        ("streams", lambda s: s | {"more": {"tpdo": 3, "every": 7, "objects": ["torque"]}}, "7 does not divide"),
        ("streams", {"demand": {"tpdo": 1, "objects": ["demand"]}}, "a stream named 'samples'"),
        (
            "streams",
            {"samples": {"tpdo": 1, "objects": ["position"] * 2}},
            "each object once, found position, position",
        ),
        ("drives", lambda d: [*d[:-1], d[0] | {"joint": "joint_6"}], "node_id must be unique"),
        ("drives", lambda d: [*d[:-1], d[-1] | {"joint": "wrist"}], "'wrist' is not a joint of tx40.yaml"),
        ("drives", lambda d: [*d[:-1], d[-1] | {"eds": "no.eds"}], "drives[5].eds: no such file no.eds"),
        ("sync", {"period_us": 20}, "sync.period_us: input should be greater than or equal to 100, found 20"),
        ("identification", {"method": "best"}, "cell.yaml: identification.method: Input should be"),
        ("identification", {"methods": "idim-ls"}, "identification.methods: Unexpected keyword argument"),
        ("identification", {"max_ar_order": -1}, "cell.yaml: identification.max_ar_order: expected 0 or more, got -1"),
    ],
)
def test_a_session_that_cannot_work_is_refused_with_its_key(
    tmp_path: Path, key: str, value: object, expected: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        load_session(session_with(tmp_path, **{key: value}))
    assert expected in str(caught.value)


def test_trajectory_starts_and_ends_at_rest_and_reaches_every_waypoint() -> None:
    trajectory = load_trajectory("trajectories/tx40_excitation.yaml")
    q = trajectory.sample(1e-3)
    assert np.allclose(q[0], trajectory.start)
    assert np.allclose(q[-1], trajectory.moves[-1].to)
    ends = np.cumsum([m.duration + m.dwell for m in trajectory.moves])
    for end, move in zip(ends, trajectory.moves, strict=True):
        assert np.allclose(q[round(end / 1e-3)], move.to, atol=1e-9)
    assert np.abs(np.diff(q[[0, 1, -2, -1]], axis=0)[[0, 2]]).max() < 1e-5


def test_trajectory_velocity_is_continuous_and_acceleration_bounded() -> None:
    trajectory = load_trajectory("trajectories/tx40_excitation.yaml")
    limits = np.array([j.limits.acceleration for j in load_robot("tx40").joints])
    qd = np.diff(trajectory.sample(1e-4), axis=0) / 1e-4
    assert (np.abs(np.diff(qd, axis=0)) / 1e-4 <= limits * 1.001).all()


def test_a_trajectory_beyond_a_limit_is_refused_with_joint_and_value() -> None:
    trajectory = load_trajectory("trajectories/tx40_excitation.yaml")
    far = trajectory.model_copy(update={"start": (9.0, *trajectory.start[1:])})
    with pytest.raises(ConfigError, match=r"joint_1 moves over \[.*9\.000\], allowed is \[-3\.140, 3\.140\]"):
        far.check(load_robot("tx40"))
    with pytest.raises(ConfigError, match="6 joints, but emps has 1"):
        trajectory.check(load_robot("emps"))


@pytest.mark.parametrize(
    ("load", "name", "expected"),
    [
        (load_session, "tx40.yaml", "this is a robot file (armident/robot/1); a session file is wanted"),
        (load_robot, "tx40_cell.yaml", "this is a session file (armident/session/1); a robot file is wanted"),
        (load_scenario, "trajectories/tx40_1.yaml", "this is a trajectory file"),
    ],
)
def test_a_file_of_another_kind_is_named_for_what_it_is(
    load: Callable[[Path], object], name: str, expected: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=re.escape(expected)):
        load(config_path(name))
    path = tmp_path / "nameless.yaml"
    path.write_text(re.sub(r"(?m)^schema:.*$", "", config_path(name).read_text()))
    with pytest.raises(ConfigError, match=rf"nameless\.yaml: this looks like a {expected.split()[3]} file \(it has "):
        load(path)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("bandwidth_hz: 5\nbandwidth_hz: 6", "duplicate key 'bandwidth_hz'"),
        ("bandwidth_hz: yes", "bandwidth_hz: expected a number or a word, found true"),
        ("bandwidth_hz: 1:30", "bandwidth_hz: input should be a valid number"),
        ("description: " + "[" * 500, "not valid YAML: brackets or indentation too deep"),
        ("bandwidth_hz: " + "9" * 5000, "not valid YAML"),
        ("controller: 2024-13-45", "controller: input should be a valid dictionary"),
    ],
)
def test_values_that_yaml_reads_as_another_type_are_refused(line: str, expected: str) -> None:
    text = re.sub(r"(?m)^bandwidth_hz:.*\n", "", (HERE / "robots" / "tx40.yaml").read_text())
    with pytest.raises(ConfigError) as caught:
        parse(f"{text}\n{line}\n", RobotConfig, "robot.yaml")
    assert expected in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "a: &a [1]\n" + "".join(f"{b}: &{b} [{', '.join(9 * [f'*{a}'])}]\n" for a, b in pairwise("abcdefghij")),
            "aliases .* repeat more than",
        ),
        ("a: &a [*a]", "an alias .* within the value that it names"),
        ("a: &a {b: {c: *a}}", "an alias .* within the value that it names"),
        ("a: 1e999", "line 1 not valid YAML: the number 1e999 is too large"),
        ("b: 2\na: [-1.5e+400]", r"line 2 not valid YAML: the number -1.5e\+400 is too large"),
    ],
)  # fmt: skip
def test_values_that_grow_without_bound_are_refused_in_one_line(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        read_yaml(text, "x.yaml")
    assert "\n" not in str(caught.value)


def test_aliases_and_infinities_that_are_written_are_read() -> None:
    assert read_yaml("a: &a [1, .inf, -.INF]\nb: [*a, *a]", "x")["b"][1] == [1, float("inf"), -float("inf")]


def test_numbers_are_those_of_yaml_1_2() -> None:
    assert read_yaml("[010, 0x1F, 1e-3, 1_000, .5, 2024-01-02]", "x") == ["010", 31, 0.001, 1000, 0.5, "2024-01-02"]


ODD_NUMBERS = [
    ".nan",
    ".inf",
    "-.inf",
    "1e400",
    "-1e400",
    "1" + "0" * 400,
    "1" * 5000,
    "0x" + "f" * 300,
    "1e-400",
    "!!float 1e9x",
]


@pytest.mark.parametrize("number", ODD_NUMBERS, ids=range(len(ODD_NUMBERS)))
@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("robot", "bandwidth_hz: {}"),
        ("robot", "gravity: [0, 0, {}]"),
        ("robot", "joints: [{{name: j, mdh: {{alpha: {0}, d: {0}, theta: 0, r: 0}}}}]"),
        ("robot", "joints: [{{name: j, limits: {{position: [{0}, {0}], torque: {0}}}}}]"),
        ("robot", "transmission: [[{}]]"),
        ("session", "sync: {{period_us: {}}}"),
        ("session", "drives: [{{joint: j, node_id: {}, eds: x.eds}}]"),
        ("trajectory", "start: [{}]"),
    ],
)
def test_an_odd_number_is_one_line(tmp_path: Path, kind: str, line: str, number: str) -> None:
    loaders: dict[str, Callable[[Path], object]] = {
        "robot": load_robot,
        "session": load_session,
        "trajectory": load_trajectory,
    }
    load = loaders[kind]
    path = tmp_path / "odd.yaml"
    path.write_text(f"schema: armident/{kind}/1\n{line.format(number)}\n")
    with pytest.raises(ConfigError) as caught:
        load(path)
    message = str(caught.value)
    assert message.startswith(f"{path}:")
    assert "\n" not in message
    assert len(message) < 700 + len(str(path))
    assert "limit (4300" not in message
    assert "Error" not in message
