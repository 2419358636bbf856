"""Bus logs in CSV, whatever their tool, and of BUSMASTER."""

from collections.abc import Callable, Iterable
from pathlib import Path

import can
import pytest
from typer.testing import CliRunner

from armident.configs import ConfigError, DataError
from armident.daq.cli import application
from armident.daq.interchange.importing import import_recording
from armident.daq.interchange.readers import reader_of
from tests.unit.daq.tables import motion, written
from tests.unit.daq.test_bus_log import ROBOT, SESSION
from tests.unit.daq.test_log_files import ROWS, lines_of, messages, read, same

SAVVYCAN = "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8"
FIRST = messages()[0].timestamp


def since(message: can.Message) -> float:
    return message.timestamp - FIRST


def savvycan(message: can.Message, filling: str = "") -> str:
    data = [f"{octet:02X}" for octet in message.data] + [filling] * (8 - len(message.data))
    kind = "true" if message.is_extended_id else "false"
    where = f"{message.arbitration_id:08X},{kind},Rx,0,{len(message.data)}"
    return f"{round(since(message) * 1e6)},{where},{','.join(data)},"


def table(path: Path, heading: str, rows: Iterable[str]) -> Path:
    path.write_text("\n".join([heading, *rows]) + "\n")
    return path


def of_a_data_logger(m: can.Message) -> str:
    size = len(m.data)
    return f"{1.7e9 + since(m):.6f};0;{m.arbitration_id:x};0;{size};{size};0;0;0;0;0;{m.data.hex()}"


def with_spaces(m: can.Message) -> str:
    return f"{since(m) * 1e3:.4f}\t0x{m.arbitration_id:03X}\t{len(m.data)}\t{m.data.hex(' ')}"


def in_decimal(m: can.Message) -> str:
    return f"{since(m):.6f},{m.arbitration_id},{len(m.data)},{' '.join(map(str, m.data))}"


def with_columns_of_bytes(m: can.Message) -> str:
    data = [f"0x{octet:02X}" for octet in m.data] + [""] * (8 - len(m.data))
    return f"0;0x{m.arbitration_id:X};{len(m.data)};{';'.join(data)};{since(m):.6f}"


def with_time_of_day(m: can.Message) -> str:
    return f"23:15:{since(m):09.6f},{m.arbitration_id:X},{m.data.hex('-')}"


def with_decimal_commas(m: can.Message) -> str:
    return f"{since(m):.6f};{m.arbitration_id:X}h;{len(m.data)};{m.data.hex()}".replace(".", ",")


FORMS = {
    "savvycan": (SAVVYCAN, savvycan),
    "savvycan with zeros": (SAVVYCAN, lambda m: savvycan(m, "00")),
    "first version of savvycan": (SAVVYCAN.replace("Dir,", ""), lambda m: savvycan(m).replace(",Rx", "")),
    "data logger": (
        "TimestampEpoch;BusChannel;ID;IDE;DLC;DataLength;Dir;EDL;BRS;ESI;RTR;DataBytes", of_a_data_logger,
    ),
    "bytes with spaces": ("Time [ms]\tCAN ID\tLength\tData", with_spaces),
    "decimal commas": ("Time;ID;DLC;Data", with_decimal_commas),
    "decimal": ("Time (s),CAN ID (dec),DLC,Data", in_decimal),
    "columns with 0x": ("Channel;ID;DLC;" + ";".join(f"D{k}" for k in range(8)) + ";Time", with_columns_of_bytes),
    "time of day": ("Time,ID,Data", with_time_of_day),
    "us since 1970": ("timestamp,id,data", lambda m: f"{round(m.timestamp * 1e6)},{m.arbitration_id:x},{m.data.hex()}"),
    "ns": ("time_ns,id,data", lambda m: f"{round(since(m) * 1e9)},{m.arbitration_id:x},{m.data.hex()}"),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_a_bus_log_in_csv_is_read_by_the_names_of_its_columns(tmp_path: Path, form: str) -> None:
    heading, row = FORMS[form]
    path = table(tmp_path / "a.csv", heading, map(row, messages()))
    found = import_recording(path, SESSION)
    assert same(found)
    assert "source_remarks" not in found.metadata


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6)])
def test_times_without_their_unit_are_named(tmp_path: Path, unit: str, factor: float) -> None:
    rows = [f"{since(m) * factor:.9g},{m.arbitration_id:x},{m.data.hex()}" for m in messages()]
    with pytest.raises(DataError, match=rf"times in {unit} fit SYNC every .*: name their column 'time \[{unit}\]'"):
        import_recording(table(tmp_path / "a.csv", "time,id,data", rows), SESSION)
    assert same(import_recording(table(tmp_path / "b.csv", f"time [{unit}],id,data", rows), SESSION))


@pytest.mark.parametrize(
    ("row", "said"),
    [
        (lambda m: f"{since(m):.6f},{m.arbitration_id},{m.data.hex()}", "128 is SYNC in decimal: .* 'ID (dec)'"),
        (lambda m: f"{since(m):.6f},{m.arbitration_id:x},x {m.data.hex(' ')}", "data have two hexadecimal digits"),
    ],
)
def test_numbers_of_another_base_are_named(tmp_path: Path, row: Callable[[can.Message], str], said: str) -> None:
    with pytest.raises(DataError, match=said.replace("(", r"\(").replace(")", r"\)")):
        import_recording(table(tmp_path / "a.csv", "time,id,data", map(row, messages())), SESSION)


