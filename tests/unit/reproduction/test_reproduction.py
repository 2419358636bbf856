"""Reproduction of the thesis: protocol, documents, and two tables with their claim."""

import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.configs import ArmidentError, ConfigError, DataError, load_robot, load_trajectory
from armident.daq.recording import read_recording
from armident.identify.controller.nominal import known_controller
from armident.identify.effects.terms import arm_model
from armident.identify.estimators.idim_ls import idim_ls
from armident.identify.identification.from_recording import experiments_from_recording
from armident.virtual_robot.cli import robot as robot_command
from armident.virtual_robot.offline import simulate_recording, with_encoder_counts
from armident.virtual_robot.run import record_robot
from tests.reproduction import claims, recordings
from tests.reproduction.cached_estimates import RESPONSE_LENGTHS, Case, Laboratory, Run, between
from tests.reproduction.chapter4 import GOOD, UNDECIMATED, WRONG, relative
from tests.reproduction.chapter5 import IMPULSE_RESPONSES, OWN_RESPONSES
from tests.reproduction.chapter6 import COARSE_HZ, degraded, nearest
from tests.reproduction.command import SLOW, TABLES, chosen_tables, computed, make_bench, reproduce
from tests.reproduction.context import Bench
from tests.reproduction.emps_controller import controllers_on_emps
from tests.reproduction.recordings import Recorded, measured_emps, measured_recording, virtual_recording
from tests.reproduction.reference import REFERENCE, essential_names, reference_tables
from tests.reproduction.render import document, markdown
from tests.reproduction.subset import restricted_to
from tests.reproduction.tables import Cell, Column, Table

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reproduction")


@pytest.fixture(scope="module")
def bench(folder: Path) -> Bench:
    """The virtual TX40 is recorded by its command, the two arms with velocity feedback without another process."""
    bench = make_bench(folder)
    feedback = Laboratory(lambda: recorded_here(folder, "tx40_cell.yaml"))
    return replace(bench, feedback=feedback, axis=Laboratory(lambda: recorded_here(folder, "emps_cell.yaml")))


def recorded_here(folder: Path, session: str) -> Recorded:
    """The arm of a session whose drives feed back the velocity, as `virtual_recording` returns it."""
    out, truth = folder / f"{session}.mcap", folder / f"{session}.json"
    record_robot(Path(session), out, truth=truth, velocity_feedback=True)
    read = read_recording(out)
    (experiment,), _ = experiments_from_recording(read, read.robot)
    return Recorded(read.robot, experiment, json.loads(truth.read_text()))


def silenced(lab: Laboratory, velocity_feedback: bool) -> Laboratory:
    """The same arm with a hundredth of its noise; without any, torques that rest look frozen with velocity feedback."""
    trajectory = load_trajectory("configs/trajectories/tx40_excitation.yaml")
    robot = lab.recording(Case()).robot
    clean = simulate_recording(robot, trajectory, seed=0, noise=0.01, velocity_feedback=velocity_feedback)
    (experiment,), _ = experiments_from_recording(clean, robot)
    return Laboratory(lambda: replace(lab.recording(Case()), experiment=experiment))


@pytest.fixture(scope="module")
def silent(bench: Bench) -> Laboratory:
    return silenced(bench.virtual, velocity_feedback=False)


@pytest.fixture(scope="module")
def silent_feedback(bench: Bench) -> Laboratory:
    return silenced(bench.feedback, velocity_feedback=True)


@pytest.fixture(scope="module")
def reproduced(bench: Bench) -> tuple[list[Table], list[claims.Claim]]:
    return computed(bench, ["4.6", "4.7"])


def column(table: Table, source: str, name: str) -> Column:
    return next(c for c in table.columns if (c.source, c.name) == (source, name))


def figure(table: Table, source: str, name: str, label: str) -> float:
    value = column(table, source, name).cells[label].value
    assert value is not None
    return value


# The virtual arm to a file


