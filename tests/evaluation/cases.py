"""Cases of the suites: recordings with hidden effects, and the findings that are right."""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Literal

from armident.configs import ConfigError
from tests.evaluation.schema import LEVELS, Level, SuiteConfig, SuiteEffect

Kind = Literal["clean", "clean_baseline", "effect", "pair", "outside", "setup"]
Half = Literal["development", "validation", "reserve"]

BASELINE_SEED = 9000
"""Noise seed of the healthy runs from which baselines are identified; no case has it."""
CLEAN_BASELINE_SEED = 5000
"""First noise seed of the healthy runs that are diagnosed with a baseline, minus one."""
VISIBLE = 1.05
"""Visibility from which a random effect counts: the residual of the rigid model is 5 % larger (docs/diagnosis.md)."""
SEEN, UNSEEN = "visible", f"below {VISIBLE}"
"""Levels of random arms."""
BLOCK: dict[Half, int] = {"development": 88, "validation": 176, "reserve": 176}
"""Random arms of a run where no number is given; every kind has its share of 88 cases."""


@dataclass(frozen=True)
class InjectedEffect:
    """One simulated effect of a case.

    Parameters
    ----------
    effect, joint, other
        Effect of the virtual arm, its joint, and the second joint of an effect between two.
    names
        Names that the diagnosis may give it, its own name first.
    parameters, truth
        Expressions for the parameters of the virtual arm and of the diagnosis.
    strength
        Value of ``s`` in the expressions.
    hide
        ``False`` if the effect is part of the healthy arm already.
    arm
        ``True`` for an effect of the whole arm: a finding at any joint is right.
    brings
        Names of side effects; findings of them are not wrong.
    rescales
        ``True`` if the effect changes the scale of the reported torques.
    """

    effect: str
    joint: str
    other: str | None
    names: tuple[str, ...]
    parameters: dict[str, Any]
    truth: dict[str, Any]
    strength: float
    hide: bool = True
    arm: bool = False
    brings: tuple[str, ...] = ()
    rescales: bool = False


@dataclass(frozen=True)
class Case:
    """One recording of a virtual robot, or a random arm with two, and its diagnosis.

    Parameters
    ----------
    kind
        Table of the case.
    level
        Strength of the effects, or visibility of those of random arms; ``None`` for healthy arms.
    robot
        Name of the arm in the suite; half of the random arms.
    config, trajectory
        Files of the robot configuration and of the trajectory; empty for random arms.
    repeats
        Number of runs of the trajectory in the recording.
    seed
        Seed of the noise; number of the random arm.
    parts
        Simulated effects.
    baseline
        ``True`` if the diagnosis compares with the identification of a healthy run.
    leave_out
        Part that is removed from the model.
    quick
        ``True`` for a case of the quick subset.
    joints
        Joints at which a finding is right, of random arms; empty for any.
    """

    kind: Kind
    level: str | None
    robot: str
    config: str
    trajectory: str
    repeats: int
    period: float
    seed: int
    parts: tuple[InjectedEffect, ...] = ()
    baseline: bool = False
    leave_out: str | None = None
    quick: bool = field(default=False, compare=False)
    joints: tuple[str, ...] = ()

    @property
    def random(self) -> bool:
        """``True`` for an arm drawn at random."""
        return not self.config

    @property
    def name(self) -> str:
        """Description: kind, effects and joints, strength, robot and seed."""
        effects = " and ".join(f"{p.effect} {'+'.join([p.joint, *([p.other] if p.other else [])])}" for p in self.parts)
        words = [self.kind.replace("_", " against "), effects, self.level or "", f"{self.robot} run {self.seed}"]
        return " ".join(w for w in words if w)

    @property
    def label(self) -> str:
        """Row of the table: names of the effects."""
        names = (p.effect if self.random else p.names[0] for p in self.parts)
        return " + ".join(names) or self.kind.replace("_", " against ")

    @cached_property
    def key(self) -> str:
        """Hash of all data that determine the result; half and number of a random arm, of which the rest follows."""
        if self.random:
            return f"{self.robot}-{self.seed:04d}"
        content = {k: v for k, v in asdict(self).items() if k not in ("quick", "kind", "level", "joints")}
        content["parts"] = [
            {k: v for k, v in part.items() if k not in ("brings", "rescales")} for part in content["parts"]
        ]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def twin(self) -> "Case | None":
        """Healthy robot with the same motion and noise and the whole model; a random arm is simulated with its twin."""
        if self.random or not self.parts:
            return None
        return Case("clean", None, self.robot, self.config, self.trajectory, self.repeats, self.period, self.seed)


def random_cases(half: Half, count: int | None) -> list[Case]:
    """The first cases of a half; what is hidden in them is known when they have been simulated."""
    return [Case("clean", None, half, "", "", 1, 0.0, number) for number in range(count or BLOCK[half])]


def revealed(case: Case, hidden: Mapping[str, Any] | None) -> Case:
    """A random case with what is hidden in it, see `tests.evaluation.plants.cases.Truth`; other cases as they are."""
    if hidden is None:
        return case
    family, joints, names = hidden["family"], tuple(hidden["joints"]), tuple(hidden["accepted"])
    if family == "healthy":
        return case
    # Mistakes count always: a torque in kN m leaves the same relative residual and is wrong all the same.
    level = SEEN if family == "setup" or hidden["visibility"] >= VISIBLE else UNSEEN
    joint, other = (*joints, "", "")[:2]
    part = InjectedEffect(
        hidden["kind"], joint, other or None, names, {}, {}, 1.0, arm=not joints,
        # Errors with and without another scale of the torques are not comparable.
        rescales=hidden["kind"] == "gain_error",
    )  # fmt: skip
    return Case(family, level, case.robot, "", "", 1, 0.0, case.seed, (part,), joints=joints)


