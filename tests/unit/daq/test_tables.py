"""Tables as tools write them: spellings of columns, damaged lines, and clocks."""

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from armident.configs import ConfigError, DataError, Limits, load_robot
from armident.daq.cli import application
from armident.daq.interchange.importing import import_recording
from armident.daq.recording import Recording
from tests.unit.daq.test_importing import HEADER, PANDA, TX40, moving_panda

N = TX40.n
NAMES = HEADER.split(",")


def motion(rows: int = 400, rate: float = 1000.0) -> np.ndarray:
    """Return t, positions and torques of a motion that uses a third of the velocity limits."""
    t = np.arange(rows) / rate
    phase = np.arange(N)
    amplitude = 0.05 * np.array([joint.limits.velocity for joint in TX40.joints])
    return np.column_stack([t, amplitude * np.sin(6 * t[:, None] + phase), 3 * np.cos(6 * t[:, None] + phase)])


def written(path: Path, values: np.ndarray, names: list[str] = NAMES, sep: str = ",", cell: str = "{:.9g}") -> Path:
    lines = [sep.join(names), *(sep.join(cell.format(x) for x in row) for row in values)]
    path.write_text("\n".join(lines) + "\n")
    return path


def same(found: Recording, values: np.ndarray) -> bool:
    raw = found.samples.raw
    return np.allclose(np.hstack([raw["position"], raw["torque"]]), values[:, 1:], rtol=0, atol=1e-8)


COUNTED = ["t", *(f"q{j}" for j in range(N)), *(f"tau{j}" for j in range(N))]
BY_JOINT = [
    "__time",
    *(f"/arm/joint_{j + 1}/position" for j in range(N)),
    *(f"/arm/joint_{j + 1}/effort" for j in range(N)),
]


@pytest.mark.parametrize(
    "names",
    [
        [f'"{name}"' for name in NAMES], [name.upper() for name in NAMES], COUNTED, BY_JOINT,
        ["Time [s]", *(f"q_{j + 1} [rad]" for j in range(N)), *(f"tau_{j + 1} (Nm)" for j in range(N))],
        ["timestamp", *(f"joint_{j + 1}_pos" for j in range(N)), *(f"joint_{j + 1}_torque" for j in range(N))],
        ["timestamp", *(f"actual_q_{j}" for j in range(N)), *(f"effort.joint_{j + 1}" for j in range(N))],
        ["# t", *NAMES[1:]], ["t", *(f"q[{j + 1}]" for j in range(N)), *(f"effort[{j}]" for j in range(N))],
    ],
)  # fmt: skip
@pytest.mark.parametrize("sep", [",", ";", "\t", "|"])
def test_columns_are_found_by_the_names_of_other_tools(tmp_path: Path, names: list[str], sep: str) -> None:
    found = import_recording(written(tmp_path / "a.csv", motion(), names, sep), TX40)
    assert same(found, motion())
    assert found.sample_rate_hz == pytest.approx(1000)


def test_columns_of_joints_in_another_order_are_found_by_name(tmp_path: Path) -> None:
    order = [0, 3, 1, 2, 6, 5, 4, 9, 7, 8, 12, 11, 10]
    path = written(tmp_path / "a.csv", motion()[:, order], [BY_JOINT[k] for k in order])
    assert same(import_recording(path, TX40), motion())
    other = [name.replace("joint_", "axis_") for name in BY_JOINT]
    path = written(tmp_path / "b.csv", motion(), other)
    with pytest.raises(DataError, match=r"file has .*axis_1.*robot has joint_1.*--joints.*--by-position"):
        import_recording(path, TX40)
    assert same(import_recording(path, TX40, by_position=True), motion())


def test_a_missing_column_lists_what_was_found(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion()[:, :12], NAMES[:12])
    with pytest.raises(DataError, match=r"no column tau6, the robot has 6 joints; found t, q1, .*tau5$"):
        import_recording(path, TX40)
    path = written(tmp_path / "b.csv", motion()[:, :7], ["t", *"abcdef"])
    with pytest.raises(DataError, match=r"expected columns q1\.\.q6 .*found t, a, b, c, d, e, f; --map"):
        import_recording(path, TX40)


