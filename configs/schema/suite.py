"""The suite of a diagnosis: which effects are hidden where and how strongly, and what counts as found."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from armident.configs.schema.base import FrozenModel
from armident.configs.schema.robot import Name, Positive

Expression = str | float
Level = Literal["detectable", "typical", "obvious"]
LEVELS: tuple[Level, ...] = ("detectable", "typical", "obvious")

Place = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*(\+[a-z][a-z0-9_]*)?$")]
"""A joint, or two of them as ``joint_2+joint_3``."""


class SuiteRobot(FrozenModel):
    """A virtual arm and what it does.

    Parameters
    ----------
    config
        The robot configuration, which is also the model that is diagnosed.
    trajectories
        References; run number k takes the k-th, and begins again after the last.
    repeats
        How often the trajectory is run in one recording.
    """

    config: Path
    trajectories: Annotated[tuple[Path, ...], Field(min_length=1)]
    repeats: Annotated[int, Field(ge=1)] = 1


class SuiteEffect(FrozenModel):
    """An effect of the virtual arm, and what a diagnosis should say of it.

    Parameters
    ----------
    effect
        Its name.
    parameters
        Of the virtual arm, as expressions in ``s`` (the strength) and in what the virtual arm knows of the joint:
        ``fv``, ``fc``, ``ia``, ``inertia``, ``speed``, ``torque``, ``span``, ``ratio``.
    strength
        ``s`` at which the effect is just detectable, by robot and place.
    levels
        The levels of strength that make sense.
    expected
        Name in the diagnosis; ``None``: the same.
    truth
        Linear parameters of the diagnosis as expressions in the effect's parameters and the same names.
    same_as
        Other names that mean the same by physics, by robot.
    rescales
        Whether reported torques have another size with it: percentages of them are none of the healthy arm's.
    brings
        Effects that the arm gets with it, so that they are no mistake beside its name.
    baseline
        Robots on which it shows against the numbers of a healthy arm only.
    hide
        ``False``: the healthy arm has it already.
    arm
        Whether it is of the arm as a whole, so that no joint of a finding is wrong.
    leave_out
        What the model that is diagnosed does not have, although the arm has it.
    """

    effect: Name
    parameters: dict[Name, Expression] = Field(default_factory=dict)
    strength: dict[Name, dict[Place, Positive]]
    levels: tuple[Level, ...] = LEVELS
    expected: Name | None = None
    truth: dict[Name, Expression] = Field(default_factory=dict)
    same_as: dict[Name, tuple[Name, ...]] = Field(default_factory=dict)
    brings: tuple[Name, ...] = ()
    rescales: bool = False
    baseline: tuple[Name, ...] = ()
    hide: bool = True
    arm: bool = False
    leave_out: Literal["rotor_inertia", "couplings"] | None = None


class SuitePair(FrozenModel):
    """Two effects in one arm, each ``(effect, place)`` as in the list of effects."""

    robot: Name
    effects: tuple[tuple[Name, Place], tuple[Name, Place]]
    levels: tuple[Level, ...] = ("typical", "obvious")


class SuiteConfig(FrozenModel):
    """All cases of the suite.

    Parameters
    ----------
    period
        Sampling period of the recordings, s; the drives keep their own.
    runs
        Runs of each effect, place and level: seeds 1 to ``runs``, each with its own trajectory.
    multiples
        Strength of each level over the one that is just detectable.
    clean
        Healthy arms, by robot.
    clean_against_baseline
        Healthy arms judged against the numbers of another healthy run, by robot.
    """

    schema_: Literal["armident/suite/1"] = Field(alias="schema")
    period: Positive = 1e-3
    runs: Annotated[int, Field(ge=1)] = 5
    multiples: dict[Level, Positive]
    robots: dict[Name, SuiteRobot]
    clean: dict[Name, int]
    clean_against_baseline: dict[Name, int] = Field(default_factory=dict)
    effects: tuple[SuiteEffect, ...]
    pairs: tuple[SuitePair, ...] = ()
    outside: tuple[SuiteEffect, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        missing = [level for level in LEVELS if level not in self.multiples]
        if missing:
            raise ValueError(f"multiples: {missing[0]} is missing")
        used = {robot for effect in (*self.effects, *self.outside) for robot in (*effect.strength, *effect.baseline)}
        for robot in sorted(used | set(self.clean) | set(self.clean_against_baseline) | {p.robot for p in self.pairs}):
            if robot not in self.robots:
                raise ValueError(f"robots: {robot!r} is missing (there are {', '.join(self.robots)})")
        for k, pair in enumerate(self.pairs):
            for name, place in pair.effects:
                found = self.effect(name)
                if found is None or place not in found.strength.get(pair.robot, {}):
                    raise ValueError(f"pairs[{k}]: effects has no {name} at {place} of {pair.robot}")
        return self

    def effect(self, name: str) -> SuiteEffect | None:
        """The first entry of that name among the effects of the catalogue."""
        return next((e for e in self.effects if e.effect == name), None)