def all_cases(suite: SuiteConfig) -> list[Case]:
    """Return all cases of a suite: the healthy twins first, then an order of which each beginning is representative.

    The cases of each row of the tables are spread evenly: a run that is stopped after a tenth of the cases has a tenth
    of each row. The order within a row follows from the keys and is the same in each run.
    """
    cases = [*_clean(suite), *_effects(suite), *_pairs(suite), *_outside(suite)]
    rows: dict[tuple[str, str, str | None], list[Case]] = {}
    for case in sorted(cases, key=lambda c: c.key):
        rows.setdefault((case.kind, case.label, case.level), []).append(case)
    places = {
        case.key: (number + int(case.key, 16) / 16 ** len(case.key)) / len(row)
        for row in rows.values()
        for number, case in enumerate(row)
    }
    return sorted(cases, key=lambda c: (c.kind != "clean" or c.seed > suite.runs, places[c.key]))


def select_cases(
    cases: Iterable[Case], *, quick: bool = False, only: Sequence[str] = (), levels: Sequence[str] = ()
) -> list[Case]:
    """Return the cases of the quick subset, of effects or kinds (``only``), and of strengths; empty for all.

    Healthy arms have no strength. A name or a strength that does not exist is a ConfigError.
    """
    cases = list(cases)
    known = {c.kind for c in cases} | {p.effect for c in cases for p in c.parts}
    for name in only:
        if name not in known:
            raise ConfigError(f"--only: {name!r} is none of {', '.join(sorted(known))}")
    for level in levels:
        if level not in LEVELS:
            raise ConfigError(f"--strength: {level!r} is none of {', '.join(LEVELS)}")

    def selected(case: Case) -> bool:
        # The name of an effect does not select the pairs with it.
        mine = {case.kind} | ({case.parts[0].effect} if len(case.parts) == 1 else set[str]())
        named = not only or bool(mine & set(only))
        return named and (not levels or case.level in levels) and (case.quick or not quick)

    return [case for case in cases if selected(case)]


def _run(suite: SuiteConfig, robot: str, seed: int) -> dict[str, Any]:
    arm = suite.robots[robot]
    return {
        "robot": robot,
        "config": str(arm.config),
        "trajectory": str(arm.trajectories[(seed - 1) % len(arm.trajectories)]),
        "repeats": arm.repeats,
        "period": suite.period,
        "seed": seed,
    }


def _clean(suite: SuiteConfig) -> list[Case]:
    plain = [
        Case("clean", None, **_run(suite, robot, seed), quick=seed <= suite.runs)
        for robot, count in suite.clean.items()
        for seed in range(1, count + 1)
    ]
    judged = [
        Case("clean_baseline", None, **_run(suite, robot, CLEAN_BASELINE_SEED + k), baseline=True, quick=k == 1)
        for robot, count in suite.clean_against_baseline.items()
        for k in range(1, count + 1)
    ]
    return plain + judged


def _part(suite: SuiteConfig, effect: SuiteEffect, robot: str, place: str, level: Level) -> InjectedEffect:
    joint, _, other = place.partition("+")
    names = (effect.expected or effect.effect, *effect.same_as.get(robot, ()))
    strength = effect.strength[robot][place] * suite.multiples[level]
    return InjectedEffect(
        effect.effect,
        joint,
        other or None,
        names,
        effect.parameters,
        effect.truth,
        strength,
        effect.hide,
        effect.arm,
        effect.brings,
        effect.rescales,
    )


def _single(suite: SuiteConfig, kind: Kind, effects: Sequence[SuiteEffect]) -> list[Case]:
    out = []
    for number, effect in enumerate(effects):
        robots = list(effect.strength)
        for robot, places in effect.strength.items():
            for nth, place in enumerate(places):
                for level in effect.levels:
                    for seed in range(1, suite.runs + 1):
                        # One joint, strength and run of each effect; arms and runs alternate.
                        quick = robot == robots[number % len(robots)] and nth == 0 and seed == 1 + number % suite.runs
                        quick = quick and level == ("typical" if "typical" in effect.levels else effect.levels[0])
                        out.append(
                            Case(
                                kind,
                                level,
                                **_run(suite, robot, seed),
                                parts=(_part(suite, effect, robot, place, level),),
                                baseline=robot in effect.baseline,
                                leave_out=effect.leave_out,
                                quick=quick,
                            )
                        )
    return out


def _effects(suite: SuiteConfig) -> list[Case]:
    return _single(suite, "effect", suite.effects)


def _outside(suite: SuiteConfig) -> list[Case]:
    return _single(suite, "outside", suite.outside)


def _pairs(suite: SuiteConfig) -> list[Case]:
    out = []
    for number, pair in enumerate(suite.pairs):
        for level in pair.levels:
            for seed in range(1, suite.runs + 1):
                parts = []
                for name, place in pair.effects:
                    effect = suite.effect(name)
                    assert effect is not None
                    parts.append(_part(suite, effect, pair.robot, place, level))
                quick = level == "typical" and number in (0, len(suite.pairs) - 1) and seed == 1
                out.append(Case("pair", level, **_run(suite, pair.robot, seed), parts=tuple(parts), quick=quick))
    return out