def test_units_in_names_are_converted_and_said(tmp_path: Path) -> None:
    values = motion()
    values[:, 0] *= 1e3
    values[:, 1 : N + 1] = np.rad2deg(values[:, 1 : N + 1])
    names = ["time_ms", *(f"q{j + 1} [deg]" for j in range(N)), *NAMES[N + 1 :]]
    found = import_recording(written(tmp_path / "a.csv", values, names), TX40)
    assert same(found, motion())
    assert found.sample_rate_hz == pytest.approx(1000)
    assert "times are in ms" in found.metadata["source_remarks"]
    assert "q1 [deg] from deg" in found.metadata["source_remarks"]
    with pytest.raises(DataError, match="--time-unit us contradicts the name of the column, which says ms"):
        import_recording(tmp_path / "a.csv", TX40, time_unit="us")


@pytest.mark.parametrize(
    ("quantity", "unit", "per_si"),
    [
        ("q", "mrad", 1e3), ("q", "rev", 1 / (2 * np.pi)), ("q", "\u00b0", 180 / np.pi), ("q", "rad", 1.0),
        ("tau", "mN\u00b7m", 1e3), ("tau", "N cm", 100.0), ("tau", "kNm", 1e-3), ("tau", "N*m", 1.0),
        ("tau", "measured", 1.0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("place", ["name", "line"])
def test_units_of_columns_are_converted_in_any_spelling(
    tmp_path: Path, quantity: str, unit: str, per_si: float, place: str
) -> None:
    values = motion()
    first = 1 if quantity == "q" else N + 1
    values[:, first : first + N] *= per_si
    path = written(tmp_path / "a.csv", values)
    names, *rows = path.read_text().splitlines()
    cells = names.split(",")
    line = [unit if name.startswith(quantity) else "s" if name == "t" else "" for name in cells]
    head = [f"{name} [{u}]" if u else name for name, u in zip(cells, line, strict=True)]
    path.write_text("\n".join([",".join(head), *rows] if place == "name" else [names, ",".join(line), *rows]) + "\n")
    found = import_recording(path, TX40)
    assert np.allclose(found.samples.raw["position" if quantity == "q" else "torque"], motion()[:, first : first + N])


@pytest.mark.parametrize(
    ("quantity", "unit"), [("q", "grad"), ("q", "Nm"), ("tau", "%"), ("tau", "lbf ft"), ("tau", "A")]
)
def test_units_that_are_not_known_or_of_another_quantity_are_refused(tmp_path: Path, quantity: str, unit: str) -> None:
    names = [f"{name} [{unit}]" if name.startswith(quantity) else name for name in NAMES]
    with pytest.raises(DataError, match=rf"column {quantity}1 states the unit '{unit}', expected one of (rad|N m), "):
        import_recording(written(tmp_path / "a.csv", motion(), names), TX40)


@pytest.mark.parametrize("unit", ["min", "h", "ticks"])
def test_a_unit_of_times_that_is_not_read_is_refused(tmp_path: Path, unit: str) -> None:
    values = motion() * np.append(1 / 60, np.ones(2 * N))
    path = written(tmp_path / "a.csv", values, [f"time [{unit}]", *NAMES[1:]])
    with pytest.raises(DataError, match=f"the column of times states the unit '{unit}', expected s, ms, us or ns"):
        import_recording(path, TX40)


@pytest.mark.parametrize(("unit", "factor"), [("msec", 1e3), ("\u03bcs", 1e6), ("milliseconds", 1e3), ("sec.", 1.0)])
def test_units_of_times_have_many_spellings(tmp_path: Path, unit: str, factor: float) -> None:
    values = motion() * np.append(factor, np.ones(2 * N))
    found = import_recording(written(tmp_path / "a.csv", values, [f"Time ({unit})", *NAMES[1:]]), TX40)
    assert found.sample_rate_hz == pytest.approx(1000)


def test_each_column_of_times_has_the_unit_of_its_own_name(tmp_path: Path) -> None:
    values = np.insert(motion(200, 100.0), 1, 0.0, axis=1)
    values[:, 1] = 1e6 * values[:, 0]
    values[:, 0] *= 1e3
    found = import_recording(written(tmp_path / "a.csv", values, ["t [ms]", "timestamp_us", *NAMES[1:]]), TX40)
    assert found.sample_rate_hz == pytest.approx(100)


@pytest.mark.parametrize("name", ["{base}[{zero}]", "{base}({one})", "{base}{one}_rad|{base}{one}_Nm"])
def test_brackets_around_numbers_and_units_behind_underscores_are_read(tmp_path: Path, name: str) -> None:
    of_q, of_tau = (name.split("|") * 2)[:2]
    names = ["t", *(of_q.format(base="q", zero=j, one=j + 1) for j in range(N))]
    names += [of_tau.format(base="tau", zero=j, one=j + 1) for j in range(N)]
    assert same(import_recording(written(tmp_path / "a.csv", motion(), names), TX40), motion())


def test_positions_and_efforts_of_different_arms_are_refused(tmp_path: Path) -> None:
    names = [*(f"left_joint_{j + 1}/position" for j in range(N)), *(f"right_joint_{j + 1}/effort" for j in range(N))]
    path = written(tmp_path / "a.csv", motion(), ["t", *names])
    with pytest.raises(DataError, match=r"positions are those of left_joint_1, .* but torques those of right_joint_1"):
        import_recording(path, TX40)
    names = [*(f"/state/joint_{j + 1}/position" for j in range(N)), *(f"/drive/joint_{j + 1}/effort" for j in range(N))]
    path = written(tmp_path / "b.csv", motion(), ["t", *names])
    with pytest.raises(DataError, match=r"positions are those of state/joint_1, .* --joints"):
        import_recording(path, TX40)
    assert same(import_recording(path, TX40, joints=[joint.name for joint in TX40.joints]), motion())


def test_measured_columns_beside_desired_ones_are_told_by_their_words(tmp_path: Path) -> None:
    q, tau = motion()[:, 1 : N + 1], motion()[:, N + 1 :]
    names = ["t"] + [
        f"joint_{j + 1}/{kind}/{word}"
        for kind, word in (("actual", "position"), ("target", "position"), ("actual", "effort"), ("target", "effort"))
        for j in range(N)
    ]
    path = written(tmp_path / "a.csv", np.hstack([motion()[:, :1], q, 1.01 * q, tau, 2 * tau]), names)
    found = import_recording(path, TX40)
    assert same(found, motion())
    assert np.allclose(found.samples.raw["demand"], 1.01 * q)


def test_a_column_with_two_decimal_signs_is_refused_with_both(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion(), sep=";", cell="{:.6f}")
    lines = path.read_text().splitlines()
    lines[10:] = [line.replace(".", ",") for line in lines[10:]]
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(
        DataError, match=r"column 1 has '0\.000000' in line 2 and '0,009000' in line 11: decimal commas"
    ):
        import_recording(path, TX40)


def test_a_date_of_another_form_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion(), sep=";")
    names, *rows = path.read_text().splitlines()
    path.write_text("\n".join([names, *(f"06.03.2026 15:00:{row}" for row in rows)]) + "\n")
    with pytest.raises(
        DataError, match=r"line 2 has '06\.03\.2026 .*expected numbers; dates are read in the form 2026"
    ):
        import_recording(path, TX40)


def test_decimal_commas_are_read_between_semicolons_and_named_between_commas(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion(), sep=";")
    path.write_text(path.read_text().replace(".", ","))
    found = import_recording(path, TX40)
    assert same(found, motion())
    assert "decimal commas are read" in found.metadata["source_remarks"]
    path = written(tmp_path / "b.csv", motion() + 0.5, cell="{:.6f}")
    path.write_text(path.read_text().replace(".", ","))
    with pytest.raises(DataError, match=r"13 names in the header, 26 columns of values; decimal commas"):
        import_recording(path, TX40)


def test_dates_in_the_column_of_times_are_read(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion(200), cell="{:.9f}")
    lines = path.read_text().splitlines()
    dated = [f"2026-03-06T15:00:0{line}" for line in lines[1:]]
    path.write_text("\n".join([lines[0], *dated]) + "\n")
    found = import_recording(path, TX40)
    assert same(found, motion(200))
    assert found.sample_rate_hz == pytest.approx(1000, rel=1e-4)


def test_damaged_lines_are_gaps_and_named(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion())
    lines = path.read_text().splitlines()
    lines[100] = lines[100].replace(",", ",x", 1)
    lines[201] = lines[201] + ",5"
    lines[302] = "CONNECTION LOST"
    lines.insert(50, "# a comment")
    path.write_text("\n".join(lines) + "\n" + lines[-1][:40])
    found = import_recording(path, TX40)
    assert [(gap.first, gap.last) for gap in found.gaps] == [(99, 99), (200, 200), (301, 301)]
    notes = found.metadata["source_remarks"]
    assert "3 of 400 lines are damaged and left out, the first: line 102, column 2: expected a number" in notes
    assert "the last line (403) is cut off" in notes


@pytest.mark.parametrize(
    "said", [lambda k: "RUN", lambda k: "RUN" if k % 7 == 3 else "", lambda k: "RUN" if k > 150 else ""]
)
@pytest.mark.parametrize("first", [True, False])
def test_columns_of_text_are_left_out(tmp_path: Path, said: Callable[[int], str], first: bool) -> None:
    head, *rows = written(tmp_path / "a.csv", motion()).read_text().splitlines()
    lines = [f"{said(k)},{row}" if first else f"{row},{said(k)}" for k, row in enumerate(rows)]
    (tmp_path / "b.csv").write_text("\n".join([f"state,{head}" if first else f"{head},state", *lines]) + "\n")
    found = import_recording(tmp_path / "b.csv", TX40)
    assert same(found, motion())
    assert not found.gaps


def test_words_in_a_column_of_numbers_are_damage(tmp_path: Path) -> None:
    lines = written(tmp_path / "a.csv", motion()).read_text().splitlines()
    lines[1] = lines[1].replace(",", ",x", 1)
    (tmp_path / "b.csv").write_text("\n".join(lines) + "\n")
    found = import_recording(tmp_path / "b.csv", TX40)
    assert same(found, motion()[1:])
    assert "damaged and left out: line 2, column 2" in found.metadata["source_remarks"]
    every = [line.replace(",", ",none", 1) if k % 5 == 4 else line for k, line in enumerate(lines)]
    (tmp_path / "c.csv").write_text("\n".join(every) + "\n")
    with pytest.raises(DataError, match=r"line 2, column 2: expected a number, found 'x"):
        import_recording(tmp_path / "c.csv", TX40)


def test_lines_may_end_in_a_separator(tmp_path: Path) -> None:
    head, *rows = written(tmp_path / "a.csv", motion()).read_text().splitlines()
    (tmp_path / "b.csv").write_text("\n".join([head, *(f"{row}," for row in rows)]) + "\n")
    assert same(import_recording(tmp_path / "b.csv", TX40), motion())
    (tmp_path / "c.csv").write_text("\n".join([head, *(f"{k},{row}" for k, row in enumerate(rows))]) + "\n")
    with pytest.raises(DataError, match=r"13 names in the header, 14 columns of values; a column without a name"):
        import_recording(tmp_path / "c.csv", TX40)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_the_encoding_is_found_with_and_without_a_mark(tmp_path: Path, encoding: str) -> None:
    path = written(tmp_path / "a.csv", motion())
    path.write_bytes(path.read_text().encode(encoding))
    assert same(import_recording(path, TX40), motion())


def test_a_header_of_another_order_among_the_rows_is_refused(tmp_path: Path) -> None:
    lines = written(tmp_path / "a.csv", motion()).read_text().splitlines()
    for other, said in ((["t", "q2", "q1", *NAMES[3:]], "t,q2,q1"), (NAMES[:9], "t,q1,q2")):
        (tmp_path / "b.csv").write_text("\n".join([*lines[:200], ",".join(other), *lines[200:]]) + "\n")
        with pytest.raises(DataError, match=rf"line 201 is another header .*'{said},.* after 't,q1,q2,q3"):
            import_recording(tmp_path / "b.csv", TX40)
    (tmp_path / "c.csv").write_text("\n".join([*lines[:200], lines[0], *lines[200:]]) + "\n")
    assert same(import_recording(tmp_path / "c.csv", TX40), motion())


def test_rows_of_other_topics_are_passed_over_and_rows_of_one_time_joined(tmp_path: Path) -> None:
    values = motion(100)
    names = [*NAMES, "/tool/temp"]
    rows = []
    for row in values:
        cells = [f"{x:.9g}" for x in row]
        rows += [",".join([*cells[:7], *[""] * 6, ""]), ",".join([cells[0], *[""] * 6, *cells[7:], ""])]
        rows.append(",".join([f"{row[0] + 0.0004:.9g}", *[""] * 12, "31.5"]))
    (tmp_path / "a.csv").write_text("\n".join([",".join(names), *rows]) + "\n")
    found = import_recording(tmp_path / "a.csv", TX40)
    assert same(found, values)
    assert not found.gaps
    assert "100 rows without positions and efforts passed over" in found.metadata["source_remarks"]
    (tmp_path / "b.csv").write_text("\n".join([",".join(names), *rows]).replace(",31.5", ",").replace("0.0", "0.1", 1))
    shifted = [r if k % 3 else f"{float(r.split(',')[0]) + 2e-4:.9g}," + r.split(",", 1)[1] for k, r in enumerate(rows)]
    (tmp_path / "b.csv").write_text("\n".join([",".join(names), *shifted]) + "\n")
    with pytest.raises(DataError, match="sparse rows of several topics"):
        import_recording(tmp_path / "b.csv", TX40)


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_in_another_unit_are_recognised(tmp_path: Path, unit: str, factor: float) -> None:
    for rate in (100.0, 1000.0, 5000.0):
        values = motion(2000, rate)
        values[:, 0] = (1000 + values[:, 0]) * factor
        path = written(tmp_path / "a.csv", values, cell="{:.16g}")
        with pytest.raises(DataError, match=rf"in {unit} it would be {rate:.0f} Hz: --time-unit {unit}"):
            import_recording(path, TX40)
        found = import_recording(path, TX40, time_unit=unit)
        assert found.sample_rate_hz == pytest.approx(rate, rel=1e-6)
    with pytest.raises(ConfigError, match="--time-unit: expected one of s, ms, us, ns, found min"):
        import_recording(path, TX40, time_unit="min")


@pytest.mark.parametrize("step", [1e-10, 1e-200, 5e-324])
@pytest.mark.parametrize("repeats", [1, 2])
def test_steps_below_a_nanosecond_are_no_clock(tmp_path: Path, step: float, repeats: int) -> None:
    values = motion(500, 1000.0)
    values[:, 0] = np.arange(500) // repeats * step
    path = written(tmp_path / "a.csv", values, cell="{:.17g}")
    with pytest.raises(DataError, match=r"shorter than 1 ns.*--time-unit"):
        import_recording(path, TX40)


def test_slow_motion_and_low_rates_are_seconds(tmp_path: Path) -> None:
    for rate, share in ((30.0, 1.0), (1000.0, 0.001), (5000.0, 1.0)):
        values = motion(600, rate)
        values[:, 1 : N + 1] *= share
        assert import_recording(written(tmp_path / "a.csv", values), TX40).sample_rate_hz == pytest.approx(rate)


def test_a_rate_that_contradicts_the_times_is_refused_with_both(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion())
    for rate in (500.0, 998.0 * 1.02, 5000.0):
        with pytest.raises(DataError, match=rf"--rate {rate:g} contradicts the column of times: .* 1000 Hz"):
            import_recording(path, TX40, rate_hz=rate)
    assert import_recording(path, TX40, rate_hz=1000.0).sample_rate_hz == 1000.0


@pytest.mark.parametrize("rate", [None, 1000.0])
def test_missing_rows_are_gaps(tmp_path: Path, rate: float | None) -> None:
    values = motion()
    kept = np.ones(400, bool)
    kept[[10, 11, 50, 51, 52, 53, 200]] = False
    kept[260:350] = False
    kept[np.random.default_rng(4).integers(60, 190, 30)] = False
    found = import_recording(written(tmp_path / "a.csv", values[kept]), TX40, rate_hz=rate)
    assert np.array_equal(found.samples.sync, np.flatnonzero(kept))
    assert same(found, values[kept])
    missing = [n for gap in found.gaps for n in range(gap.first, gap.last + 1)]
    assert missing == np.flatnonzero(~kept).tolist()
    assert found.counters["samples.in_gaps"] == len(missing)


@pytest.mark.parametrize("odd", [0.1, -5.0, 1e12])
def test_a_single_time_out_of_order_is_a_gap(tmp_path: Path, odd: float) -> None:
    values = motion()
    values[200, 0] = odd
    found = import_recording(written(tmp_path / "a.csv", values), TX40)
    assert [(gap.first, gap.last) for gap in found.gaps] == [(200, 200)]
    assert "left out: 1, the first:" in found.metadata["source_remarks"]
    assert "line 202, column t" in found.metadata["source_remarks"]


def test_times_with_too_few_digits_need_a_rate(tmp_path: Path) -> None:
    values = motion()
    values[:, 0] = np.round(values[:, 0], 2)
    path = written(tmp_path / "a.csv", values)
    with pytest.raises(DataError, match=r"too few digits: .*; --rate 1000 if the samples are even"):
        import_recording(path, TX40)
    with pytest.raises(DataError, match=r"359 of 400 rows have the time of the row before: .* too few digits"):
        import_recording(path, TX40, resample_hz=1000.0)
    assert same(import_recording(path, TX40, rate_hz=1000.0), motion())


def test_the_rate_of_the_hint_is_that_of_the_samples(tmp_path: Path) -> None:
    values = motion(600, 3000.0)
    values[:, 0] = np.round(values[:, 0], 4)
    with pytest.raises(DataError, match=r"the times jitter.*--resample 3000 puts"):
        import_recording(written(tmp_path / "a.csv", values), TX40)
    values = np.delete(values, np.s_[100:300], axis=0)
    values[:, 0] += np.random.default_rng(1).uniform(0, 1e-5, len(values))
    with pytest.raises(DataError, match=r"the times jitter.*--resample 3[0-9]00 puts"):
        import_recording(written(tmp_path / "b.csv", values), TX40)


def test_rows_that_are_there_twice_are_taken_once(tmp_path: Path) -> None:
    values = motion()
    found = import_recording(written(tmp_path / "a.csv", values[np.sort(np.append(np.arange(400), [7, 90]))]), TX40)
    assert same(found, values)
    assert "2 rows are there twice" in found.metadata["source_remarks"]


def jittering(rows: int = 3000, share: float = 0.2) -> np.ndarray:
    """Return a motion sampled at times that are off by a share of the period."""
    values = motion(rows)
    t = values[:, 0] + np.random.default_rng(1).uniform(-share, share, rows) * 1e-3
    phase = np.arange(N)
    amplitude = 0.05 * np.array([joint.limits.velocity for joint in TX40.joints])
    return np.column_stack([t, amplitude * np.sin(6 * t[:, None] + phase), 3 * np.cos(6 * t[:, None] + phase)])


def test_uneven_times_are_resampled_when_asked_and_said(tmp_path: Path) -> None:
    values = np.delete(jittering(), slice(1000, 1100), axis=0)
    path = written(tmp_path / "a.csv", values, cell="{:.12g}")
    with pytest.raises(DataError, match=r"the times jitter.*--resample 1000 puts") as caught:
        import_recording(path, TX40)
    assert "--rate" not in str(caught.value)
    found = import_recording(path, TX40, resample_hz=1000.0)
    t = values[0, 0] + found.samples.sync / 1000.0
    phase = np.arange(N)
    amplitude = 0.05 * np.array([joint.limits.velocity for joint in TX40.joints])
    assert np.abs(found.samples.raw["position"] - amplitude * np.sin(6 * t[:, None] + phase)).max() < 1e-6
    assert len(found.gaps) == 1
    assert 98 <= found.counters["samples.in_gaps"] <= 102
    assert "to 1000 Hz: positions by cubic splines" in found.metadata["resampled"]
    assert import_recording(path, TX40, resample_hz=250.0).sample_rate_hz == 250.0
    out = ["import", str(path), "--config", "tx40.yaml", "--resample", "1000", "--out", str(tmp_path / "a.mcap")]
    assert CliRunner().invoke(application(["import"]), out).exit_code == 0


def test_rows_that_were_polled_twice_as_fast_are_said(tmp_path: Path) -> None:
    values = np.repeat(motion(), 2, axis=0)
    values[:, 0] = np.arange(len(values)) / 2000
    path = written(tmp_path / "a.csv", values)
    remarks = import_recording(path, TX40).metadata["source_remarks"]
    assert "50.1 % of the rows repeat the row before" in remarks
    assert "--resample RATE, with the rate of the controller" in remarks
    assert same(import_recording(path, TX40, resample_hz=1000), motion())


def test_polled_rows_with_times_are_put_on_the_clock_of_the_controller(tmp_path: Path) -> None:
    q, tau = moving_panda()
    rng = np.random.default_rng(5)
    asked = np.sort(np.append(np.arange(len(q)), rng.integers(0, len(q), len(q) // 15)))
    rows = asked[rng.random(len(asked)) > 1 / 12]
    t = np.linspace(0, 4.0, len(rows)) + rng.uniform(0, 4e-4, len(rows))
    names = ["t", *(f"q{j + 1}" for j in range(7)), *(f"tau{j + 1}" for j in range(7))]
    path = written(tmp_path / "a.csv", np.column_stack([t, q[rows], tau[rows]]), names)
    for rate in (None, 1000.0):
        with pytest.raises(DataError, match=r"the samples were polled; --resample RATE"):
            import_recording(path, PANDA, rate_hz=rate)
    found = import_recording(path, PANDA, resample_hz=1000.0)
    asked_for = import_recording(path, PANDA, rate_hz=1000.0, polled=True)
    assert found.sha256 == asked_for.sha256
    assert abs(len(found.samples.sync) - len(q)) < 30
    assert "polled samples put on a clock of 1000 Hz" in found.metadata["source_remarks"]
    with pytest.raises(DataError, match=r"the motion takes .* at the 250 Hz of --resample, but .* by the column"):
        import_recording(path, PANDA, resample_hz=250.0)


def lerobot(folder: Path, names: list[str] | None, extra: str = "observation.effort") -> Path:
    """Write a data set of two episodes at 50 Hz."""
    import pyarrow
    import pyarrow.parquet

    values = motion(300, 50.0)
    data = folder / "data" / "chunk-000" / "file-000.parquet"
    data.parent.mkdir(parents=True)
    (folder / "meta").mkdir()
    features = {} if names is None else {"observation.state": {"dtype": "float32", "names": names}}
    (folder / "meta" / "info.json").write_text(json.dumps({"fps": 50, "features": features}))
    columns = {
        "observation.state": values[:, 1 : N + 1].tolist(),
        "action": (values[:, 1 : N + 1] + 0.001).tolist(),
        extra: values[:, N + 1 :].tolist(),
        "timestamp": np.append(values[:200, 0], values[:100, 0]).astype(np.float32),
        "episode_index": np.append(np.zeros(200, int), np.ones(100, int)),
    }
    pyarrow.parquet.write_table(pyarrow.table(columns), data)
    return data


@pytest.mark.parametrize("names", [None, [f"joint_{j + 1}.pos" for j in range(N)]])
def test_a_lerobot_data_set_is_imported_as_file_and_folder(tmp_path: Path, names: list[str] | None) -> None:
    data = lerobot(tmp_path / "set", names)
    for path in (data, tmp_path / "set"):
        found = import_recording(path, TX40)
        assert same(found, motion(300, 50.0))
        assert found.sample_rate_hz == pytest.approx(50, rel=1e-4)
        assert [(gap.first, gap.last) for gap in found.gaps if gap.stream == "samples"] == [(200, 248)]
        assert "demand" in found.samples.fields
        assert "2 episodes" in found.metadata["source_remarks"]


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


def test_positions_in_degrees_and_torques_in_mn_m_name_the_option(tmp_path: Path) -> None:
    values = motion()
    values[:, 1 : N + 1] *= 5 * 180 / np.pi
    with pytest.raises(DataError, match=r"its limit is .*--units position=deg if they are in deg"):
        import_recording(written(tmp_path / "a.csv", values), TX40)
    values = motion()
    values[:, N + 1 :] *= 1000
    with pytest.raises(DataError, match=r"its limit is .*--units torque=mnm if they are in mnm"):
        import_recording(written(tmp_path / "b.csv", values), TX40)
    free = Limits(position=(-np.inf, np.inf), velocity=2.0)
    endless = TX40.model_copy(update={"joints": tuple(j.model_copy(update={"limits": free}) for j in TX40.joints)})
    values[:, 1 : N + 1] *= 180 / np.pi
    remarks = import_recording(written(tmp_path / "c.csv", values), endless).metadata["source_remarks"]
    assert "times the limit, as of positions in degrees (--units position=deg)" in remarks
    assert "source_remarks" not in import_recording(written(tmp_path / "d.csv", motion()), endless).metadata


def test_a_demand_that_is_not_found_can_be_omitted(tmp_path: Path) -> None:
    names = [*NAMES, *(f"qr{j + 1}" for j in range(N + 1))]
    path = written(tmp_path / "a.csv", np.hstack([motion(), np.zeros((400, N + 1))]), names)
    with pytest.raises(
        DataError, match=r"demand: has a column qr7, but the robot has 6 joints.*; --map demand=- omits it"
    ):
        import_recording(path, TX40)
    assert same(import_recording(path, TX40, names={"demand": "-"}), motion())


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


def test_a_message_shortens_long_names_of_columns(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"t,q1,{'9' * 5000}\n0,1,2\n1,2,3\n")
    with pytest.raises(DataError, match=rf"found t, q1, {'9' * 60}\.\.\.") as refused:
        import_recording(path, TX40)
    assert len(str(refused.value)) < 1000


def test_values_that_overflow_are_refused_without_warnings(tmp_path: Path) -> None:
    values = motion(40)
    values[7, 3] = 1e308
    path = written(tmp_path / "a.csv", values)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(DataError, match=r"line 9, column q3: 1e\+308 is no measurement"):
            import_recording(path, TX40)


def with_columns(path: Path, names: list[str], values: np.ndarray) -> Path:
    """Write the motion of `motion` with further columns."""
    return written(path, np.hstack([motion(), values]), [*NAMES, *names])


@pytest.mark.parametrize(
    "name",
    [
        "qr{j}", "reference{j}", "ref_{j}", "q_ref{j}", "q{j}_ref", "qref{j}", "q_des[{j}]", "setpoint_{j}",
        "set point {j}", "target{j}", "target_q_{i}", "targetPosition{j}", "desired_position_{j} [rad]", "command{j}",
        "commanded_pos_{j}", "posCmd{j}", "demand{j}", "joint_{j}_ref", "/arm/joint_{j}/reference/position",
        "goal_position.joint_{j}", "JOINT {j} setpoint",
    ],
)  # fmt: skip
def test_a_demand_is_found_by_the_words_of_other_tools(tmp_path: Path, name: str) -> None:
    demand = motion()[:, 1 : N + 1] + 0.001
    names = [name.format(j=j + 1, i=j) for j in range(N)]
    found = import_recording(with_columns(tmp_path / "a.csv", names, demand), TX40)
    assert np.allclose(found.samples.raw["demand"], demand, rtol=0, atol=1e-8)
    assert same(found, motion())


@pytest.mark.parametrize(
    "names",
    [
        [f"target_qd_{j}" for j in range(N)], [f"joint_{j + 1}_torque_ref" for j in range(N)],
        [f"reference{j + 1}" for j in range(N - 1)], ["setpoint"], ["ref_velocity_joint_1"],
    ],
)  # fmt: skip
def test_a_demand_of_no_joint_positions_is_named_once_and_left_out(tmp_path: Path, names: list[str]) -> None:
    table = with_columns(tmp_path / "a.csv", names, np.ones((400, len(names))))
    found = import_recording(table, TX40)
    assert "demand" not in found.samples.fields
    remarks = found.metadata["source_remarks"]
    assert f"without a demand: {names[0]}" in remarks
    assert "--map demand=NAME" in remarks
    assert "source_remarks" not in import_recording(table, TX40, names={"demand": "-"}).metadata


def test_one_of_two_demands_is_taken_and_the_other_is_named(tmp_path: Path) -> None:
    demand = motion()[:, 1 : N + 1]
    names = [f"{word}_q_{j}" for word in ("target", "command") for j in range(N)]
    found = import_recording(with_columns(tmp_path / "a.csv", names, np.hstack([demand + 0.001, demand])), TX40)
    assert np.allclose(found.samples.raw["demand"], demand + 0.001, rtol=0, atol=1e-8)
    assert "not from command_q_0" in found.metadata["source_remarks"]


def test_a_demand_of_a_single_joint_needs_no_number(tmp_path: Path) -> None:
    robot = load_robot("emps.yaml")
    t = np.arange(400) / 1000.0
    q = 0.01 * np.sin(6 * t)
    table = written(tmp_path / "a.csv", np.column_stack([t, q, np.cos(t), q + 1e-4]), ["t", "q", "tau", "reference"])
    assert np.allclose(import_recording(table, robot).samples.raw["demand"][:, 0], q + 1e-4, rtol=0, atol=1e-8)
