"""The cases of a suite: one recording each, what is hidden in it, and what it is to be judged by."""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from armident.configs import ConfigError
from armident.configs.schema.suite import LEVELS, Level, SuiteConfig, SuiteEffect

Kind = Literal["clean", "clean_baseline", "effect", "pair", "outside"]

BASELINE_SEED = 9000
"""Seeds of the healthy runs that baselines are identified from: their noise is not that of any case."""
CLEAN_BASELINE_SEED = 5000
"""Seeds of the healthy runs that are judged against a baseline."""


@dataclass(frozen=True)
class InjectedEffect:
    """One effect of a case.

    Parameters
    ----------
    effect, joint, other
        What the virtual arm gets.
    names
        What the diagnosis may call it, the first of them its own name.
    parameters, truth
        Expressions of the suite.
    strength
        What ``s`` stands for in them.
    hide
        ``False``: the healthy arm has it already.
    arm
        Whether it is of the arm as a whole, so that no joint of a finding is wrong.
    brings
        Names of effects that the arm gets with it.
    rescales
        Whether reported torques have another size with it.
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
    """One recording and its diagnosis.

    Parameters
    ----------
    kind, level
        Which table it belongs to, and how strong its effects are; ``None`` for healthy arms.
    robot, config, trajectory, repeats, period, seed
        The run.
    parts
        What is hidden.
    baseline
        Whether it is judged against the numbers of a healthy run.
    leave_out
        What its model lacks.
    quick
        Whether it belongs to the quick subset.
    """

    kind: Kind
    level: Level | None
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

    @property
    def name(self) -> str:
        """For people: what is hidden where, how strongly, in which run."""
        what = " and ".join(f"{p.effect} {'+'.join([p.joint, *([p.other] if p.other else [])])}" for p in self.parts)
        words = [self.kind.replace("_", " against "), what, self.level or "", f"{self.robot} run {self.seed}"]
        return " ".join(w for w in words if w)

    @property
    def label(self) -> str:
        """Row of the table: the effects' names."""
        return " + ".join(p.names[0] for p in self.parts) or self.kind.replace("_", " against ")

    @property
    def key(self) -> str:
        """Hash of all that decides the result."""
        content = {k: v for k, v in asdict(self).items() if k not in ("quick", "kind", "level")}
        content["parts"] = [
            {k: v for k, v in part.items() if k not in ("brings", "rescales")} for part in content["parts"]
        ]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    @property
    def run(self) -> tuple[str, int]:
        """Robot and seed: cases of one run share trajectory and noise."""
        return self.robot, self.seed


def all_cases(suite: SuiteConfig) -> list[Case]:
    """Every case of a suite: healthy arms that others are compared with, then an order fair from any beginning on.

    Every row of the tables is spread evenly over the whole: a run that was stopped after a tenth of the cases has a
    tenth of each. Which ones come first is drawn by the hash of what they are, the same in every run.
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


def chosen(
    cases: Iterable[Case], *, quick: bool = False, only: Sequence[str] = (), levels: Sequence[str] = ()
) -> list[Case]:
    """The cases that a user asks for.

    Parameters
    ----------
    quick
        Only those of the quick subset.
    only
        Effects, or ``clean``, ``clean_baseline``, ``pair``, ``outside`` for all of that kind.
    levels
        Strengths; healthy arms have none.

    Raises
    ------
    ConfigError
        If nothing is called so.
    """
    cases = list(cases)
    known = {c.kind for c in cases} | {p.effect for c in cases for p in c.parts}
    for name in only:
        if name not in known:
            raise ConfigError(f"--only: {name!r} is none of {', '.join(sorted(known))}")
    for level in levels:
        if level not in LEVELS:
            raise ConfigError(f"--strength: {level!r} is none of {', '.join(LEVELS)}")

    def wanted(case: Case) -> bool:
        # An effect that is asked for by name is meant alone; pairs are asked for as such.
        mine = {case.kind} | ({case.parts[0].effect} if len(case.parts) == 1 else set[str]())
        named = not only or bool(mine & set(only))
        return named and (not levels or case.level in levels) and (case.quick or not quick)

    return [case for case in cases if wanted(case)]


def healthy_twin(case: Case) -> Case:
    """The healthy arm on the same trajectory with the same noise, judged by the full model."""
    return Case("clean", None, case.robot, case.config, case.trajectory, case.repeats, case.period, case.seed)


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
                        # One place, one strength and one run of each; arms and runs in turn.
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