def test_the_csv_of_python_can_is_read(tmp_path: Path) -> None:
    with can.CSVWriter(tmp_path / "a.csv") as writer:
        for message in messages():
            writer.on_message_received(message)
    assert same(import_recording(tmp_path / "a.csv", SESSION))


def test_other_frames_damaged_lines_and_a_cut_end_of_a_csv_are_counted(tmp_path: Path) -> None:
    rows = [savvycan(message) for message in messages()]
    extended = savvycan(can.Message(timestamp=FIRST, arbitration_id=0x18FF50E5, data=b"\1"))
    longer = f"0,00000123,false,Rx,0,12,{','.join(['00'] * 8)},"
    path = table(tmp_path / "a.csv", SAVVYCAN, [*rows[:40], extended, longer, "no frame", *rows[40:]])
    last = rows[-1]
    text = path.read_text()
    path.write_text(text[: text.rindex(last) + len(last) - 8])
    found = read(path)
    assert same(found, ROWS - 1)
    assert found.counters["log.foreign"] == 2
    remarks = found.metadata["source_remarks"]
    assert "line 44 is not a line of a CSV log and left out: 'no frame'" in remarks
    assert "is cut off and left out" in remarks


def test_the_newest_row_may_come_first_in_a_csv(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", SAVVYCAN, reversed([savvycan(message) for message in messages()]))
    found = read(path)
    assert same(found)
    assert "the newest frame comes first" in found.metadata["source_remarks"]


def test_the_contents_of_a_text_file_tell_a_log_from_a_table(tmp_path: Path) -> None:
    source, _ = lines_of(tmp_path, ".log")
    log = source.rename(tmp_path / "candump.txt")
    assert same(import_recording(log, SESSION))
    motion_table = written(tmp_path / "t.csv", motion())
    assert (reader_of(log).name, reader_of(motion_table).name) == ("bus log", "CSV")
    currents = table(tmp_path / "dq.csv", "time,id,iq,q1", ["0.0,1.0,2.0,3.0", "0.1,1.0,2.0,3.0"])
    assert reader_of(currents).name == "CSV"
    with pytest.raises(ConfigError, match="configuration of the session"):
        import_recording(log, None)
    command = ["import", str(motion_table), "--config", "tx40_cell.yaml", "--out", str(tmp_path / "a.mcap")]
    refused = CliRunner().invoke(application(["import"]), command)
    assert refused.exit_code == 2
    assert "a robot file is wanted" in refused.stderr.replace("\n", " ")
    assert "is a CSV, not a bus log, whose text has columns for time" in " ".join(refused.stderr.split())


HEAD = """***BUSMASTER Ver 3.2.2***
***PROTOCOL CAN***
***[START LOGGING SESSION]***
***START DATE AND TIME 25:3:2026 23:59:59:990***
***{base}***
***{mode} MODE***
***<Time><Tx/Rx><Channel><CAN ID><Type><DLC><DataBytes>***
"""


def busmaster(path: Path, mode: str = "SYSTEM", base: str = "HEX", begin: float = 86399.99) -> Path:
    lines, before = [], 0.0
    for message in messages():
        t = begin + since(message) if mode != "RELATIVE" else round(since(message), 4) - before
        before = round(since(message), 4)
        tenths = round(t * 1e4) % (86400 * 10000)
        clock = f"{tenths // 36000000:02d}:{tenths // 600000 % 60:02d}:{tenths // 10000 % 60:02d}:{tenths % 10000:04d}"
        data = message.data.hex(" ").upper() if base == "HEX" else " ".join(map(str, message.data))
        identifier = f"0x{message.arbitration_id:03X}" if base == "HEX" else str(message.arbitration_id)
        lines.append(f"{clock} Rx 1 {identifier} s {len(message.data)} {data}\n")
    clock = lines[9].split()[0] if mode != "RELATIVE" else "00:00:00:0000"
    lines[9:9] = [f"{clock} Rx 1 0x18FF50E5 x 1 00\n", "***[STOP LOGGING SESSION]***\n"]
    path.write_text(HEAD.format(base=base, mode=mode) + "".join(lines))
    return path


@pytest.mark.parametrize("mode", ["SYSTEM", "ABSOLUTE", "RELATIVE"])
@pytest.mark.parametrize("base", ["HEX", "DEC"])
def test_a_log_of_busmaster_is_read_in_every_mode(tmp_path: Path, mode: str, base: str) -> None:
    begin = 86399.99 if mode == "SYSTEM" else 0.0
    found = read(busmaster(tmp_path / "a.log", mode, base, begin))
    assert same(found)
    assert found.counters["log.foreign"] == 1
    # Midnight passes after 10 ms: times go on.
    lasts = int(found.samples.t_ns[-1] - found.samples.t_ns[0])
    assert lasts == pytest.approx((ROWS - 1) * 200_000, abs=400_000)
    assert found.samples.t_ns[0] > 1_774_000_000 * 10**9


def test_a_csv_whose_columns_name_no_data_is_a_table_without_positions(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "time,id,dlc", ["0.0,80,1", "0.1,80,1"])
    with pytest.raises(DataError, match="expected columns q1"):
        import_recording(path, ROBOT)