def test_recording_to_a_file_is_the_simulation_of_the_sessions_set_points(tmp_path: Path) -> None:
    out = tmp_path / "coarse.mcap"
    record_robot(Path("emps_cell.yaml"), out, seed=4, encoder_counts=3600, truth=tmp_path / "truth.json")
    read = read_recording(out)
    robot = with_encoder_counts(load_robot("emps"), 3600)
    trajectory = load_trajectory("configs/trajectories/emps_excitation.yaml")
    expected = simulate_recording(robot, trajectory, seed=4, settle=0.5)
    np.testing.assert_array_equal(read.samples.raw["position"], expected.samples.raw["position"])
    np.testing.assert_array_equal(read.samples.raw["voltage"], expected.samples.raw["voltage"])
    assert [joint.drive.counts_per_unit for joint in read.robot.joints] == [3600.0]
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["fv1"] == 203.5034
    assert truth["kp1"] > 0
    with pytest.raises(ConfigError, match="the file exists already"):
        record_robot(Path("emps_cell.yaml"), out)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"encoder_counts": 3600}, "--trajectory and --encoder-counts belong to --to-file"),
        ({"to_file": Path("new.mcap"), "duration": 3.0}, "--replay, --duration and --write-config have no meaning"),
        (
            {"to_file": Path("new.mcap"), "replay": Path("old.mcap")},
            "--replay, --duration and --write-config have no meaning",
        ),
    ],
)
def test_options_that_do_not_go_together_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        robot_command(**options)


def test_virtual_arm_is_recorded_once_for_the_same_arguments(
    bench: Bench, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = bench.virtual.recording(Case())

    def never(*_: object) -> None:
        raise AssertionError("recorded again")

    monkeypatch.setattr(recordings, "_record", never)
    again = virtual_recording(folder / "recordings")
    np.testing.assert_array_equal(again.experiment.q, first.experiment.q)
    with pytest.raises(AssertionError, match="recorded again"):
        virtual_recording(folder / "recordings", seed=1)


def test_failure_of_the_virtual_arm_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "COMMAND", (sys.executable, "-c", "raise SystemExit('armident: no arm')"))
    with pytest.raises(ArmidentError, match="the virtual arm did not record: armident: no arm"):
        virtual_recording(tmp_path)


# The protocol


def test_essential_model_is_the_full_one_with_the_other_parameters_zero() -> None:
    full = arm_model(load_robot("tx40"))
    names = essential_names()
    model = restricted_to(full, names)
    assert len(model.base.names) == 28
    assert model.base.names == tuple(name for name in full.base.names if name in names)
    random = np.random.default_rng(0)
    q, qd, qdd = (random.standard_normal((50, 6)) for _ in range(3))
    theta = random.standard_normal(28)
    padded = np.zeros(full.base.b)
    padded[[full.base.names.index(name) for name in model.base.names]] = theta
    expected = full.inverse_dynamics(padded, q, qd, qdd)
    np.testing.assert_allclose(model.inverse_dynamics(theta, q, qd, qdd), expected, atol=1e-12)
    np.testing.assert_allclose(model.base_regressor(q, qd, qdd) @ theta, expected, atol=1e-12)
    with pytest.raises(ConfigError, match="no base parameter zz9"):
        restricted_to(full, ("zz1r", "zz9"))


def test_inessential_parameters_that_are_left_out_cost_a_fraction_of_what_noise_does(
    bench: Bench, silent: Laboratory
) -> None:
    theta = idim_ls(silent.equations(GOOD), silent.names).theta
    std = bench.virtual.run("idim-ls", GOOD).estimate.std
    assert silent.distance(theta, std) < 0.25
    assert (np.abs(theta - silent.truth) < std).all()


def simulated(lab: Laboratory, case: Case) -> NDArray[np.float64]:
    runs = lab.auxiliary(case).simulate(lab.truth)
    assert runs is not None
    return runs[0].q


