"""The command view: what the files for Rerun and Foxglove hold, read back by the libraries of both."""

import json
import sys
from dataclasses import replace
from importlib.metadata import EntryPoint
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from typer.testing import CliRunner, Result

import armident
from armident.configs import RobotConfig, load_robot
from armident.configs.urdf_origin import fixed_axis_angles
from armident.daq.cli import GROUP, application
from armident.daq.recording import Gap, Recording
from armident.extras import EXTRAS
from armident.identify.documents.files import to_json
from armident.identify.identification.from_recording import joint_positions, joint_torques
from armident.identify.model_export.link_frames import mdh_transform
from armident.identify.view.arm import colours
from armident.identify.view.contents import COLOUR_S, POINTS, standardised
from tests.fixtures import arms
from tests.fixtures.arms import FAST, hide, recording
from tests.fixtures.diagnoses import SPRING

pytestmark = pytest.mark.slow

Floats = NDArray[np.float64]
WORN = hide("asymmetric_viscous_friction", "joint_2", fva=1.1)
QUANTITIES = ("position", "velocity", "torque", "unexplained", "deviations")


def call(*words: str | Path) -> Result:
    """Run the command as the command line does, on a machine without a display."""
    text = ["view", *map(str, words)]
    app = application(text, [EntryPoint("view", "armident.identify.view.command:view", GROUP)])
    return CliRunner(env={"DISPLAY": None, "WAYLAND_DISPLAY": None}).invoke(app, text)


def urdf_of(robot: RobotConfig) -> str:
    """A URDF of an arm whose joint frames are those of its configuration, with a shape of each kind."""
    shapes = ('<box size="0.1 0.1 0.2"/>', '<cylinder radius="0.05" length="0.3"/>', '<sphere radius="0.08"/>')
    parts = ['<link name="base"/>']
    for k, joint in enumerate(robot.joints):
        frame = mdh_transform(joint.mdh)
        rpy = " ".join(map(repr, fixed_axis_angles(frame[:3, :3])))
        parts.append(
            f'<link name="link_{k}"><visual><geometry>{shapes[k % 3]}</geometry></visual></link>'
            f'<joint name="{joint.name}" type="revolute"><parent link="{f"link_{k - 1}" if k else "base"}"/>'
            f'<child link="link_{k}"/><origin xyz="{" ".join(map(repr, frame[:3, 3].tolist()))}" rpy="{rpy}"/>'
            '<axis xyz="0 0 1"/><limit lower="-6" upper="6" velocity="10" effort="500"/></joint>'
        )
    return f'<robot name="arm">{"".join(parts)}</robot>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of a healthy EMPS with its model, of one with a spring, and of a TX40, with a URDF and a model."""
    folder = tmp_path_factory.mktemp("views")
    for name, robot, motion, seed, effects in (
        ("healthy", "emps", "emps_1", 1, ()),
        ("sprung", "emps", "emps_1", 3, (SPRING,)),
        ("worn", "tx40", "tx40_excitation", 2, (WORN,)),
    ):
        recording(robot, motion, seed, *effects, period=FAST).save(folder / f"{name}.mcap")
    armident.identify(folder / "healthy.mcap", method="idim-ls").save(folder / "healthy.identification")
    document = arms.identified("tx40", "tx40_excitation", 1, "idim-ls", period=FAST, checked=False).document
    (folder / "tx40.json").write_text(to_json(document))
    (folder / "tx40.urdf").write_text(urdf_of(load_robot("tx40")))
    return folder


@pytest.fixture(scope="module")
def worn(folder: Path) -> Path:
    """The view of the worn TX40 for Rerun."""
    file = folder / "worn.rrd"
    words = ("--model", folder / "tx40.json", "--urdf", folder / "tx40.urdf", "--out", file)
    done = call(folder / "worn.mcap", *words)
    assert done.exit_code == 0, done.output
    assert done.stdout == f"written: {file}\nto see it: {sys.executable} -m rerun --bind 127.0.0.1 {file}\n"
    return file


def entities(file: Path) -> dict[str, dict[str, list[Any]]]:
    """The columns of each entity of a file of Rerun."""
    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(file).stream().to_chunks():
        found.setdefault(chunk.entity_path.lstrip("/"), {}).update(chunk.to_record_batch().to_pydict())
    return found


