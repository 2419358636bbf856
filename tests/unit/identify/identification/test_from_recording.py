"""Experiments from a recording: conversions, the reference, gaps, and errors."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig, load_robot, load_session
from armident.daq.recording import Field, Mark, Recording, Stream
from armident.identify.identification.from_recording import MAX_MISSING_SHARE, experiments_from_recording, rest_notes

RATE = 5000.0
COUNTS = 1000.0


def field(name: str, quantity: Any, unit: str, side: Any, scale: float, n: int) -> Field:
    return Field(name=name, quantity=quantity, unit=unit, side=side, scale=(scale,) * n)


def recording_of(robot: RobotConfig, *, rows: int = 10_000, every: int = 5, lost: slice = slice(0, 0)) -> Recording:
    """A motion whose joint positions are known, as motor counts and per mille of the rated current."""
    n = robot.n
    sync = np.delete(np.arange(rows), lost)
    t = sync / RATE
    q = 0.5 * np.sin(2 * np.pi * t[:, None] * (1 + np.arange(n)))
    counts = np.rint(q @ robot.transmission_matrix.T * COUNTS).astype(np.int32)
    current = np.rint(100 * np.cos(2 * np.pi * t[:, None] * (1 + np.arange(n)))).astype(np.int16)
    knots = np.arange(0, rows, every)
    demand = np.rint(
        0.5 * np.sin(2 * np.pi * knots[:, None] / RATE) * np.ones(n) @ robot.transmission_matrix.T * COUNTS
    )
    samples = Stream(
        name="samples",
        every=1,
        sync=sync,
        t_ns=(sync * 200_000).astype(np.int64),
        fields={
            "position": field("position", "position", "rad", "motor", 1 / COUNTS, n),
            "current": field("current", "current", "A", "motor", 0.0025, n),
        },
        raw={"position": counts, "current": current},
    )
    reference = Stream(
        name="demand",
        every=every,
        sync=knots,
        t_ns=(knots * 200_000).astype(np.int64),
        fields={"demand": field("demand", "demand", "rad", "motor", 1 / COUNTS, n)},
        raw={"demand": demand.astype(np.int32)},
    )
    return Recording(
        path=None,
        robot=robot,
        session=None,
        sample_rate_hz=RATE,
        streams={"samples": samples, "demand": reference},
        marks=(Mark("experiment_start", 1000, 0), Mark("experiment_end", rows - 1000, 0)),
    )


@pytest.fixture
def tx40() -> RobotConfig:
    return load_robot("tx40.yaml")


def test_positions_come_out_on_the_joint_side_within_a_count(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    (experiment,), _ = experiments_from_recording(recording, tx40)
    t = np.arange(1000, 9001) / RATE
    expected = 0.5 * np.sin(2 * np.pi * t[:, None] * (1 + np.arange(6)))
    # Half a count of the motor over the smallest gear ratio, twice on joint 6 through the coupling.
    assert np.abs(experiment.q - expected).max() <= 2 * 0.5 / COUNTS / 32


def test_torque_of_the_coupled_joint_gets_the_motor_torque_of_its_neighbour(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    (experiment,), _ = experiments_from_recording(recording, tx40)
    current = recording.samples.si("current")[1000:9001]
    np.testing.assert_allclose(experiment.tau[:, 4], 45 * 0.15 * current[:, 4] + 32 * 0.15 * current[:, 5])


def test_power_is_the_same_on_both_sides_of_the_transmission(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    (experiment,), _ = experiments_from_recording(recording, tx40)
    motor_q = recording.samples.si("position")[1000:9001]
    motor_tau = recording.samples.si("current")[1000:9001] * [j.drive.gain for j in tx40.joints]
    np.testing.assert_allclose(
        (experiment.q * experiment.tau).sum(axis=1), (motor_q * motor_tau).sum(axis=1), rtol=0, atol=1e-9
    )


def test_reference_is_the_straight_line_between_set_points(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    (experiment,), _ = experiments_from_recording(recording, tx40)
    assert experiment.q_ref is not None
    knots = experiment.q_ref[::5]
    for offset in range(1, 5):
        between = knots[:-1] + offset / 5 * np.diff(knots, axis=0)
        np.testing.assert_allclose(experiment.q_ref[offset::5][: len(between)], between, rtol=0, atol=1e-12)


def test_samples_outside_the_marks_are_left_out(tx40: RobotConfig) -> None:
    (experiment,), _ = experiments_from_recording(recording_of(tx40), tx40)
    assert len(experiment.q) == 8001


def test_a_short_gap_splits_the_experiment_and_says_so(tx40: RobotConfig) -> None:
    experiments, notes = experiments_from_recording(recording_of(tx40, lost=slice(4000, 4010)), tx40)
    assert [len(e.q) for e in experiments] == [3000, 4991]
    assert any("10 of 8001 samples missing" in note for note in notes)


def test_too_many_missing_samples_are_refused_with_their_number(tx40: RobotConfig) -> None:
    lost = int(MAX_MISSING_SHARE * 8001) + 1
    with pytest.raises(DataError, match=f"{lost} of 8001 samples"):
        experiments_from_recording(recording_of(tx40, lost=slice(4000, 4000 + lost)), tx40)


def test_a_recording_of_another_robot_is_refused_naming_both(tx40: RobotConfig) -> None:
    with pytest.raises(DataError, match=r"'tx40'.*'emps'"):
        experiments_from_recording(recording_of(tx40), load_robot("emps.yaml"))


def test_another_transmission_is_another_robot(tx40: RobotConfig) -> None:
    rows = tx40.transmission_matrix.tolist()
    rows[0][0] = 33.0
    other = tx40.model_copy(update={"transmission": tuple(tuple(row) for row in rows)})
    with pytest.raises(DataError, match="transmission"):
        experiments_from_recording(recording_of(tx40), other)


def test_not_a_number_is_refused_naming_the_joint(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    position = recording.samples.raw["position"].astype(float)
    position[17, 2] = np.nan
    broken = replace(recording.samples, raw={**recording.samples.raw, "position": position})
    with pytest.raises(DataError, match="position of joint_3 is not a number at sample 17"):
        experiments_from_recording(replace(recording, streams={**recording.streams, "samples": broken}), tx40)


def test_what_is_refused_names_its_file(tx40: RobotConfig) -> None:
    recording = replace(recording_of(tx40), path=Path("monday.mcap"))
    with pytest.raises(DataError, match=r"^monday\.mcap: the recording is of robot 'tx40'"):
        experiments_from_recording(recording, load_robot("emps.yaml"))
    begun = {name: replace(stream, sync=stream.sync[:9], raw={k: v[:9] for k, v in stream.raw.items()})
             for name, stream in recording.streams.items()}  # fmt: skip
    torn = replace(recording, streams=begun, counters={}, marks=(), missing="the file was not finished")
    with pytest.raises(DataError, match=r"^monday\.mcap: .*9 samples in all; the file was not finished"):
        experiments_from_recording(torn, tx40)


def test_a_joint_that_stands_still_is_named(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    position = recording.samples.raw["position"].copy()
    position[:, 3] = 0
    still = replace(recording.samples, raw={**recording.samples.raw, "position": position})
    held = replace(recording, streams={**recording.streams, "samples": still})
    experiments, notes = experiments_from_recording(held, tx40)
    (note,) = (note for note in rest_notes(experiments, tx40) if note.startswith("joint_4"))
    assert note.startswith("joint_4 does not move")
    assert note not in notes


def test_currents_are_no_torques_of_a_robot_without_torque_constants() -> None:
    robot = load_robot("ur5e.yaml")  # drive.signal: torque
    recording = recording_of(robot)
    with pytest.raises(DataError, match=r"has a current of each motor, but drive\.signal of ur5e is torque"):
        experiments_from_recording(recording, robot)


def test_degrees_in_place_of_radians_are_noticed(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    position = recording.samples.fields["position"]
    degrees = replace(position, scale=tuple(s * 180 / np.pi for s in position.scale))
    wrong = replace(recording.samples, fields={**recording.samples.fields, "position": degrees})
    _, notes = experiments_from_recording(replace(recording, streams={**recording.streams, "samples": wrong}), tx40)
    assert any("wrong unit" in note for note in notes)


def test_without_a_demand_stream_there_is_no_reference_and_it_says_so(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    (experiment,), notes = experiments_from_recording(replace(recording, streams={"samples": recording.samples}), tx40)
    assert experiment.q_ref is None
    assert any("no reference" in note for note in notes)


def test_counters_that_disagree_with_the_rows_are_refused(tx40: RobotConfig) -> None:
    recording = replace(recording_of(tx40), counters={"samples.rows": 10_001})
    with pytest.raises(DataError, match="holds 10000 samples of 'samples', its counter is 10001"):
        experiments_from_recording(recording, tx40)


def _received(recording: Recording, t_ns: NDArray[np.int64]) -> Recording:
    samples = replace(recording.samples, t_ns=t_ns)
    return replace(recording, streams={**recording.streams, "samples": samples})


def test_a_wrong_clock_is_noted_whatever_sync_was_skipped(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    slow = _received(recording, np.rint(recording.samples.t_ns * 1.02).astype(np.int64))
    for counters in ({}, {"sync_skipped_periods": 50}):
        _, notes = experiments_from_recording(replace(slow, counters=counters), tx40)
        assert any(note.startswith("received at 4902.0 samples/s, configured are 5000.0") for note in notes)
    fast = _received(recording, np.rint(recording.samples.t_ns * 0.98).astype(np.int64))
    _, notes = experiments_from_recording(replace(fast, counters={"sync_skipped_periods": 500}), tx40)
    assert any("the receiving clock is off" in note for note in notes)


def test_sync_that_stood_still_is_no_wrong_clock_and_does_not_matter_on_a_virtual_bus(tx40: RobotConfig) -> None:
    recording = recording_of(tx40)
    times = recording.samples.t_ns + np.where(recording.samples.sync > 4000, 100_000_000, 0)
    held_up = replace(_received(recording, times), counters={"sync_skipped_periods": 500})
    session = load_session("tx40_cell.yaml")
    assert session.bus.bitrate is None
    _, notes = experiments_from_recording(replace(held_up, session=session), tx40)
    assert not [note for note in notes if "clock" in note or "SYNC" in note]
    physical = session.model_copy(update={"bus": session.bus.model_copy(update={"bitrate": 1_000_000})})
    _, notes = experiments_from_recording(replace(held_up, session=physical), tx40)
    assert [note for note in notes if "clock" in note or "SYNC" in note] == [
        "SYNC stood still for 0.10 s in all: the capturing machine was too busy, "
        "and samples around these times are not evenly spaced"
    ]
