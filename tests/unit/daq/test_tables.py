"""Tables as tools write them: spellings of columns, units, and damaged lines."""

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armident.configs import DataError, Limits, load_robot
from armident.daq.interchange.importing import import_recording
from tests.unit.daq.tables import NAMES, N, motion, same, written
from tests.unit.daq.test_importing import TX40

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


def test_a_stated_name_may_be_the_word_beside_the_names_of_joints(tmp_path: Path) -> None:
    order = [0, *range(6, 0, -1), *range(12, 6, -1)]
    names = ["Zeit", *(f"{joint.name} Winkel" for joint in TX40.joints), *(f"Moment {j.name}" for j in TX40.joints)]
    path = written(tmp_path / "a.csv", motion()[:, order], [names[k] for k in order])
    stated = {"time": "Zeit", "position": "winkel", "torque": "Moment"}
    assert same(import_recording(path, TX40, names=stated), motion())
    with pytest.raises(DataError, match="no column named 'Kraft'; found Zeit, joint_6 Winkel"):
        import_recording(path, TX40, names=stated | {"torque": "Kraft"})


def test_the_log_of_libfranka_has_measured_and_desired_positions(tmp_path: Path) -> None:
    values = motion()
    kinds = {
        "state.q": values[:, 1 : N + 1],
        "state.q_d": values[:, 1 : N + 1] + 1e-4,
        "state.tau_J": values[:, N + 1 :],
    }
    columns = [1e3 * values[:, :1] + 812345, *kinds.values(), 0 * values[:, 1 : N + 1]]
    names = ["time", *(f"{kind}[{j}]" for kind in (*kinds, "cmd.tau_J_d") for j in range(N))]
    found = import_recording(written(tmp_path / "a.csv", np.hstack(columns), names), TX40, time_unit="ms")
    assert same(found, values)
    assert np.allclose(found.samples.raw["demand"], kinds["state.q_d"], rtol=0, atol=1e-8)
    assert found.metadata["source_remarks"].count("counted from 0") == 1


def test_a_name_that_two_columns_have_is_refused_only_where_it_is_needed(tmp_path: Path) -> None:
    older = ["duration", *(f" {kind}[{j}]" for kind in ("q", "tau_J", "dq_d", "dq_d") for j in range(N))]
    values = np.hstack([motion(), np.ones((400, 2 * N))])
    assert same(import_recording(written(tmp_path / "a.csv", values, older), TX40), motion())
    path = written(tmp_path / "b.csv", motion(), ["t", "q1", *NAMES[1:6], *NAMES[7:]])
    with pytest.raises(DataError, match=r"expected columns q1\.\.q6 .*found t, q1 in 2 columns, q2"):
        import_recording(path, TX40)


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
    with pytest.raises(DataError, match="--time-unit us contradicts the name of the time column, which states ms"):
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
    assert "100 rows without positions and efforts ignored" in found.metadata["source_remarks"]
    (tmp_path / "b.csv").write_text("\n".join([",".join(names), *rows]).replace(",31.5", ",").replace("0.0", "0.1", 1))
    shifted = [r if k % 3 else f"{float(r.split(',')[0]) + 2e-4:.9g}," + r.split(",", 1)[1] for k, r in enumerate(rows)]
    (tmp_path / "b.csv").write_text("\n".join([",".join(names), *shifted]) + "\n")
    with pytest.raises(DataError, match="sparse rows of several topics"):
        import_recording(tmp_path / "b.csv", TX40)


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
    assert "times the limit; check for positions in degrees (--units position=deg)" in remarks
    said = import_recording(written(tmp_path / "d.csv", motion()), endless).metadata["source_remarks"]
    assert "joint_3 2 rad/s, reached 2.25" in said
    assert "joint_2" not in said


def test_a_demand_that_is_not_found_can_be_omitted(tmp_path: Path) -> None:
    names = [*NAMES, *(f"qr{j + 1}" for j in range(N + 1))]
    path = written(tmp_path / "a.csv", np.hstack([motion(), np.zeros((400, N + 1))]), names)
    with pytest.raises(
        DataError, match=r"demand: has a column qr7, but the robot has 6 joints.*; --map demand=- omits it"
    ):
        import_recording(path, TX40)
    assert same(import_recording(path, TX40, names={"demand": "-"}), motion())


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
        with pytest.raises(DataError, match=r"line 9, column q3: 1e\+308 is too large for a measurement"):
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