@pytest.mark.parametrize("drives", ["silent", pytest.param("silent_feedback", marks=pytest.mark.nightly)])
def test_simulator_with_the_drives_own_gains_follows_the_arm(request: pytest.FixtureRequest, drives: str) -> None:
    lab: Laboratory = request.getfixturevalue(drives)
    # The thesis's simulations miss the measured position by 0.017 %, table 4.3.
    assert relative(lab.recording(GOOD).experiment.q, simulated(lab, GOOD)) < 0.017


@pytest.mark.nightly
def test_drives_that_feed_back_the_velocity_follow_later(silent: Laboratory, silent_feedback: Laboratory) -> None:
    tight, lagging = (lab.recording(GOOD).experiment for lab in (silent, silent_feedback))
    for experiment in (tight, lagging):
        assert experiment.q_ref is not None
    errors = [np.abs(e.q - e.q_ref).max(axis=0) for e in (tight, lagging) if e.q_ref is not None]
    assert (errors[1] > 2 * errors[0]).all()


def test_wrong_gear_ratios_move_the_simulated_joints_by_their_inverse(silent: Laboratory) -> None:
    np.testing.assert_allclose(0.8 * simulated(silent, WRONG), simulated(silent, GOOD), atol=0.05)


def test_coarse_encoders_round_the_recorded_positions_only(bench: Bench) -> None:
    fine, coarse = (bench.virtual.recording(Case(encoder_points=points)).experiment for points in (None, 3600))
    step = 2 * np.pi / 3600
    assert np.abs(coarse.q - fine.q).max() <= step / 2 + 1e-12
    np.testing.assert_allclose(coarse.q / step, np.round(coarse.q / step), atol=1e-6)
    np.testing.assert_array_equal(coarse.tau, fine.tau)


def test_equations_midway_keep_the_noise_of_the_recorded_torque(bench: Bench) -> None:
    lab = bench.virtual
    at, midway = (lab.equations(replace(UNDECIMATED, midway=m))[0] for m in (False, True))
    np.testing.assert_array_equal(midway.y, lab.recording(Case()).experiment.tau[:-1])
    np.testing.assert_array_equal(midway.x, between(at.x))
    np.testing.assert_allclose(midway.t[0], at.t[0] + 1e-4)


def test_estimates_are_made_once(bench: Bench) -> None:
    assert bench.virtual.run("idim-iv", GOOD) is bench.virtual.run("idim-iv", Case("bandpass"))


# Tables and claims


def test_every_table_of_the_thesis_has_a_function() -> None:
    assert set(TABLES) == set(reference_tables()) - {REFERENCE}


def test_every_table_of_estimates_speaks_of_the_28_essential_parameters() -> None:
    for number, table in reference_tables().items():
        if table.estimates:
            assert set(table.estimates) == set(essential_names()), number
    assert len(essential_names()) == 28


@pytest.mark.nightly
def test_thesis_columns_are_as_printed(reproduced: tuple[list[Table], list[claims.Claim]]) -> None:
    table = reproduced[0][0]
    assert column(table, "thesis", "DIDIM, 80 %").cells["zz1r"] == Cell(0.96, 1.22)
    assert column(table, "thesis", "IDIM-IV").cells["fvm6"] == Cell(0.60, 2.26)


@pytest.mark.nightly
def test_estimates_and_deviations_are_of_the_size_of_the_thesis(
    reproduced: tuple[list[Table], list[claims.Claim]],
) -> None:
    table = reproduced[0][0]
    thesis, ours = (column(table, source, "IDIM-IV").cells for source in ("thesis", "virtual"))
    own = column(table, "arm", "own").cells
    ratios = []
    for label in table.labels:
        mine, printed, truth = ours[label], thesis[label], own[label].value
        assert mine.value is not None
        assert mine.std_pct is not None
        assert printed.std_pct is not None
        assert truth is not None
        assert abs(mine.value - truth) < 5 * mine.std_pct / 100 * abs(mine.value), label
        ratios.append(mine.std_pct / printed.std_pct)
    # Same noise, another exciting trajectory.
    assert 0.4 < np.median(ratios) < 1.5


