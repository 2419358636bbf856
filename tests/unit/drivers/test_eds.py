"""Electronic data sheets as the tools of many makers write them."""

import logging
from pathlib import Path
from typing import Any

import canopen
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armident.configs import ConfigError
from armident.configs.loading import HERE
from armident.drivers.canopen import eds, eds_text
from armident.drivers.canopen.eds import read_eds, read_objects

SHIPPED = HERE / "eds" / "cia402_servo.eds"
NODE = 5
PLAIN = """[DeviceInfo]
VendorName=Drives
VendorNumber=1
[1000]
ParameterName=Device type
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x20192
[1018]
ParameterName=Identity
ObjectType=0x9
SubNumber=2
[1018sub0]
ParameterName=Largest subindex
ObjectType=0x7
DataType=0x0005
AccessType=const
DefaultValue=1
[1018sub1]
ParameterName=Vendor
ObjectType=0x7
DataType=0x0007
AccessType=ro
DefaultValue=0x2AB
[1800]
ParameterName=TPDO 1
ObjectType=0x9
[1800sub1]
ParameterName=COB-ID
ObjectType=0x7
DataType=0x0007
AccessType=rw
DefaultValue=$NODEID+0x180
"""


def written(folder: Path, text: str, encoding: str = "utf-8", name: str = "drive.eds") -> Path:
    path = folder / name
    path.write_bytes(text.encode(encoding))
    return path


def variable(objects: canopen.ObjectDictionary, index: int, subindex: int = 0) -> Any:
    found = objects.get_variable(index, subindex)
    assert found is not None
    return found


def default(objects: canopen.ObjectDictionary, index: int, subindex: int = 0) -> object:
    found = objects.get_variable(index, subindex)
    return None if found is None else found.default


def contents(objects: canopen.ObjectDictionary) -> dict[tuple[int, int | None], tuple[object, ...]]:
    found: dict[tuple[int, int | None], tuple[object, ...]] = {}
    for index, entry in objects.items():
        own = {None: entry} if hasattr(entry, "data_type") else entry.subindices
        for sub, v in own.items():
            found[index, sub] = (v.name, v.data_type, v.access_type, v.default, v.pdo_mappable, v.min, v.max)
    return found


def test_a_sheet_that_follows_cia_306_is_read_as_canopen_reads_it() -> None:
    sheet = read_eds(SHIPPED, NODE)
    assert contents(sheet.objects) == contents(canopen.import_od(str(SHIPPED), NODE))
    assert sheet.remarks == ()


@pytest.mark.parametrize(
    ("change", "encoding"),
    [
        (lambda text: text, "utf-8-sig"),
        (lambda text: text, "utf-16"),
        (lambda text: text.replace("\n", "\r\n"), "utf-8-sig"),
        (lambda text: text.replace("VendorName=Drives", "VendorName=Antriebe Größe 40 °C"), "cp1252"),
        (lambda text: text.replace("VendorNumber=1", "VendorNumber=001"), "utf-8"),
        (lambda text: text.replace("VendorNumber=1", "VendorNumber="), "utf-8"),
        (lambda text: "\n".join(_capitals(line) for line in text.splitlines()), "utf-8"),
        (lambda text: "\n".join(_capitals(line).lower() for line in text.splitlines()), "utf-8"),
        (lambda text: text.replace("=", " = ").replace("ObjectType", "  ObjectType"), "utf-8"),
        (lambda text: text.replace("[1018sub1]", "[ 1018 Sub01 ]  ; vendor"), "utf-8"),
        (lambda text: text.replace("AccessType=rw\n", "AccessType=rw\nPDOMapping=\n"), "utf-8"),
        (lambda text: text.replace("0x20192", "0X20192 ; servo drive"), "utf-8"),
        (lambda text: text.replace("0x20192", "20192h"), "utf-8"),
        (lambda text: text.replace("$NODEID+0x180", "0x180 + $NodeID"), "utf-8"),
        (lambda text: text.replace("$NODEID+0x180", "($NODEID+0x180)"), "utf-8"),
        (lambda text: text.replace("0x20192", "0x20192 // servo drive"), "utf-8"),
        (lambda text: text.replace("[1000]", "[0x1000]").replace("[1018sub1]", "[1018hsub01h]"), "utf-8"),
        (lambda text: text + "[DummyUsage]\nDummy0001=0\nDummy0005=1\n", "utf-8"),
        (lambda text: text + "[Comments]\nLines=many\nLine1=free text\n", "utf-8"),
        (lambda text: text + "[DeviceComissioning]\nNodeID=\nBaudrate=1 Mbit/s\n", "utf-8"),
        (lambda text: text + "[0040]\nObjectType=0x6\n[0040sub0]\nDataType=5\n", "utf-8"),
        (lambda text: text + "\x1a", "utf-8"),
    ],
)
def test_spellings_of_other_tools_change_nothing(tmp_path: Path, change: object, encoding: str) -> None:
    assert callable(change)
    sheet = read_eds(written(tmp_path, change(PLAIN), encoding), NODE)
    assert default(sheet.objects, 0x1000) == 0x20192
    assert default(sheet.objects, 0x1018, 1) == 0x2AB
    assert default(sheet.objects, 0x1800, 1) == 0x180 + NODE
    assert variable(sheet.objects, 0x1800, 1).access_type == "rw"
    assert sheet.remarks == ()