def curve(entity: dict[str, list[Any]]) -> tuple[NDArray[np.int64], Floats]:
    """Times, ns, and values of a curve of Rerun."""
    times = np.array(entity["time"], dtype="datetime64[ns]").astype(np.int64)
    return times, np.array([value for (value,) in entity["Scalars:scalars"]])


def shades(entity: dict[str, list[Any]]) -> NDArray[np.uint8]:
    """The colours (K, 4) of a joint in Rerun."""
    return np.array([value for (value,) in entity["Cylinders3D:colors"]], dtype=">u4").view(np.uint8).reshape(-1, 4)


def messages(file: Path) -> dict[str, list[tuple[int, str, Any]]]:
    """Time, name of the schema and decoded message of every message of an MCAP file, by topic."""
    found: dict[str, list[tuple[int, str, Any]]] = {}
    factory = DecoderFactory()
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            decode = factory.decoder_for(channel.message_encoding, schema) or json.loads
            found.setdefault(channel.topic, []).append((message.log_time, schema.name, decode(message.data)))
    return found


def test_the_curves_are_the_signals_of_the_recording_and_of_the_prediction(folder: Path, worn: Path) -> None:
    found, data = entities(worn), armident.read_recording(folder / "worn.mcap")
    samples, robot = data.samples, data.robot
    paths = {path for path in found if path.split("/")[0] in QUANTITIES}
    joints = [joint.name for joint in robot.joints]
    kinds = {f"torque/{joint}/{kind}" for joint in joints for kind in ("measured", "predicted")}
    assert paths == kinds | {
        f"{quantity}/{joint}" for quantity in QUANTITIES if quantity != "torque" for joint in joints
    }
    prediction = armident.predict(data, folder / "tx40.json")
    expected = {
        "position/{}": joint_positions(samples, "position", robot),
        "torque/{}/measured": joint_torques(samples, robot),
        "torque/{}/predicted": prediction.predicted,
        "unexplained/{}": prediction.measured - prediction.predicted,
        "deviations/{}": standardised(prediction),
    }
    seconds = prediction.since_start
    for path, signal in expected.items():
        full = samples.t_ns if len(signal) == samples.sync.size else samples.t_ns[0] + np.round(1e9 * seconds)
        for joint, column in zip(joints, signal.T, strict=True):
            times, values = curve(found[path.format(joint)])
            rows = np.searchsorted(full, times - 1000)  # times are rounded
            np.testing.assert_allclose(values, column[rows], rtol=1e-12)
            assert values.size == min(column.size, POINTS)
            assert (values.min(), values.max()) == (column.min(), column.max())
    since_start = np.array(found["position/joint_1"]["since_start"], dtype="timedelta64[ns]").astype(np.int64)
    assert since_start[0] == 0
    np.testing.assert_array_equal(since_start, curve(found["position/joint_1"])[0] - samples.t_ns[0])


def test_the_links_stand_where_pinocchio_puts_them(folder: Path, worn: Path) -> None:
    found, data = entities(worn), armident.read_recording(folder / "worn.mcap")
    model = pin.buildModelFromUrdf(str(folder / "tx40.urdf"))
    state = model.createData()
    q = joint_positions(data.samples, "position", data.robot)
    times = np.array(found["arm/joint_1"]["time"], dtype="datetime64[ns]").astype(np.int64)
    assert np.diff(times).min() > 0.019e9
    for row in np.linspace(0, times.size - 1, 7).astype(int):
        pin.forwardKinematics(model, state, q[np.searchsorted(data.samples.t_ns, times[row])])
        frame, path = pin.SE3.Identity(), "arm"
        for j, joint in enumerate(data.robot.joints, start=1):
            path += f"/{joint.name}"
            (place,), (turn,) = (found[path][f"Transform3D:{kind}"][row] for kind in ("translation", "quaternion"))
            frame = frame * pin.SE3(pin.Quaternion(np.array(turn)).toRotationMatrix(), np.array(place))
            # Rerun has single precision.
            np.testing.assert_allclose(frame.homogeneous, state.oMi[j].homogeneous, atol=2e-6)


def test_the_links_have_the_shapes_of_the_urdf(worn: Path) -> None:
    found, path = entities(worn), "arm"
    extents = ((0.1, 0.1, 0.2), (0.1, 0.1, 0.3), (0.16, 0.16, 0.16)) * 2
    for k, extent in enumerate(extents, start=1):
        path += f"/joint_{k}"
        points = np.array(found[f"{path}/link"]["Mesh3D:vertex_positions"][0])
        normals = np.array(found[f"{path}/link"]["Mesh3D:vertex_normals"][0])
        np.testing.assert_allclose(np.ptp(points, axis=0), extent, rtol=0.02)
        # Each shape is about the origin of its link, so that outside is away from it.
        assert (np.sum(points * normals, axis=1) > 0.0).all()


