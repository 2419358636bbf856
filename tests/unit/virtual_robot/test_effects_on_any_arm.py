"""Every hidden effect on arms without stored parameters: the arm moves on, and its signals change."""

from pathlib import Path

import pytest

from armident.virtual_robot.effects import EFFECTS
from tests.fixtures.other_arms import write_scara
from tests.statistics.twin_effects import ROBOTS, RUN_AWAY, VISIBLE, change, needs_two_joints, twin

PLACES = {"panda": (3, 1), "kuka_lwr4": (1, 3), "scara": (2, 1)}
"""Joint of the effect, from 0, and the other joint of an effect between two; the lift of the SCARA is prismatic."""


@pytest.fixture(scope="module")
def scara(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scara(tmp_path_factory.mktemp("scara"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "arm", ["scara", *(pytest.param(arm, marks=pytest.mark.nightly) for arm in ("kuka_lwr4", "panda"))]
)
@pytest.mark.parametrize("effect", sorted(EFFECTS))
def test_an_effect_changes_the_signals_of_any_arm(effect: str, arm: str, scara: Path) -> None:
    size, peak = change(scara if arm == "scara" else Path(arm), effect, *PLACES[arm])
    # The loops hold the arm: nothing runs away.
    assert peak < RUN_AWAY
    assert size > VISIBLE


@pytest.mark.nightly
@pytest.mark.parametrize("robot", sorted(set(ROBOTS) - set(PLACES)))
@pytest.mark.parametrize("effect", sorted(EFFECTS))
def test_an_effect_changes_the_signals_of_every_shipped_robot(effect: str, robot: str) -> None:
    n = twin(Path(robot)).robot.n
    if n == 1 and needs_two_joints(effect):
        pytest.skip("needs two joints")
    size, peak = change(Path(robot), effect, min(1, n - 1), min(2, n - 1))
    assert peak < RUN_AWAY
    assert size > VISIBLE