def _capitals(line: str) -> str:
    key, separator, value = line.partition("=")
    return key.upper() + separator + value


def test_texts_keep_the_letters_of_windows_1252(tmp_path: Path) -> None:
    sheet = read_eds(written(tmp_path, PLAIN.replace("=Vendor\n", "=Größe (°)\n"), "cp1252"), NODE)
    assert variable(sheet.objects, 0x1018, 1).name == "Größe (°)"


def test_a_missing_parameter_name_is_the_index(tmp_path: Path) -> None:
    text = PLAIN.replace("ParameterName=Vendor\n", "").replace("ParameterName=Identity\n", "")
    sheet = read_eds(written(tmp_path, text), NODE)
    assert sheet.objects[0x1018].name == "1018h"
    assert variable(sheet.objects, 0x1018, 1).name == "1018h:01"
    assert default(sheet.objects, 0x1018, 1) == 0x2AB


def test_a_section_of_an_object_may_be_missing_or_behind_its_entries(tmp_path: Path) -> None:
    without = PLAIN.replace("[1018]\nParameterName=Identity\nObjectType=0x9\nSubNumber=2\n", "")
    behind = without + "[1018]\nParameterName=Identity\nObjectType=0x9\nSubNumber=2\n"
    for text in (without, behind):
        assert default(read_eds(written(tmp_path, text), NODE).objects, 0x1018, 1) == 0x2AB


def test_a_compact_array_has_all_its_entries(tmp_path: Path) -> None:
    array = (
        "[2000]\nParameterName=Log\nObjectType=0x8\nDataType=0x0006\nAccessType=ro\nDefaultValue=7\nCompactSubObj=3\n"
    )
    names = "[2000Name]\nNrOfEntries=1\n2=Second\n[2000Value]\nNrOfEntries=1\n3=9\n"
    objects = read_eds(written(tmp_path, PLAIN + array + names), NODE).objects
    assert [default(objects, 0x2000, k) for k in range(4)] == [3, 7, 7, 9]
    assert [variable(objects, 0x2000, k).name for k in (1, 2)] == ["Log_1", "Second"]


def test_a_compact_array_without_data_type_is_left_out_and_said(tmp_path: Path) -> None:
    text = PLAIN + "[2000]\nParameterName=Log\nObjectType=0x8\nCompactSubObj=0x10\n"
    sheet = read_eds(written(tmp_path, text), NODE)
    assert 0x2000 not in sheet.objects
    assert default(sheet.objects, 0x1018, 1) == 0x2AB
    assert sheet.remarks == ("objects without DataType, left out: 2000h",)


def test_a_domain_needs_no_data_type(tmp_path: Path) -> None:
    sheet = read_eds(written(tmp_path, PLAIN + "[1F50]\nParameterName=Program\nObjectType=0x2\n"), NODE)
    assert variable(sheet.objects, 0x1F50).data_type == eds.DOMAIN_TYPE
    assert sheet.remarks == ()


def test_a_data_type_of_the_maker_is_looked_up(tmp_path: Path) -> None:
    text = "[2001]\nParameterName={}\nObjectType=7\nDataType={}\nAccessType=rw\n"
    own = "[00A0]\nObjectType=6\n[00A0sub1]\nDataType=5\nDefaultValue=0x0003\n"
    known = read_eds(written(tmp_path, PLAIN + own + text.format("Mode", "0xA0")), NODE).objects
    unknown = read_eds(written(tmp_path, PLAIN + text.format("Mode", "0xA1")), NODE).objects
    assert (variable(known, 0x2001).data_type, variable(unknown, 0x2001).data_type) == (3, eds.DOMAIN_TYPE)


def test_copies_of_sections_keep_the_first_values_and_say_a_difference(tmp_path: Path) -> None:
    copy = "[1018SUB1]\nParameterName=Vendor\nDataType=0x0007\nDefaultValue={}\nLowLimit=1\n"
    same = read_eds(written(tmp_path, PLAIN + copy.format("0x2AB")), NODE)
    other = read_eds(written(tmp_path, PLAIN + copy.format("0x2AC")), NODE)
    assert same.remarks == ()
    assert default(other.objects, 0x1018, 1) == 0x2AB
    assert variable(other.objects, 0x1018, 1).min == 1
    (remark,) = other.remarks
    assert "that differ" in remark
    assert "[1018sub1] DefaultValue" in remark


