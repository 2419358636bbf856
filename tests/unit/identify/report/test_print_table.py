"""Tables on narrow terminals: no name is broken."""

import io

import pytest
from rich.console import Console
from rich.table import Table

from armident.identify.cli.print_table import print_table
from armident.identify.effects.listing import effects_command

NAMES = ("load_dependent_coulomb_friction", "transmission_elasticity_with_backlash")
CELLS = [
    (
        "joint_1_shoulder_pan",
        NAMES[0],
        "fv 12.3 ± 0.4, fc 3.21 ± 0.02, stribeck_velocity 0.05",
        "98 %",
        "5.12 % → 1.01 %",
    ),
    ("joint_6_wrist_roll", NAMES[1], "stiffness 12000 ± 900", "71 %", "3.90 % → 2.50 %"),
]


def findings() -> Table:
    table = Table(title="findings", title_justify="left")
    for heading in ("joint", "effect", "parameters", "confidence", "held-out gap"):
        table.add_column(heading)
    for row in CELLS:
        table.add_row(*row)
    return table


def printed(width: int, *, terminal: bool) -> list[str]:
    file = io.StringIO()
    print_table(findings(), Console(file=file, width=width, force_terminal=terminal, color_system=None))
    return file.getvalue().splitlines()


@pytest.mark.parametrize("width", [40, 60, 80, 120, 160])
def test_every_word_stays_whole_at_any_width(width: int) -> None:
    text = "\n".join(printed(width, terminal=True))
    for row in CELLS:
        for word in (word for cell in row for word in cell.split()):
            assert word in text, f"{word} at {width} columns"


@pytest.mark.parametrize("width", [120, 160])
def test_a_table_fits_the_terminal(width: int) -> None:
    lines = printed(width, terminal=True)
    assert "┃" in "".join(lines)
    assert max(map(len, lines)) <= width


def test_a_narrow_terminal_has_a_list_with_every_value() -> None:
    lines = printed(60, terminal=True)
    assert "joint: joint_1_shoulder_pan" in lines
    assert f"  effect: {NAMES[0]}" in lines
    assert "  held-out gap: 3.90 % → 2.50 %" in lines


def test_a_file_has_a_whole_table() -> None:
    lines = printed(60, terminal=False)
    assert any(all(name in line for name in (CELLS[1][0], NAMES[1])) for line in lines)


@pytest.mark.parametrize("width", ["60", "80"])
def test_the_catalogue_prints_every_effect_whole(
    width: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from armident.identify.effects.registry import catalogue

    monkeypatch.setenv("COLUMNS", width)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    effects_command(None, as_json=False)
    text = capsys.readouterr().out
    for key in catalogue():
        assert key in text