@pytest.mark.nightly
def test_relative_errors_with_right_and_wrong_gear_ratios(reproduced: tuple[list[Table], list[claims.Claim]]) -> None:
    table = reproduced[0][1]
    right, wrong = (figure(table, "virtual", name, "error, %") for name in ("IDIM-IV", "IDIM-IV, 80 %"))
    # Table 4.7: 5.59 and 5.66 %; DIDIM 9.71 %.
    assert 4 < right < 6.5
    assert abs(wrong - right) < 0.1
    assert figure(table, "virtual", "DIDIM, 80 %", "error, %") > 1.5 * right


@pytest.mark.nightly
def test_didim_moves_with_the_gear_ratios_and_idim_iv_does_not(
    reproduced: tuple[list[Table], list[claims.Claim]],
) -> None:
    (claim,) = reproduced[1]
    assert claim.number == 2
    assert claim.holds, claim.findings


@pytest.mark.nightly
def test_claims_are_computed_from_the_estimates(bench: Bench) -> None:
    """A claim of a change fails on equal estimates, and a claim of no change on different ones."""
    lab = bench.virtual
    nominal, moved = lab.run("idim-iv", GOOD), lab.run("didim", WRONG)

    def found(iv: Run, didim: Run) -> list[bool]:
        forged = Laboratory(lambda: lab.recording(Case()))
        for method in ("idim-iv", "didim"):
            forged.once((method, GOOD), lambda: nominal)
        forged.once(("idim-iv", WRONG), lambda: iv)
        forged.once(("didim", WRONG), lambda: didim)
        return [finding.holds for finding in claims.robustness(Bench(forged, forged))]

    assert found(nominal, moved) == [True, True]
    assert found(nominal, nominal) == [True, False]
    assert found(moved, moved) == [False, True]


@pytest.mark.nightly
@pytest.mark.parametrize("exact", [True, False])
def test_impulse_responses_serve_idim_iv_always_and_didim_where_they_are_exact(bench: Bench, exact: bool) -> None:
    """Section 5.3.3, whose responses come from the tracking error alone; the EMPS below shows the inexact case too."""
    lab = bench.virtual if exact else bench.feedback
    found = claims._responses("drives", lab, exact=exact)
    assert all(finding.holds for finding in found), found
    # What is found of one kind of drive cannot be found of the other.
    instrumental, direct, *_ = claims._responses("drives", lab, exact=not exact)
    assert instrumental.holds
    assert not direct.holds


@pytest.mark.nightly
def test_response_from_the_velocity_makes_up_for_its_feedback(bench: Bench) -> None:
    own, thesis = (bench.feedback.identified(case).responses for case in (OWN_RESPONSES, IMPULSE_RESPONSES))
    assert all(response.position_taps.size > 0 for response in own)
    assert all(response.position_taps.size == 0 for response in thesis)
    assert tuple(response.error_taps.size for response in thesis) == RESPONSE_LENGTHS
    assert all(a.fit_pct > b.fit_pct for a, b in zip(own, thesis, strict=True))