def test_the_colour_of_a_joint_follows_its_unexplained_torque(folder: Path, worn: Path) -> None:
    found = entities(worn)
    deviations = standardised(armident.predict(folder / "worn.mcap", folder / "tx40.json"))
    sizes, path, seen = np.sqrt(np.mean(deviations**2, axis=0)), "arm", []
    for k in range(6):
        path += f"/joint_{k + 1}"
        seen.append(shades(found[f"{path}/axis"]))
    # The worn joint is the brightest: in cividis, brightness grows with the value.
    assert int(np.argmax(sizes)) == 1
    assert int(np.argmax([np.mean(each[:, :3]) for each in seen])) == 1
    times, values = curve(found["deviations/joint_2"])
    first = values[: np.searchsorted(times, times[0] + 1e9 * COLOUR_S)]
    np.testing.assert_array_equal(seen[1][0], colours(np.sqrt(np.mean(first**2))))


def test_noise_alone_is_about_one_standard_deviation_and_a_spring_is_more(folder: Path) -> None:
    model = folder / "healthy.identification"
    sizes = {
        name: float(np.sqrt(np.mean(standardised(armident.predict(folder / f"{name}.mcap", model)) ** 2)))
        for name in ("healthy", "sprung")
    }
    # The last octave of the residual, which the variance leaves out, has a quarter of the power of the EMPS's noise.
    assert 0.9 < sizes["healthy"] < 1.3
    assert sizes["sprung"] > 3.0 * sizes["healthy"]


def test_the_blueprint_has_the_arm_the_findings_and_one_diagram_for_each_quantity(worn: Path) -> None:
    reader = RrdReader(worn)
    (store,) = reader.blueprints()
    views: dict[str, str] = {}
    for chunk in reader.stream(store=store).to_chunks():
        columns = chunk.to_record_batch().to_pydict()
        if "ViewBlueprint:space_origin" in columns:
            ((origin,),), ((name,),) = columns["ViewBlueprint:space_origin"], columns["ViewBlueprint:display_name"]
            views[origin.lstrip("/")] = name
    assert views == {
        "arm": "Arm",
        "findings": "Findings",
        "position": "Position, rad",
        "velocity": "Velocity, rad/s",
        "torque": "Torque, N m",
        "unexplained": "Unexplained torque, N m",
        "deviations": "Unexplained torque, standard deviations",
    }


def test_the_findings_have_the_verdict_the_errors_and_the_diagnosis(folder: Path, tmp_path: Path) -> None:
    data = armident.read_recording(folder / "sprung.mcap")
    data = replace(data, gaps=(Gap("samples", 100, 101),))
    data.save(tmp_path / "sprung.mcap")
    model = folder / "healthy.identification"
    armident.diagnose(tmp_path / "sprung.mcap").save(tmp_path / "sprung.diagnosis")
    assert call(tmp_path / "sprung.mcap", "--model", model).exit_code == 0
    ((text,),) = entities(tmp_path / "sprung.view" / "rerun.rrd")["findings"]["TextDocument:text"]
    prediction = armident.predict(data, model)
    error = prediction.relative_error_pct
    for words in (
        "# emps: sprung.mcap",
        "1 gaps",
        "doubtful: ",
        f"Torque error {error:.2f} %",
        "## Diagnosis: ",
        "spring",
    ):
        assert words in text


def test_a_model_beside_the_recording_is_used_and_without_one_only_signals_are_shown(
    folder: Path, tmp_path: Path
) -> None:
    assert "deviations/joint_1" in entities_of(folder / "healthy.mcap", tmp_path / "with.rrd")
    done = call(folder / "sprung.mcap", "--out", tmp_path / "without.rrd")
    assert "no model, so only measured signals: give --model, or run armident identify first" in done.stderr
    assert "no URDF: the arm is shown as lines between its joints; --urdf FILE shows its links" in done.stderr
    found = entities(tmp_path / "without.rrd")
    assert {path for path in found if path.split("/")[0] in QUANTITIES} == {
        "position/joint_1", "velocity/joint_1", "torque/joint_1/measured",
    }  # fmt: skip
    assert "time" not in found["arm/joint_1/axis"]


