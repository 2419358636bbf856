"""Report of a trajectory: verdict first, what was checked and what was not, one file without others."""

import json
import re
from pathlib import Path

import pytest

import armident
from armident.configs import ConfigError
from armident.identify.cli import trajectory as trajectory_command
from tests.unit.identify.excitation.test_collision import write_urdf

pytestmark = pytest.mark.slow

SHELF = "collision: {boxes: [{name: shelf, center: [0.5, 0, 1], size: [0.4, 1, 0.2]}]}\n"


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command writes its picture into the working directory."""
    monkeypatch.chdir(tmp_path)


def text_of(page: Path) -> str:
    return " ".join(page.read_text(encoding="utf-8").split())


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("designed")
    trajectory_command(write_urdf(folder, 100.0, SHELF), folder / "motion.yaml", 6.0, 0, None, 40)
    return text_of(folder / "motion.html")


def test_the_report_of_a_trajectory_needs_no_other_file(designed: str) -> None:
    assert not re.search(r'(?:src|href)="(?!data:)', designed)
    assert "http" not in re.sub(r"http://www\.w3\.org", "", designed)


def test_the_verdict_stands_first_and_both_lists_follow(designed: str) -> None:
    places = [
        designed.index(words)
        for words in (
            "<b>keeps all checked limits</b>",
            "Checked: torque by the masses of the URDF",
            "<b>Not checked</b>: shapes of meshes that cannot be read: tool.stl of link fore",
            "viscous friction, joint 2",
        )
    ]
    assert places == sorted(places)


def test_every_quantity_of_every_joint_is_drawn_with_its_limits(designed: str) -> None:
    groups = [json.loads(found) for found in re.findall(r'<script type="application/json">(.*?)</script>', designed)]
    plots = [plot for group in groups for plot in group]
    drawn = {(plot["title"], plot["series"][0]["name"], plot["unit"]) for plot in plots}
    for joint in ("shoulder", "elbow"):
        assert {(joint, "torque", "N m"), (joint, "position", "rad"), (joint, "velocity", "rad/s")} <= drawn
    assert ("distance between bodies", "smallest distance", "m") in drawn
    assert all(limit["y"] == 0.02 for plot in plots for limit in plot["limits"] if limit["name"] == "clearance")
    torques = next(plot for plot in plots if plot["unit"] == "N m")
    assert {limit["y"] for limit in torques["limits"]} == {-100.0, 100.0}


def test_a_refused_trajectory_has_its_reasons_in_the_report(tmp_path: Path) -> None:
    config, into = write_urdf(tmp_path, 100.0, SHELF), tmp_path / "into.yaml"
    into.write_text("schema: armident/trajectory/1\nstart: [0, 0]\nmoves:\n- {to: [1.5, 0.1], duration: 3}\n")
    with pytest.raises(ConfigError, match=r"needs a distance of -0\.\d+ m between link of .* and box 'shelf'"):
        trajectory_command(config, None, look_at=into, report=tmp_path / "page.html")
    page = text_of(tmp_path / "page.html")
    assert "<b>exceeds limits</b>" in page
    assert re.search(r"It needs a distance of -0\.\d+ m between link of .* and box &#39;shelf&#39;", page)


def test_a_design_in_python_has_its_checks_and_its_report(tmp_path: Path) -> None:
    design = armident.design_trajectory(write_urdf(tmp_path, 100.0, SHELF), duration=6.0, evaluations=30)
    assert any("torque by the masses of the URDF" in line for line in design.checks.checked)
    assert any("cables" in line for line in design.checks.unchecked)
    assert "<b>keeps all checked limits</b>" in text_of(design.report(tmp_path / "pages" / "design.html"))