def test_stray_lines_are_ignored_and_counted(tmp_path: Path) -> None:
    text = PLAIN.replace("[1000]", "generated by a tool\n[1000]") + "\n".join(["end", "of", "file", "!"])
    (remark,) = read_eds(written(tmp_path, text), NODE).remarks
    assert "line 4 'generated by a tool'" in remark
    assert remark.endswith("and 2 more")


def test_a_broken_bracket_does_not_give_its_keys_to_the_object_before(tmp_path: Path) -> None:
    objects = read_eds(written(tmp_path, PLAIN.replace("[1018sub1]", "[1018sub1")), NODE).objects
    assert default(objects, 0x1018, 0) == 1
    assert default(objects, 0x1018, 1) == 0x2AB


@pytest.mark.parametrize(
    ("value", "number", "said"),
    [("010", 10, "leading zero, read as decimal"), ("abc", None, "no integers, left out"), ("007", 7, None)],
)
def test_undecided_numbers_are_said(tmp_path: Path, value: str, number: int | None, said: str | None) -> None:
    sheet = read_eds(written(tmp_path, PLAIN.replace("=0x2AB", f"={value}")), NODE)
    assert default(sheet.objects, 0x1018, 1) == number
    assert len(sheet.remarks) == (said is not None)
    assert said is None or (said in sheet.remarks[0] and f"1018h:01 DefaultValue={value}" in sheet.remarks[0])


@pytest.mark.parametrize("heading", ["[OptionalObjects]", "[OPTIONALOBJECTS]"])
def test_objects_of_the_lists_without_a_section_are_named(tmp_path: Path, heading: str) -> None:
    text = f"{heading}\nSupportedObjects=3\n1=0x1000\n2=0x1018\n3=0x6064\n" + PLAIN
    sheet = read_eds(written(tmp_path, text.replace("[1018]\n", "[stray]\n")), NODE)
    assert sheet.remarks == (f"{eds.LACKING}: 6064h",)


def test_a_dcf_is_read(tmp_path: Path) -> None:
    text = PLAIN.replace("DefaultValue=0x2AB", "DefaultValue=0x2AB\nParameterValue=0x2AC")
    objects = read_eds(written(tmp_path, text, name="drive.DCF"), NODE).objects
    assert (variable(objects, 0x1018, 1).default, variable(objects, 0x1018, 1).value) == (0x2AB, 0x2AC)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no object in it"),
        (b"[FileInfo]\nFileName=x\n", "no object in it"),
        (b"\x7fELF\x02\x01\x00\x00", "binary"),
        (b"<?xml version='1.0'?><ISO15745ProfileContainer/>", "XML"),
        (b"\xef\xbb\xbf<EtherCATInfo/>", "XML"),
        (b"x" * (eds_text.LARGEST_FILE + 1), "larger than 16 MB"),
    ],
)
def test_other_files_are_named_for_what_they_are(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "drive.eds"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=said) as refused:
        read_eds(path, NODE)
    assert str(refused.value).startswith(f"{path}: not an EDS file: ")
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.eds: cannot be read: No such file or directory"):
        read_eds(tmp_path / "none.eds", NODE)
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        read_eds(tmp_path, NODE)


def test_remarks_are_logged_once_per_file(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = written(tmp_path, PLAIN + "stray\n")
    with caplog.at_level(logging.WARNING):
        for node in (1, 2):
            assert default(read_objects(path, node), 0x1800, 1) == 0x180 + node
    assert [record.getMessage() for record in caplog.records] == [
        f"{path}: lines that are neither section nor key, ignored: line 35 'stray'"
    ]


LINES = st.lists(
    st.one_of(
        st.sampled_from(PLAIN.splitlines()),
        st.text(max_size=20),
        st.builds(
            "{}={}".format,
            st.sampled_from(
                ["ObjectType", "DataType", "DefaultValue", "CompactSubObj", "SubNumber", "PDOMapping", "LowLimit"]
            ),
            st.one_of(
                st.integers().map(str),
                st.text(max_size=8),
                st.sampled_from(["0x8", "0x9", "0x7", "0xFFFFFFFFFFFFFFFFF"]),
            ),
        ),
        st.integers(0, 0xFFFFF).map("[{:X}]".format),
        st.builds("[{:X}sub{:X}]".format, st.integers(0, 0xFFFF), st.integers(0, 0x1FF)),
    ),
    max_size=40,
)


@pytest.mark.slow
@given(lines=LINES, encoding=st.sampled_from(["utf-8", "utf-16"]))
def test_any_text_is_an_object_dictionary_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, lines: list[str], encoding: str
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.eds"
    path.write_bytes("\n".join(lines).encode(encoding, errors="replace"))
    try:
        read_eds(path, NODE)
    except ConfigError as error:
        assert "\n" not in str(error)  # noqa: PT017