def entities_of(data: Path, file: Path) -> dict[str, dict[str, list[Any]]]:
    """The entities of a view, which is written to a file."""
    assert call(data, "--out", file).exit_code == 0
    return entities(file)


def test_a_long_recording_keeps_its_extremes_and_little_else(tmp_path: Path) -> None:
    t = np.arange(300_000) / 1000.0
    torque = 50.0 * np.cos(3.0 * t)
    torque[123_456] = 99.0
    Recording.from_arrays(t, 0.1 * np.sin(3.0 * t), torque, robot="emps").save(tmp_path / "long.mcap")
    found = entities_of(tmp_path / "long.mcap", tmp_path / "long.rrd")
    for path in ("position/joint_1", "velocity/joint_1", "torque/joint_1/measured"):
        assert 0.9 * POINTS * (path[0] != "v") <= curve(found[path])[1].size <= POINTS
    times, values = curve(found["torque/joint_1/measured"])
    assert values.max() == pytest.approx(99.0)
    assert (times[np.argmax(values)] - times[0]) * 1e-9 == pytest.approx(123.456, abs=1e-6)
    assert len(found["arm/joint_1"]["time"]) <= POINTS
    # Velocities follow from positions, as means over the time between two poses.
    assert np.abs(curve(found["velocity/joint_1"])[1]).max() == pytest.approx(0.3, rel=0.01)
    # A curve of an hour is as large: 36 of them for six axes, and six poses.
    assert 10 * (tmp_path / "long.rrd").stat().st_size < 30e6


def test_foxglove_gets_the_same_arm_curves_and_colours(folder: Path, worn: Path, tmp_path: Path) -> None:
    words = ("--model", folder / "tx40.json", "--urdf", folder / "tx40.urdf", "--viewer", "foxglove")
    done = call(folder / "worn.mcap", *words, "--out", tmp_path / "worn.json")
    assert done.exit_code == 0, done.output
    ours, found = entities(worn), messages(tmp_path / "worn.mcap")
    assert {name for topic in ("/arm/links", "/arm/joints") for _, name, _ in found[topic]} == {"foxglove.SceneUpdate"}
    assert {name for _, name, _ in found["/arm/transforms"]} == {"foxglove.FrameTransforms"}
    for quantity in ("position/joint_6", "torque/joint_2/predicted", "deviations/joint_2"):
        times, values = curve(ours[quantity])
        points = [(at, message["value"]) for at, _, message in found[f"/{quantity}"]]
        np.testing.assert_allclose(np.array(points), np.column_stack([times, values]), rtol=1e-8)
    frames = ["base", *(f"joint_{k}" for k in range(1, 7))]
    assert len(found["/arm/transforms"]) == len(ours["arm/joint_1"]["time"])
    last = found["/arm/transforms"][-1][2].transforms
    assert [(each.parent_frame_id, each.child_frame_id) for each in last] == list(pairwise(frames))
    path = "arm"
    for each in last:
        path += f"/{each.child_frame_id}"
        place, turn = each.translation, each.rotation
        (expected,), (turned,) = (ours[path][f"Transform3D:{kind}"][-1] for kind in ("translation", "quaternion"))
        np.testing.assert_allclose([place.x, place.y, place.z], expected, atol=1e-6)
        np.testing.assert_allclose([turn.x, turn.y, turn.z, turn.w], turned, atol=1e-6)
    joint = shades(ours["arm/joint_1/joint_2/axis"])
    seen = [message.entities[1] for _, _, message in found["/arm/joints"]]
    assert {each.frame_id for each in seen} == {"joint_2"}
    colour = [each.cylinders[0].color for each in seen]
    np.testing.assert_allclose([[c.r, c.g, c.b, c.a] for c in colour], joint / 255)
    (links,) = (message for _, _, message in found["/arm/links"])
    assert [len(entity.triangles[0].points) % 3 for entity in links.entities] == [0] * 7


