"""Cases of the shipped suite and their selection."""

from collections import Counter
from pathlib import Path

import pytest
import yaml

from armident.configs import ConfigError, load_robot, load_trajectory
from armident.configs.schema.scenario import Scenario
from armident.virtual_robot.effects import CATALOGUE, OUTSIDE, hidden_effects
from tests.evaluation.cases import all_cases, select_cases
from tests.evaluation.plants.two_robots import resolve_effect
from tests.evaluation.schema import LEVELS, load_suite
from tests.evaluation.schema import SUITE as SUITE_FILE

SUITE = load_suite()
CASES = all_cases(SUITE)


def test_every_effect_of_the_virtual_arm_is_in_the_suite() -> None:
    assert {p.effect for c in CASES if c.kind == "effect" for p in c.parts} >= set(CATALOGUE)
    assert {p.effect for c in CASES if c.kind == "outside" for p in c.parts} == set(OUTSIDE)


def test_the_suite_has_the_cases_it_promises() -> None:
    clean = [c for c in CASES if c.kind == "clean"]
    assert len(clean) >= 60
    assert {c.robot for c in clean} == {"tx40", "emps"}
    singles = [c for c in CASES if c.kind == "effect"]
    assert {c.level for c in singles} == set(LEVELS)
    for effect in {p.effect for c in singles for p in c.parts}:
        mine = [c for c in singles if c.parts[0].effect == effect]
        assert len({(c.trajectory, c.seed) for c in mine if c.robot == "tx40"}) == 5
    assert any(c.kind == "pair" for c in CASES)
    assert len({p.effect for c in CASES if c.kind == "outside" for p in c.parts}) >= 4


def test_strengths_rise_from_level_to_level() -> None:
    by_level = [SUITE.multiples[level] for level in LEVELS]
    assert by_level == sorted(set(by_level))


@pytest.mark.slow
@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.nightly)])
def test_every_hidden_effect_is_one_that_the_virtual_arm_takes(quick: bool) -> None:
    robots = {name: load_robot(arm.config) for name, arm in SUITE.robots.items()}
    once = {path: load_trajectory(path) for arm in SUITE.robots.values() for path in arm.trajectories}
    for name, arm in SUITE.robots.items():
        for path in arm.trajectories:
            once[path].check(robots[name], str(path))
    # Runs of one effect differ in trajectory and noise alone.
    for case in select_cases(CASES, quick=True) if quick else (c for c in CASES if c.seed == 1):
        for part in case.parts:
            entry = {
                "effect": part.effect, "joint": part.joint, "other": part.other, "parameters": part.parameters,
                "truth": part.truth, "strength": part.strength,
            }  # fmt: skip
            effect, truth = resolve_effect(entry, robots[case.robot], once[Path(case.trajectory)])
            assert set(truth) == set(part.truth)
            if part.hide:
                scenario = Scenario(schema="armident/scenario/1", effects=(effect,))
                assert hidden_effects(scenario, robots[case.robot], case.name)


def test_no_two_cases_are_the_same() -> None:
    assert len({c.key for c in CASES}) == len(CASES)


def test_any_beginning_has_its_share_of_every_row_of_the_tables() -> None:
    first = SUITE.runs * len(SUITE.clean)
    assert all(c.kind == "clean" for c in CASES[:first])
    rest = CASES[first:]
    whole = Counter((c.kind, c.label, c.level) for c in rest if c.kind != "clean")
    for share in (0.1, 0.25, 0.5):
        begun = Counter((c.kind, c.label, c.level) for c in rest[: round(share * len(rest))])
        assert all(abs(begun[row] - share * size) < 2 for row, size in whole.items())


def test_the_order_is_the_same_in_every_run() -> None:
    assert [c.key for c in all_cases(SUITE)] == [c.key for c in CASES]


def test_a_twin_is_the_healthy_arm_of_the_same_run_and_one_of_the_clean_cases() -> None:
    keys = {c.key for c in CASES if c.kind == "clean"}
    for case in CASES:
        if case.parts:
            assert case.twin is not None
            assert (case.twin.robot, case.twin.seed) == (case.robot, case.seed)
            assert not case.twin.parts
            assert case.twin.key in keys


def test_the_quick_subset_has_every_effect_and_both_arms() -> None:
    quick = select_cases(CASES, quick=True)
    assert len(quick) < 60
    for kind in ("effect", "outside"):
        whole = {p.effect for c in CASES if c.kind == kind for p in c.parts}
        mine = [c for c in quick if c.kind == kind]
        assert {p.effect for c in mine for p in c.parts} == whole
        assert {c.robot for c in mine} == {"tx40", "emps"}
        assert len({c.seed for c in mine}) == SUITE.runs
    assert {c.kind for c in quick} == {c.kind for c in CASES}


def test_cases_can_be_chosen_by_effect_and_by_strength() -> None:
    some = select_cases(CASES, only=["joint_spring"], levels=["obvious"])
    assert {(c.label, c.level) for c in some} == {("joint_spring", "obvious")}
    assert {c.kind for c in select_cases(CASES, only=["clean"])} == {"clean"}
    with pytest.raises(ConfigError, match=r"--only: 'joint_sprig'"):
        select_cases(CASES, only=["joint_sprig"])
    with pytest.raises(ConfigError, match=r"--strength: 'huge'"):
        select_cases(CASES, levels=["huge"])


def test_a_suite_that_names_an_unknown_robot_is_refused(tmp_path: Path) -> None:
    content = yaml.safe_load(SUITE_FILE.read_text(encoding="utf-8"))
    content["clean"]["kuka"] = 3
    path = tmp_path / "suite.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ConfigError, match="robots: 'kuka' is missing"):
        load_suite(path)


def test_a_pair_that_is_not_among_the_effects_is_refused(tmp_path: Path) -> None:
    content = yaml.safe_load(SUITE_FILE.read_text(encoding="utf-8"))
    content["pairs"][0]["effects"][0] = ["joint_spring", "joint_6"]
    path = tmp_path / "suite.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"pairs\[0\]: effects has no joint_spring at joint_6"):
        load_suite(path)
