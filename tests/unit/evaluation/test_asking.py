"""Count of right names after each motion of an investigation, and the arm that answers."""

from typing import Any

import numpy as np
import pytest

from tests.evaluation.asking import by_family, by_kind, calibration_of, right
from tests.evaluation.plants.cases import answering, make_case


def case(family: str, accepted: list[str], *said: dict[str, float], seconds: list[float]) -> dict[str, Any]:
    return {
        "way": "best", "family": family, "kind": "play", "accepted": accepted,
        "motions": ["steps"] * (len(said) - 1), "said": [[names] for names in said],
        "seconds": seconds,
    }  # fmt: skip


def test_a_name_is_right_if_it_is_probable_and_none_is_right_where_nothing_has_a_name() -> None:
    effect = case("effect", ["backlash"], seconds=[0.0])
    assert right(effect, [{"backlash": 0.6, "nothing": 0.4}, {"nothing": 1.0}])
    assert not right(effect, [{"backlash": 0.4, "nothing": 0.6}])
    assert not right(effect, [{"backlash": 0.6}, {"joint_spring": 0.7}])
    healthy = case("healthy", [], seconds=[0.0])
    assert right(healthy, [{"nothing": 0.9, "unnamed": 0.1}, {"joint_spring": 0.3}])
    assert not right(healthy, [{"joint_spring": 0.6}])


def test_the_table_counts_by_motions_and_by_seconds_and_an_end_keeps_its_answer() -> None:
    unsure, sure = {"backlash": 0.3, "nothing": 0.7}, {"backlash": 0.9, "nothing": 0.1}
    after_one = case("effect", ["backlash"], unsure, sure, seconds=[0.0, 25.0])
    after_two = case("effect", ["backlash"], unsure, unsure, sure, seconds=[0.0, 40.0, 90.0])
    cells = [cell.strip() for cell in by_family([after_one, after_two]).splitlines()[2].strip("|").split("|")]
    assert cells == ["best", "effect", "2", "0", "1", "2", "2", "2", "1", "1", "2"]


def test_the_other_tables_say_what_was_asked_what_is_wrong_and_how_probable_it_was() -> None:
    found = case("effect", ["backlash"], {"backlash": 0.3}, {"backlash": 0.9}, seconds=[0.0, 25.0])
    missed = case("effect", ["backlash"], {"joint_spring": 0.9}, seconds=[0.0])
    assert "steps 1" in by_kind([found, missed])
    assert "joint_spring 0.90" in by_kind([found, missed])
    assert calibration_of([found, missed]).splitlines()[-1].split("|")[2:5] == [" 2     ", " 0.90 ", " 0.50  "]


@pytest.mark.slow
def test_an_arm_of_the_suite_follows_other_references_with_noise_of_its_own() -> None:
    play, joints = answering("development", 3), make_case("development", 3).robot.n
    bump = 0.2 * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, 4000)))
    first, again = (play(np.repeat(bump[:, None], joints, axis=1), number) for number in range(2))
    assert np.ptp(first["q1"]) == pytest.approx(0.4, abs=0.1)
    assert not np.array_equal(first["tau1"], again["tau1"])