def test_the_layout_names_topics_and_fields_of_the_data_and_of_the_recording(folder: Path, tmp_path: Path) -> None:
    assert call(folder / "healthy.mcap", "--viewer", "foxglove", "--out", tmp_path / "a.json").exit_code == 0
    panels = json.loads((tmp_path / "a.json").read_text())
    data = messages(tmp_path / "a.mcap")
    with (folder / "healthy.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    recorded = {channel.topic for channel in summary.channels.values()}
    config, arranged = panels["configById"], []

    def walk(part: Any) -> None:
        if isinstance(part, str):
            arranged.append(part)
        else:
            walk(part["first"])
            walk(part["second"])

    walk(panels["layout"])
    assert sorted(arranged) == sorted(config)
    paths = [path["value"] for panel in config.values() for path in panel.get("paths", [])]
    assert {path.partition(".")[0] for path in paths} == {topic for topic in data if not topic.startswith("/arm/")}
    assert all("value" in data[path.partition(".")[0]][0][2] and path.endswith(".value") for path in paths)
    assert set(config["3D!arm"]["topics"]) | {"/arm/transforms"} == {t for t in data if t.startswith("/arm/")}
    assert {panel["topicPath"] for panel in config.values() if "topicPath" in panel} <= recorded
    assert config["3D!arm"]["followTf"] == "base"


@pytest.mark.parametrize(
    ("words", "code", "line"),
    [
        (("nothing.mcap",), 2, "nothing.mcap: no such recording"),
        (("healthy.mcap", "--out", "tx40.urdf"), 2, "--out tx40.urdf: expected a name that ends in .rrd"),
        (
            ("healthy.mcap", "--out", "a.rrd", "--viewer", "foxglove"),
            2,
            "--out a.rrd: expected a name that ends in .json",
        ),
        (
            ("healthy.mcap", "--out", "worn.json", "--viewer", "foxglove"),
            2,
            "--out worn.json: worn.mcap exists already: give another name, or remove it",
        ),
        (("healthy.mcap", "--urdf", "none.urdf"), 2, "--urdf: none.urdf: no such file"),
        (("healthy.mcap", "--urdf", "tx40.json"), 2, "tx40.json: not valid XML"),
        (("healthy.mcap", "--model", "none"), 2, "none: no such file"),
        (("healthy.mcap", "--model", "tx40.json"), 3, "the recording is of robot 'emps', the configuration describes"),
        (("healthy.mcap", "--config", "tx40.yaml"), 3, "the recording is of robot 'emps', the configuration describes"),
        (("torn.mcap", "--out", "torn.rrd"), 3, "truncated before its first chunk, or its head is damaged"),
        (("healthy.mcap", "--out", "tx40.json/a.rrd"), 2, "--out tx40.json/a.rrd: cannot be written: "),
    ],
)
def test_a_mistake_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], code: int, line: str
) -> None:
    (folder / "torn.mcap").write_bytes((folder / "healthy.mcap").read_bytes()[:3000])
    monkeypatch.chdir(folder)
    done = call(*words)
    last = done.stderr.splitlines()[-1]
    assert (done.exit_code, last.startswith("armident: ")) == (code, True)
    assert line in last
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_a_missing_extra_is_named_before_anything_is_computed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRAS, "viewer", ("no_such_module",))
    done = call(folder / "healthy.mcap")
    assert done.exit_code == 2
    assert done.stderr == "armident: armident view needs extra packages: pip install 'armident[viewer]'\n"


def test_a_torn_recording_is_shown_up_to_its_last_whole_chunk(folder: Path, tmp_path: Path) -> None:
    whole = (folder / "healthy.mcap").read_bytes()
    (tmp_path / "torn.mcap").write_bytes(whole[: len(whole) // 2])
    done = call(tmp_path / "torn.mcap", "--out", tmp_path / "torn.rrd")
    assert done.exit_code == 0
    assert "torn.mcap: torn: the file was not finished" in done.stderr
    rows = armident.read_recording(tmp_path / "torn.mcap").samples.sync.size
    assert curve(entities(tmp_path / "torn.rrd")["position/joint_1"])[1].size == min(rows, POINTS)


def test_an_unusable_model_beside_the_recording_is_left_out_with_its_reason(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes((folder / "healthy.mcap").read_bytes())
    document = json.loads((folder / "healthy.identification" / "identification.json").read_text())
    document["verdict"], document["reasons"][0]["level"] = "unusable", "unusable"
    (tmp_path / "a.identification").mkdir()
    (tmp_path / "a.identification" / "identification.json").write_text(json.dumps(document))
    done = call(tmp_path / "a.mcap")
    assert done.exit_code == 0
    assert "only measured signals: " in done.stderr
    assert "the model is unusable: " in done.stderr