@pytest.mark.nightly
def test_didim_that_cannot_be_simulated_does_not_work(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Laboratory(lambda: bench.virtual.recording(Case()))
    for method in ("idim-iv", "didim"):
        lab.once((method, Case()), partial(bench.virtual.run, method, Case()))
    lab.once(("idim-iv", IMPULSE_RESPONSES), lambda: bench.virtual.run("idim-iv", IMPULSE_RESPONSES))

    def diverges(*_: object) -> None:
        raise DataError("the auxiliary closed loop cannot be simulated")

    monkeypatch.setattr(lab, "_run", diverges)
    _, direct, *_ = claims._responses("drives", lab, exact=True)
    assert not direct.holds
    assert "has no closed loop that can be simulated" in direct.text


@pytest.mark.nightly
def test_degraded_encoders_bias_idim_ls_where_the_parallel_filter_is_rough(bench: Bench) -> None:
    for lab in (bench.virtual, bench.feedback):
        tried = degraded(lab)
        near = nearest(tried)
        assert [one.case.cutoff_hz for one in tried] == list(COARSE_HZ)
        # The closest to the thesis's column is among those that bias, as its own zz1r, 1.12 of 1.24, was.
        assert near.case.cutoff_hz in (40.0, 50.0)
        assert near.correlation > 0.6
        assert abs(tried[0].correlation) < 0.3
        errors = [one.run.estimate.theta[lab.names.index("zz1r")] / 1.24 - 1 for one in tried]
        assert abs(errors[0]) < 0.01
        assert errors[tried.index(near)] < -0.05
        assert errors == sorted(errors, reverse=True)


@pytest.mark.nightly
def test_tables_of_the_controller_have_both_kinds_of_drives(bench: Bench) -> None:
    estimates = TABLES["5.13"](bench)
    assert figure(estimates, "virtual", "DIDIM (CRC), velocity feedback", "xx2r") < 1.2 * -0.48
    own = column(estimates, "arm", "own").cells
    printed = column(estimates, "virtual", "IDIM-IV (CRC), velocity feedback").cells
    for label in estimates.labels:
        value, cell = own[label].value, printed[label]
        assert value is not None
        assert cell.value is not None
        assert cell.std_pct is not None
        assert abs(cell.value - value) < 4 * cell.std_pct / 100 * abs(cell.value), label
    assert figure(TABLES["5.14"](bench), "virtual", "IDIM-IV (CRC)", "error, %, velocity feedback") < 5.6


def test_claims_are_judged_only_on_tables_that_were_made(bench: Bench) -> None:
    assert claims.judged(bench, ["4.6"]) == []
    assert {number for j in claims.JUDGEMENTS for number in j.tables} <= set(TABLES)
    assert [j.number for j in claims.JUDGEMENTS] == [1, 2, 3, 4, 5, 6]


@pytest.mark.nightly
def test_documents_say_the_same(reproduced: tuple[list[Table], list[claims.Claim]]) -> None:
    tables, found = reproduced
    content = json.loads(document(tables, found, quick=True))
    assert content["quick"] is True
    assert [table["number"] for table in content["tables"]] == ["4.6", "4.7"]
    ours = next(c for c in content["tables"][1]["columns"] if (c["source"], c["name"]) == ("virtual", "DIDIM"))
    assert ours["values"][0] == figure(tables[1], "virtual", "DIDIM", "error, %")
    page = markdown(tables, found)
    assert "## Table 4.7" in page
    assert f"{ours['values'][0]:.4g}" in page
    assert content["claims"][0]["findings"][0]["finding"] in page


def test_figures_that_are_not_finite_become_null() -> None:
    table = Table("5.9", "none", ("a",), (Column("virtual", "x", {"a": Cell(float("inf"), float("nan"))}),))
    (made,) = json.loads(document([table], [], quick=False))["tables"]
    assert made["columns"] == [{"source": "virtual", "name": "x", "values": [None], "std_pct": [None]}]


def test_tables_are_chosen_by_their_numbers() -> None:
    assert chosen_tables(None, quick=False) == list(TABLES)
    assert set(TABLES) - set(chosen_tables(None, quick=True)) == set(SLOW)
    assert chosen_tables("6.7, 5.2", quick=True) == ["5.2", "6.7"]
    with pytest.raises(ConfigError, match=r"no table 9\.9; there are 4\.1"):
        chosen_tables("9.9", quick=False)
    with pytest.raises(ConfigError, match="no table named"):
        chosen_tables(",", quick=False)


# The measured arm


def test_measured_arm_has_columns_where_no_reference_is_needed(
    bench: Bench, shared_data: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if not (shared_data / "tx40").is_dir():
        pytest.skip("no tx40 folder in the measured data")
    reproduce("5.5,5.6", shared_data, folder, quick=True, json=True)
    content = json.loads(capsys.readouterr().out)
    assert content == json.loads((folder / "reproduce.json").read_text())
    assert (folder / "reproduce.md").is_file()
    estimates, errors = content["tables"]
    measured = [c for c in estimates["columns"] if c["source"] == "measured"]
    assert [c["name"] for c in measured] == ["bandpass", "IRWSM 1", "IRWSM 2"]
    reference = reference_tables()[REFERENCE].estimates
    for name, value in zip(estimates["rows"], measured[0]["values"], strict=True):
        printed, percent = reference[name]
        assert abs(value - printed) <= 4 * abs(printed) * percent / 100, name
    bandpass = next(c for c in errors["columns"] if (c["source"], c["name"]) == ("measured", "bandpass"))
    by_row = dict(zip(errors["rows"], bandpass["values"], strict=True))
    # Table 5.6: 5.1 and 9.2 %.
    assert by_row["good knowledge"] == pytest.approx(5.1, rel=0.1)
    assert by_row["poor knowledge"] == pytest.approx(9.2, rel=0.2)


def test_measured_files_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"pos_read_data\.csv.*cannot be read"):
        measured_recording(tmp_path)
    for name in (recordings.MEASURED_POSITIONS, recordings.MEASURED_TORQUES):
        (tmp_path / name).write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match="expected 6 columns of finite numbers, found 2"):
        measured_recording(tmp_path)


