"""Import and export: numbers survive the round trip, and every error has one clear line."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from armident.configs import ConfigError, DataError, RobotConfig, load_robot
from armident.daq.interchange.exporting import export_recording, exported_columns
from armident.daq.interchange.importing import import_recording
from armident.daq.recording import Field, Recording, Stream, read_recording, write_recording
from armident.daq.recording.model import Quantity

TX40 = load_robot("tx40.yaml")
HEADER = ",".join(["t", *(f"q{j}" for j in range(1, 7)), *(f"tau{j}" for j in range(1, 7))])


def table(rows: int = 50) -> np.ndarray:
    rng = np.random.default_rng(3)
    t = np.arange(rows) / 1000.0
    return np.column_stack([t, rng.uniform(-1, 1, (rows, 6)), rng.uniform(-5, 5, (rows, 6))])


def write_csv(path: Path, values: np.ndarray, header: str = HEADER) -> Path:
    np.savetxt(path, values, fmt="%.17g", delimiter=",", header=header, comments="")
    return path


def test_a_csv_becomes_a_recording_with_its_numbers(tmp_path: Path) -> None:
    values = table()
    recording = import_recording(write_csv(tmp_path / "a.csv", values), TX40)
    assert recording.sample_rate_hz == pytest.approx(1000.0, rel=1e-12)
    assert np.array_equal(recording.samples.raw["position"], values[:, 1:7])
    assert np.array_equal(recording.samples.raw["torque"], values[:, 7:])
    assert recording.samples.fields["torque"].side == "joint"


@pytest.mark.parametrize("kind", ["csv", "npz", "mat", "parquet", "mcap"])
def test_export_and_import_are_inverse(tmp_path: Path, kind: str) -> None:
    recording = import_recording(write_csv(tmp_path / "a.csv", table()), TX40)
    export_recording(recording, tmp_path / f"b.{kind}")
    again = import_recording(tmp_path / f"b.{kind}", TX40)
    assert again.sha256 == recording.sha256


ARM = TX40.model_copy(
    update={
        "joints": tuple(
            joint.model_copy(update={"name": f"axis_{k}", "source_name": name, "type": kind})
            for joint, k, name, kind in zip(
                TX40.joints[:2], (1, 2), ('rail, "x"', "Schwenk-Achse"), ("prismatic", "revolute"), strict=True
            )
        ),
        "transmission": None,
        "couplings": (),
        "initial_parameters": {},
    }
)
TITLES = {
    "t": "s since 2026-03-25T10:00:00.123456789Z",
    'rail, "x"/position': "m",
    "Schwenk-Achse/position": "rad",
    'rail, "x"/torque': "N",
    "Schwenk-Achse/torque": "N m",
    'rail, "x"/demand': "m",
    "Schwenk-Achse/demand": "rad",
}


def stamped(robot: RobotConfig, start_ns: int) -> Recording:
    """Two joints with a demand, whose first sample is that of SYNC 3; ``start_ns``: stamp of SYNC 0."""
    rng = np.random.default_rng(1)
    sync = np.arange(3, 53)
    q = 0.1 * np.sin(0.02 * sync[:, None] + np.arange(2))
    values: dict[Quantity, np.ndarray] = {"position": q, "torque": rng.uniform(-5, 5, (50, 2)), "demand": q + 1e-3}
    fields = {str(name): Field(name, name, "", "joint", (1.0, 1.0)) for name in values}
    raw = {str(name): array for name, array in values.items()}
    stream = Stream("samples", 1, sync, start_ns + sync * 1_000_000, fields, raw)
    return Recording(None, robot, None, 1000.0, {"samples": stream})


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_tables_have_joints_units_and_dates_that_an_import_reads(tmp_path: Path, kind: str) -> None:
    start_ns = 1_774_432_800_123_456_789
    recording = stamped(ARM, start_ns)
    path = tmp_path / f"a.{kind}"
    export_recording(recording, path)
    if kind == "csv":
        with path.open(newline="") as file:
            assert next(csv.reader(file)) == [f"{name} [{unit}]" for name, unit in TITLES.items()]
    else:
        schema = parquet.read_schema(path)
        assert {each.name: each.metadata[b"unit"].decode() for each in schema} == TITLES
        about = {b"robot": b"tx40", b"sample_rate_hz": b"1000", b"utc": b"2026-03-25T10:00:00.123456789Z"}
        assert about.items() <= schema.metadata.items()
    # The joints in the other order: names decide, not places.
    turned = ARM.model_copy(update={"joints": ARM.joints[::-1]})
    for robot, order in ((ARM, [0, 1]), (turned, [1, 0])):
        again = import_recording(path, robot)
        for name in ("position", "torque", "demand"):
            assert np.array_equal(again.samples.raw[name], recording.samples.raw[name][:, order])
        assert again.samples.t_ns[0] == start_ns + 3_000_000
        assert np.abs(again.samples.t_ns - recording.samples.t_ns).max() <= 1
        assert "source_remarks" not in again.metadata


def test_names_that_an_import_takes_for_other_columns_are_numbers(tmp_path: Path) -> None:
    """Joints called ``reference`` and ``torque_joint``, in a recording whose stamps are those of no clock."""
    joints = zip(ARM.joints, ("reference", "torque_joint"), strict=True)
    update = {"joints": tuple(joint.model_copy(update={"source_name": name}) for joint, name in joints)}
    recording = stamped(ARM.model_copy(update=update), 0)
    export_recording(recording, tmp_path / "a.csv")
    header = (tmp_path / "a.csv").read_text().splitlines()[0]
    assert header == "t [s],q1 [m],q2 [rad],tau1 [N],tau2 [N m],qr1 [m],qr2 [rad]"
    again = import_recording(tmp_path / "a.csv", recording.robot)
    assert np.array_equal(again.samples.raw["demand"], recording.samples.raw["demand"])
    assert again.samples.t_ns[0] == 0


def test_export_converts_the_coupled_wrist_to_the_joints(tmp_path: Path) -> None:
    values = table()
    q, tau = values[:, 1:7], values[:, 7:]
    motors = values.copy()
    motors[:, 1:7] = q @ TX40.transmission_matrix.T
    motors[:, 7:] = tau @ np.linalg.inv(TX40.transmission_matrix)
    recording = import_recording(write_csv(tmp_path / "m.csv", motors), TX40, motor_side=True)
    out = exported_columns(recording)
    assert np.allclose(np.column_stack([out[f"q{j}"] for j in range(1, 7)]), q, rtol=0, atol=1e-12)
    assert np.allclose(np.column_stack([out[f"tau{j}"] for j in range(1, 7)]), tau, rtol=0, atol=1e-12)


def broken(what: str, path: Path) -> Path:
    values, header = table(), HEADER
    if what == "nan":
        values[10:18:2, 3] = np.nan
    elif what == "back":
        values[20:, 0] -= 0.01
    elif what == "uneven":
        values[20:, 0] += np.linspace(0, 0.01, 30)
    elif what == "missing":
        values, header = np.delete(values, 6, axis=1), header.replace(",q6", "")
    elif what == "degrees":
        values[:, 1:7] = np.rad2deg(values[:, 1:7])
    elif what == "no effort":
        values, header = values[:, :7], ",".join(header.split(",")[:7])
    elif what == "no header":
        np.savetxt(path, values, delimiter=",")
        return path
    write_csv(path, values, header)
    if what == "word":
        lines = path.read_text().splitlines()
        lines[5:9] = ["x" + line for line in lines[5:9]]
        path.write_text("\n".join(lines))
    if what == "ragged":
        lines = path.read_text().splitlines()
        lines[5:9] = [line + ",1" for line in lines[5:9]]
        path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize(
    ("what", "words"),
    [
        ("nan", r"a\.csv: line 12, column q3: nan is not a number \(and 3 more of 50 rows\)"),
        ("back", r"a\.csv: line 22, column t: time does not increase"),
        ("uneven", r"a\.csv: the times jitter: steps of 0\.001 to .*; --resample .* even clock$"),
        ("missing", r"a\.csv: no column q6"),
        ("degrees", r"a\.csv: position of joint_1 reaches .* expected rad"),
        ("no effort", r"a\.csv: expected columns q1\.\.q6 and tau1\.\.tau6"),
        ("no header", r"a\.csv: no header line"),
        ("word", r"a\.csv: line 6, column 1: expected a number, found 'x.* \(and 3 more of 50 lines\)"),
        ("ragged", r"a\.csv: line 6 has 14 columns, expected 13"),
    ],
)
def test_an_invalid_csv_is_reported_in_one_line(tmp_path: Path, what: str, words: str) -> None:
    with pytest.raises(DataError, match=words) as caught:
        import_recording(broken(what, tmp_path / "a.csv"), TX40)
    assert "\n" not in str(caught.value)


def test_a_file_of_another_robot_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"has a column q2, but the robot has 1 joints"):
        import_recording(write_csv(tmp_path / "a.csv", table()), load_robot("emps.yaml"))


def test_unknown_formats_and_missing_files_are_configuration_errors(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        import_recording(tmp_path / "a.csv", TX40)
    (tmp_path / "a.xls").write_text("")
    with pytest.raises(ConfigError, match=r"cannot read \.xls; readable: CSV \(\.csv, .*bus log \(\.log"):
        import_recording(tmp_path / "a.xls", TX40)
    with pytest.raises(ConfigError, match="no quantity named 'speed'"):
        import_recording(write_csv(tmp_path / "b.csv", table()), TX40, names={"speed": "v"})


def test_the_emps_file_is_imported_by_its_own_names(shared_data: Path) -> None:
    recording = import_recording(shared_data / "emps" / "DATA_EMPS.mat", load_robot("emps.yaml"))
    assert recording.samples.sync.size == 24_841
    assert recording.sample_rate_hz == pytest.approx(1000.0, rel=1e-4)
    assert set(recording.samples.fields) == {"position", "voltage", "demand"}
    assert recording.samples.fields["voltage"].side == "motor"


def test_the_measured_tx40_is_imported_from_a_pair_of_files(shared_data: Path, tmp_path: Path) -> None:
    tx40 = shared_data / "tx40"
    recording = import_recording(
        tx40 / "pos_read_data.csv", TX40, effort=tx40 / "curr_data.csv", motor_side=True, rate_hz=5000.0
    )
    assert recording.samples.raw["position"].shape == (45_000, 6)
    assert recording.samples.raw["torque"][1, 1] == -0.84434
    write_recording(recording, tmp_path / "tx40.mcap")
    assert read_recording(tmp_path / "tx40.mcap").sha256 == recording.sha256


PANDA = load_robot("panda.yaml")


def moving_panda(rate_hz: float = 1000.0, seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and torques (N, 7) of a motion that begins at standstill."""
    t = np.arange(0.0, seconds, 1 / rate_hz)[:, None]
    share = np.clip(t - 0.2, 0.0, 1.0)
    phase = np.arange(7.0)
    return 0.5 * share**2 * (3 - 2 * share) * np.sin(3 * t + phase) + [0, 0, 0, -1.5, 0, 1.5, 0], 5.0 * np.cos(
        2 * t + phase
    )


