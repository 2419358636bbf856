"""Columns of tables whose names alone lead to wrong numbers: units, case, and the order of the joints."""

import gzip
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from armident.configs import ConfigError, DataError
from armident.daq.interchange.importing import import_recording
from tests.unit.daq.tables import NAMES, N, motion, same, written
from tests.unit.daq.test_importing import TX40

ORDER = [2, 0, 1, 3, 4, 5]
WORDS = [TX40.joints[k].name for k in ORDER]


def bag_in_csv(path: Path, texts: list[str], cells: list[str], values: np.ndarray) -> Path:
    names = ["time", *texts, *(f"position_{k}" for k in range(N)), *(f"effort_{k}" for k in range(N))]
    rows = (",".join([f"{row[0]:.9g}", *cells, *(f"{x:.9g}" for x in row[1:])]) for row in values)
    path.write_text("\n".join([",".join(names), *rows]) + "\n")
    return path


def test_names_of_joints_in_text_contradict_numbered_columns(tmp_path: Path) -> None:
    values = motion()
    one = bag_in_csv(tmp_path / "a.csv", ["frame", "name"], ["base", f'"{WORDS}"'], values)
    each = bag_in_csv(tmp_path / "b.csv", [f"name[{k}]" for k in range(N)], WORDS, values)
    for path in (one, each):
        with pytest.raises(DataError, match=r"another order than the robot: joint_3, joint_1, .* joint_3/position"):
            import_recording(path, TX40)
        assert same(import_recording(path, TX40, by_position=True), values)
    usual = [joint.name for joint in TX40.joints]
    assert same(import_recording(bag_in_csv(tmp_path / "c.csv", ["name"], [f'"{usual}"'], values), TX40), values)


def test_names_of_joints_in_a_list_of_parquet_contradict_numbered_columns(tmp_path: Path) -> None:
    values = motion()
    table = pd.DataFrame(values, columns=NAMES)
    table.insert(0, "name", [WORDS] * len(values))
    table.to_parquet(tmp_path / "a.parquet")
    with pytest.raises(DataError, match="another order than the robot"):
        import_recording(tmp_path / "a.parquet", TX40)


@pytest.mark.parametrize("line", ["s{0}", "# s{0}", "# units: s{0}"])
def test_units_above_the_names_are_those_of_the_columns(tmp_path: Path, line: str) -> None:
    values = motion()
    shown = values.copy()
    shown[:, 1 : N + 1] *= np.degrees(0.01)
    shown[:, N + 1 :] *= 1e3
    path = written(tmp_path / "a.csv", shown)
    path.write_text(line.format(",deg" * N + ",N mm" * N) + "\n" + path.read_text())
    values[:, 1 : N + 1] *= 0.01
    assert same(import_recording(path, TX40), values)


@pytest.mark.parametrize(("angle", "torque"), [(" / deg", " / N mm"), ("/°", "/N mm"), ("_degrees", "_N mm")])
def test_units_behind_a_stroke_are_those_of_the_columns(tmp_path: Path, angle: str, torque: str) -> None:
    values = motion()
    shown = values.copy()
    shown[:, 1 : N + 1] *= np.degrees(0.01)
    shown[:, N + 1 :] *= 1e3
    shown[:, 0] *= 1e3
    names = ["t / ms", *(f"q{j + 1}{angle}" for j in range(N)), *(f"tau{j + 1}{torque}" for j in range(N))]
    values[:, 1 : N + 1] *= 0.01
    assert same(import_recording(written(tmp_path / "a.csv", shown, names), TX40), values)


def test_a_name_in_another_case_is_another_quantity(tmp_path: Path) -> None:
    values = motion()
    forces = np.column_stack([values[:, 0], 0.1 * values[:, 1 : N + 1], values[:, 1:]])
    path = written(tmp_path / "a.csv", forces, ["t", *(f"Q{j + 1}" for j in range(N)), *NAMES[1:]])
    assert same(import_recording(path, TX40), values)
    values[:, 1 : N + 1] *= 0.1
    assert same(import_recording(path, TX40, names={"position": "Q"}), values)


def test_packed_files_are_named(tmp_path: Path) -> None:
    for name, data, how in [
        ("a.csv.gz", gzip.compress(b"t,q1"), "compressed by gzip; unpack it first"),
        ("a.csv", b"PK\x03\x04", "an Excel workbook or a ZIP archive; save the sheet as CSV"),
    ]:
        (tmp_path / name).write_bytes(data)
        with pytest.raises(ConfigError, match=how):
            import_recording(tmp_path / name, TX40)