def test_on_measured_emps_an_impulse_response_serves_idim_iv_and_not_didim(shared_data: Path) -> None:
    recorded = measured_emps(shared_data)
    if recorded is None:
        pytest.skip("no emps folder in the measured data")
    # Thesis section 5.3.3: the drive feeds back the velocity, so no response from the tracking error is its law.
    found = controllers_on_emps(recorded)
    assert found.fit_pct < 99
    (law, response), (direct, shifted) = found.idim_iv, found.didim
    assert claims.apart(response.theta, law) < 0.5
    assert claims.apart(shifted.theta, direct) > 2
    assert claims.apart(direct.theta, law) < 1


def test_emps_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    assert measured_emps(tmp_path) is None
    (tmp_path / "emps").mkdir()
    (tmp_path / "emps" / recordings.EMPS_FILE).write_text("not what MATLAB writes")
    with pytest.raises(DataError, match=r"DATA_EMPS\.mat: cannot be read"):
        measured_emps(tmp_path)


@pytest.mark.nightly
def test_on_virtual_emps_an_impulse_response_serves_idim_iv_and_not_didim(bench: Bench) -> None:
    assert bench.axis is not None
    recorded = bench.axis.recording(Case())
    found = controllers_on_emps(recorded)
    assert found.fit_pct < 99
    (law, response), (direct, shifted) = found.idim_iv, found.didim
    assert claims.apart(response.theta, law) < 0.5
    assert claims.apart(shifted.theta, direct) > 2
    own = np.array([recorded.truth[name] for name in ("m1", "fv1", "fc1", "off1")])
    assert (np.abs(response.theta - own) < 4 * response.std).all()
    assert (np.abs(shifted.theta - own) > 4 * direct.std).any()


def test_law_of_the_axis_is_the_one_of_its_configuration(bench: Bench) -> None:
    assert bench.axis is not None
    recorded = bench.axis.recording(Case())
    ours, known = recorded.controller(), known_controller(recorded.robot, recorded.experiment.dt)
    np.testing.assert_allclose(ours.error_taps[:, :1], known.error_taps)
    assert not ours.error_taps[:, 1:].any()
    np.testing.assert_allclose(ours.position_taps, known.position_taps)
    assert not ours.output_taps.any()