def test_polled_rows_are_resampled_onto_the_clock_of_the_controller(tmp_path: Path) -> None:
    q, tau = moving_panda()
    rng = np.random.default_rng(5)
    # Rows of a program that polls too early or too late: one in 15 repeated, one in 12 missed, a stall of 8.
    asked = np.sort(np.append(np.arange(len(q)), rng.integers(0, len(q), len(q) // 15)))
    missed = rng.random(len(asked)) < 1 / 12
    missed[2000:2008] = True
    missed[[0, -1]] = False
    rows = asked[~missed]
    for name, values in (("q", q), ("tau", tau)):
        np.savetxt(tmp_path / f"{name}.txt", values[rows].ravel(), fmt="%.6g")
    recording = import_recording(tmp_path / "q.txt", PANDA, effort=tmp_path / "tau.txt", rate_hz=1000.0, polled=True)
    samples = recording.samples.raw
    # Standstill at the beginning has no time information: rows missed or repeated in 0.2 s shift the rest.
    lag = len(samples["position"]) - len(q)
    assert abs(lag) < 30
    late, size = slice(1000, 3900), slice(1000 + lag, 3900 + lag)
    # 1e-5, since six digits were written.
    assert np.abs(samples["position"][size] - q[late]).max() < 2e-5
    assert np.abs(samples["torque"][size] - tau[late]).max() < 1e-3
    assert int(recording.metadata["polled.repeated"]) + int(recording.metadata["polled.interpolated"]) > 300


def test_rows_without_an_even_clock_are_refused(tmp_path: Path) -> None:
    q, tau = moving_panda()
    t = np.sort(np.random.default_rng(1).uniform(0.0, 4.0, len(q)))
    for name, values in (("q", q), ("tau", tau)):
        even = np.arange(len(q)) / 1000.0
        np.savetxt(tmp_path / f"{name}.txt", np.stack([np.interp(t, even, v) for v in values.T], axis=1))
    with pytest.raises(DataError, match=r"q\.txt: \d+ % of the rows do not fit an even clock"):
        import_recording(tmp_path / "q.txt", PANDA, effort=tmp_path / "tau.txt", rate_hz=1000.0, polled=True)
    with pytest.raises(ConfigError, match="--polled: needs --rate"):
        import_recording(tmp_path / "q.txt", PANDA, effort=tmp_path / "tau.txt", polled=True)
    for name in ("q", "tau"):
        np.savetxt(tmp_path / f"{name}.txt", np.zeros((100, 7)))
    with pytest.raises(DataError, match=r"only 1 of 100 rows differ"):
        import_recording(tmp_path / "q.txt", PANDA, effort=tmp_path / "tau.txt", rate_hz=1000.0, polled=True)


def test_a_demand_in_another_unit_is_refused_unless_omitted(tmp_path: Path) -> None:
    q, tau = moving_panda()
    path = tmp_path / "a.npz"
    np.savez(path, positions=q, torques=tau, target_positions=np.deg2rad(q))
    with pytest.raises(DataError, match=r"joint_1 moved by .*, but its demand by .*--map demand=-"):
        import_recording(path, PANDA, rate_hz=1000.0)
    recording = import_recording(path, PANDA, rate_hz=1000.0, names={"demand": "-"})
    assert set(recording.samples.fields) == {"position", "torque"}
    # A joint that lags behind fast moves, and one that gives way under a demand that rests, are no other unit.
    resting = q + 0.01
    resting[:, 6] = 0.5
    resting[:, 0] = np.roll(q[:, 0], 400)
    largest = q[:, np.argmax(np.ptp(q[:, :6], axis=0))]
    for share in (0.25, 0.75):
        q[:, 6] = share * (largest - largest.mean()) + 0.5
        np.savez(path, positions=q, torques=tau, target_positions=resting)
        if share < 0.5:
            assert "demand" in import_recording(path, PANDA, rate_hz=1000.0).samples.fields
    with pytest.raises(DataError, match=r"joint_7 moved by .*, but its demand by 0"):
        import_recording(path, PANDA, rate_hz=1000.0)


@pytest.mark.parametrize("kind", ["csv", "npz", "mat", "parquet"])
def test_a_demand_shorter_than_the_samples_survives_the_round_trip(tmp_path: Path, kind: str) -> None:
    """Like the demand of every capture, which is on every fifth SYNC."""
    values = table()
    demand = values[:, 1:7] + 0.001
    demand[:4], demand[-3:] = np.nan, np.nan
    header = HEADER + "," + ",".join(f"qr{j}" for j in range(1, 7))
    whole = write_csv(tmp_path / "a.csv", np.column_stack([values, demand]), header)
    recording = import_recording(whole, TX40)
    assert np.array_equal(recording.samples.raw["position"], values[:, 1:7])
    assert np.array_equal(recording.streams["demand"].sync, np.arange(4, 47))
    assert np.array_equal(recording.streams["demand"].raw["demand"], demand[4:-3])
    assert recording.counters["samples.rows"] == 50
    assert recording.counters["demand.rows"] == 43
    export_recording(recording, tmp_path / f"b.{kind}")
    assert import_recording(tmp_path / f"b.{kind}", TX40).sha256 == recording.sha256
    with pytest.raises(DataError, match="--polled needs a demand in every row"):
        import_recording(whole, TX40, rate_hz=1000.0, polled=True)
    demand[20, 2] = np.nan
    holed = write_csv(tmp_path / "c.csv", np.column_stack([values, demand]), header)
    with pytest.raises(DataError, match=r"c\.csv: line 22, column qr3: nan is not a number"):
        import_recording(holed, TX40)


def test_a_recording_without_samples_is_not_exported(tmp_path: Path) -> None:
    recording = import_recording(write_csv(tmp_path / "a.csv", table()), TX40)
    samples = recording.samples
    empty = type(samples)(
        "samples", 1, samples.sync[:0], samples.t_ns[:0], samples.fields, {k: v[:0] for k, v in samples.raw.items()}
    )
    with pytest.raises(DataError, match="no samples"):
        exported_columns(Recording(None, TX40, None, 1000.0, {"samples": empty}))


def test_columns_of_different_lengths_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    columns: dict[str, Any] = {f"{name}{j}": np.zeros(60) for name in ("q", "tau") for j in range(1, 7)}
    np.savez(path, **{"t": np.arange(60) / 100, **columns, "q6": np.zeros(64)})
    with pytest.raises(DataError, match="q6 has 64 values, q1 has 60"):
        import_recording(path, load_robot("tx40"))


def test_times_that_no_clock_can_have_are_refused(tmp_path: Path) -> None:
    values = table()
    values[-1, 0] = 1e300
    path = write_csv(tmp_path / "a.csv", values, HEADER)
    with pytest.raises(DataError, match=r"time column inconsistent: 50 samples at 0\.\d+ s do not span 1e\+300 s"):
        import_recording(path, TX40)


def test_values_whose_squares_are_no_numbers_are_refused(tmp_path: Path) -> None:
    values = table()
    values[7, 9] = -1e308
    path = write_csv(tmp_path / "a.csv", values, HEADER)
    with pytest.raises(DataError, match=r"a\.csv: line 9, column tau3: -1e\+308 is too large for a measurement"):
        import_recording(path, TX40, resample_hz=1000.0)
