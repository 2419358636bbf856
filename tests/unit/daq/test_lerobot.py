"""LeRobot data sets: files, names of joints, and damaged parts."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armident.configs import ConfigError, DataError
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.lerobot import calibrated
from tests.unit.daq.tables import N, lerobot, motion, same
from tests.unit.daq.test_importing import TX40


@pytest.mark.parametrize("names", [None, [f"joint_{j + 1}.pos" for j in range(N)]])
def test_a_lerobot_data_set_is_imported_as_file_and_folder(tmp_path: Path, names: list[str] | None) -> None:
    data = lerobot(tmp_path / "set", names)
    for path in (data, tmp_path / "set"):
        found = import_recording(path, TX40)
        assert same(found, motion(300, 50.0))
        assert found.sample_rate_hz == pytest.approx(50, rel=1e-4)
        assert [(gap.first, gap.last) for gap in found.gaps if gap.stream == "samples"] == [(200, 204)]
        assert "demand" in found.samples.fields
        assert "2 episodes" in found.metadata["source_remarks"]


def test_short_episodes_are_identified_one_by_one(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    from armident.identify.identification.from_recording import experiments_from_recording

    data = lerobot(tmp_path / "a", None)
    table = pyarrow.parquet.read_table(data).drop_columns("episode_index")
    episodes = pyarrow.array(np.repeat(np.arange(3), 100))
    pyarrow.parquet.write_table(table.append_column("episode_index", episodes), data)
    experiments, notes = experiments_from_recording(import_recording(tmp_path / "a", TX40), TX40)
    assert [len(one.q) for one in experiments] == [100, 100, 100]
    assert "10 of 310 samples missing: 3 pieces" in " ".join(notes)


def test_joints_of_a_lerobot_data_set_are_found_by_name_and_its_effort_is_needed(tmp_path: Path) -> None:
    lerobot(tmp_path / "a", [f"joint_{j}.pos" for j in (2, 1, 3, 4, 5, 6)])
    found = import_recording(tmp_path / "a", TX40)
    assert np.allclose(found.samples.raw["position"][:, [1, 0, 2]], motion(300, 50.0)[:, 1:4])
    data = lerobot(tmp_path / "b", None, "observation.temperature")
    with pytest.raises(DataError, match=r"no effort or current .*found observation\.state, action, observation\.temp"):
        import_recording(data, TX40)
    lerobot(tmp_path / "c", None, "observation.current")
    assert "current" in import_recording(tmp_path / "c", TX40).samples.fields


def test_names_of_efforts_in_a_lerobot_data_set_find_their_joints(tmp_path: Path) -> None:
    order = (2, 1, 3, 4, 5, 6)
    lerobot(tmp_path / "a", [f"joint_{j}.pos" for j in order])
    info = tmp_path / "a" / "meta" / "info.json"
    features = json.loads(info.read_text())["features"]
    unnamed = import_recording(tmp_path / "a", TX40)
    assert "observation.effort has no names of joints: taken in the order" in unnamed.metadata["source_remarks"]
    effort = {"names": [f"joint_{j}.effort" for j in range(1, N + 1)]}
    info.write_text(json.dumps({"features": features | {"observation.effort": effort}}))
    named = import_recording(tmp_path / "a", TX40)
    assert np.allclose(named.samples.raw["torque"], motion(300, 50.0)[:, N + 1 :])
    assert np.allclose(unnamed.samples.raw["torque"][:, [1, 0]], motion(300, 50.0)[:, N + 1 : N + 3])


def test_files_of_a_lerobot_data_set_that_cannot_be_read_are_left_out_and_named(tmp_path: Path) -> None:
    first = lerobot(tmp_path / "a", None)
    second = first.with_name("file-001.parquet")
    second.write_bytes(first.read_bytes()[:500])
    for folder in (tmp_path / "a", tmp_path / "a" / "data", first.parent):
        found = import_recording(folder, TX40)
        assert same(found, motion(300, 50.0))
        assert "damaged or cut off left out: file-001.parquet" in found.metadata["source_remarks"]
        assert "no names of joints in meta/info.json: observation.state" in found.metadata["source_remarks"]
    first.write_bytes(second.read_bytes())
    with pytest.raises(DataError, match="none of its 2 Parquet files is readable"):
        import_recording(tmp_path / "a", TX40)
    lerobot(tmp_path / "b", None).rename(second)
    lerobot(tmp_path / "c", None, "observation.temperature").rename(first)
    with pytest.raises(DataError, match=r"file-000\.parquet: no column observation\.effort, which other files"):
        import_recording(tmp_path / "a", TX40)


def test_a_lerobot_data_set_of_actions_alone_is_named(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    data = lerobot(tmp_path / "a", None)
    pyarrow.parquet.write_table(pyarrow.parquet.read_table(data).drop(["observation.state"]), data)
    with pytest.raises(DataError, match=r"no observation\.state, the measured positions; found action"):
        import_recording(data, TX40)


def test_times_of_a_lerobot_data_set_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    data = lerobot(tmp_path, None)
    table = pyarrow.parquet.read_table(data)
    times = pyarrow.array([{"s": 1}] * len(table))
    table = table.set_column(table.column_names.index("timestamp"), "timestamp", times)
    pyarrow.parquet.write_table(table, data)
    with pytest.raises(DataError, match="timestamp has rows of unequal lengths, or values that are no numbers"):
        import_recording(data, TX40)


def _exchanged(table: dict[str, list[object]]) -> None:
    table["episode_index"] = table.pop("action")


def _immense(table: dict[str, list[object]]) -> None:
    table["observation.effort"][46] = [1.0, 1.0, 1.0, 1e308, 1.0, 1.0]


def _without_episodes(table: dict[str, list[object]]) -> None:
    table["episode_index"] = [None] * len(table["timestamp"])
    table["timestamp"][19] = -1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_exchanged, "episode_index has values that are no numbers, or not one for every timestamp"),
        (_immense, r"1e\+308"),
        (_without_episodes, "episode_index has values that are no numbers"),
    ],
)
def test_columns_of_a_lerobot_data_set_with_odd_values_are_refused_in_one_line(
    tmp_path: Path, change: Callable[[dict[str, list[object]]], None], words: str
) -> None:
    import pyarrow
    import pyarrow.parquet

    data = lerobot(tmp_path / "a", [f"joint_{j + 1}.pos" for j in range(N)])
    table = pyarrow.parquet.read_table(data).to_pydict()
    change(table)
    pyarrow.parquet.write_table(pyarrow.table(table), data)
    with pytest.raises(DataError, match=words) as caught:
        import_recording(tmp_path / "a", TX40)
    assert "\n" not in str(caught.value)


NAMES = [f"joint_{j + 1}.pos" for j in range(N)]
MOTORS = {f"joint_{j + 1}": {"id": j + 1, "drive_mode": 0, "range_min": 800 + j, "range_max": 3000} for j in range(N)}


def shares(folder: Path, size: float = 90.0) -> tuple[Path, np.ndarray]:
    """Write a data set whose positions are shares of the ranges in `MOTORS`; return it and its positions in rad."""
    import pyarrow
    import pyarrow.parquet

    data = lerobot(folder, NAMES)
    table = pyarrow.parquet.read_table(data)
    state = np.array(table["observation.state"].to_pylist())
    recorded = size * state / np.abs(state).max(axis=0)
    # A count of a STS3215 is 2 pi / 4096; -100 and 100 are the ends of the range.
    ends = np.array([(motor["range_min"], motor["range_max"]) for motor in MOTORS.values()])
    counts = ends[:, 0] + (recorded + 100) / 200 * (ends[:, 1] - ends[:, 0])
    for column in ("observation.state", "action"):
        place = table.column_names.index(column)
        table = table.set_column(place, column, pyarrow.array(recorded.tolist()))
    pyarrow.parquet.write_table(table, data)
    return folder, (counts - ends.mean(axis=1)) * 2 * np.pi / 4096


def test_shares_of_a_range_are_named_and_converted_by_the_calibration(tmp_path: Path) -> None:
    folder, q = shares(tmp_path / "set")
    with pytest.raises(
        DataError, match=r"-100 to 100 of each joint's calibrated range.*FILE\.json.*deg only with use_deg"
    ):
        import_recording(folder, TX40)
    calibration = tmp_path / "my_arm.json"
    calibration.write_text(json.dumps(MOTORS))
    found = import_recording(folder, TX40, units={"position": str(calibration)})
    np.testing.assert_allclose(found.samples.raw["position"], q, atol=1e-9)
    np.testing.assert_allclose(found.samples.raw["demand"], q, atol=1e-9)
    assert "shares of the ranges in my_arm.json (--units): 0 is their middle" in found.metadata["source_remarks"]
    degrees = import_recording(folder, TX40, units={"position": "deg"})
    assert "right only if the arm was recorded with use_degrees" in degrees.metadata["source_remarks"]


def test_a_gripper_is_recorded_from_0_to_100(tmp_path: Path) -> None:
    gripper = TX40.model_copy(update={"joints": (TX40.joints[0].model_copy(update={"name": "gripper"}),)})
    calibration = tmp_path / "my_arm.json"
    calibration.write_text(json.dumps({"gripper": {"range_min": 2000, "range_max": 3024}}))
    factors, offsets = calibrated(calibration, ["gripper/position"], gripper)
    np.testing.assert_allclose(np.array([0, 50, 100]) * factors + offsets, np.pi / 2 * np.array([-0.5, 0, 0.5]))


def test_degrees_alone_are_advised_only_where_shares_are_impossible(tmp_path: Path) -> None:
    folder, _ = shares(tmp_path / "set", 130.0)
    with pytest.raises(DataError, match=r"values beyond 100 are degrees .*--units position=deg reads them"):
        import_recording(folder, TX40)
    calibration = tmp_path / "my_arm.json"
    calibration.write_text(json.dumps(MOTORS))
    with pytest.raises(DataError, match="positions reach 130, but shares of a range only 100"):
        import_recording(folder, TX40, units={"position": str(calibration)})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read: No such file"),
        ("{", "not JSON, as a calibration of LeRobot is"),
        ("[]", "no range_min below range_max of joint_1; found"),
        (json.dumps(MOTORS | {"joint_3": {"range_min": 5, "range_max": 5}}), "no range_min below range_max of joint_3"),
        (
            json.dumps(MOTORS | {"joint_2": {"range_min": "5", "range_max": 9}}),
            "no range_min below range_max of joint_2",
        ),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused_in_one_line(tmp_path: Path, text: str | None, words: str) -> None:
    folder, _ = shares(tmp_path / "set")
    calibration = tmp_path / "my_arm.json"
    if text is not None:
        calibration.write_text(text)
    with pytest.raises(ConfigError, match=words):
        import_recording(folder, TX40, units={"position": str(calibration)})


def test_efforts_in_the_state_of_a_lerobot_data_set_are_found_by_name(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    data = lerobot(tmp_path / "a", [f"joint_{j + 1}.{q}" for j in range(N) for q in ("pos", "vel", "torque")])
    values = motion(300, 50.0)
    state = np.stack([values[:, 1 : N + 1], 0.0 * values[:, 1 : N + 1], values[:, N + 1 :]], axis=2).reshape(300, -1)
    table = pyarrow.parquet.read_table(data).drop_columns(["observation.effort", "observation.state"])
    pyarrow.parquet.write_table(table.append_column("observation.state", pyarrow.array(state.tolist())), data)
    found = import_recording(tmp_path / "a", TX40)
    assert same(found, values)
    assert "demand" in found.samples.fields
    assert "positions are taken as rad; LeRobot's default is" in found.metadata["source_remarks"]


def test_counts_and_milliamperes_of_a_lerobot_data_set_are_named(tmp_path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    data = lerobot(tmp_path / "a", None, "observation.current")
    table = pyarrow.parquet.read_table(data)
    for column, factor, zero, said in (
        ("observation.state", 4096 / 6.283, 2048, "counts of the servos have to be converted"),
        ("observation.current", 1000.0, 0, "--units current=ma if they are in ma at all joints"),
    ):
        values = (np.stack(table[column].to_numpy()) * factor + zero).tolist()
        place = table.schema.get_field_index(column)
        pyarrow.parquet.write_table(table.set_column(place, column, pyarrow.array(values)), data)
        with pytest.raises(DataError, match=said):
            import_recording(data, TX40)
