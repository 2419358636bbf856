"""Schema of a diagnosis suite: hidden effects with joints and strengths, and the criteria of a correct finding."""

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from armident.configs.loading import parse
from armident.configs.schema.base import FrozenModel
from armident.configs.schema.robot import Name, Positive

SUITE = Path(__file__).with_name("suite.yaml")
"""Suite of the two virtual robots."""
Expression = str | float
Level = Literal["detectable", "typical", "obvious"]
LEVELS: tuple[Level, ...] = ("detectable", "typical", "obvious")

Place = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*(\+[a-z][a-z0-9_]*)?$")]
"""A joint, or two of them as ``joint_2+joint_3``."""


class SuiteRobot(FrozenModel):
    """A virtual arm and its trajectories.

    Parameters
    ----------
    config
        Robot configuration, which is also the model under diagnosis.
    trajectories
        Reference trajectories; run k takes trajectory k, cyclically.
    repeats
        Number of runs of the trajectory in one recording.
    """

    config: Path
    trajectories: Annotated[tuple[Path, ...], Field(min_length=1)]
    repeats: Annotated[int, Field(ge=1)] = 1


class SuiteEffect(FrozenModel):
    """An effect of the virtual arm and the expected finding of a diagnosis.

    Parameters
    ----------
    effect
        Name of the effect in the virtual arm.
    parameters
        Parameters of the effect, as expressions in ``s`` (the strength) and in properties of the joint: ``fv``,
        ``fc``, ``ia``, ``inertia``, ``speed``, ``torque``, ``span``, ``ratio``.
    strength
        ``s`` at which the effect is just detectable, by robot and location.
    levels
        Levels of strength that are tested.
    expected
        Name of the effect in the diagnosis; ``None``: the same name.
    truth
        Linear parameters of the diagnosis, as expressions in the effect's parameters and the same names.
    same_as
        Other effects that are physically equivalent, by robot.
    brings
        Effects that accompany this one in the virtual arm; findings of them are correct.
    rescales
        ``True`` if the effect rescales reported torques, so that percentages do not compare with the healthy arm's.
    baseline
        Robots on which the effect is detectable against a baseline only.
    hide
        ``False`` if the healthy arm has the effect already.
    arm
        ``True`` if the effect concerns the arm as a whole, so that any joint of a finding is correct.
    leave_out
        Terms of the arm that the model under diagnosis lacks.
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
    """Two effects in one arm.

    Parameters
    ----------
    robot
        Name of the robot in the suite.
    effects
        Two pairs of effect and location from the list of effects.
    levels
        Levels of strength that are tested.
    """

    robot: Name
    effects: tuple[tuple[Name, Place], tuple[Name, Place]]
    levels: tuple[Level, ...] = ("typical", "obvious")


class SuiteConfig(FrozenModel):
    """All cases of the suite.

    Parameters
    ----------
    schema_
        Key ``schema``: version of the file format.
    period
        Sampling period of the recordings, s; the drives keep their own control period.
    runs
        Number of runs of each effect, location and level: seeds 1 to ``runs``, each with its own trajectory.
    multiples
        Strength of each level relative to the just detectable one.
    robots
        Virtual arms by name.
    clean
        Number of healthy arms, by robot.
    clean_against_baseline
        Number of healthy arms compared with a baseline from another healthy run, by robot.
    effects
        Effects of the diagnosis catalogue.
    pairs
        Pairs of effects in one arm.
    outside
        Effects outside the diagnosis catalogue.
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
        """First entry of a name among the effects of the catalogue; ``None`` if there is none.

        ``name``: name of the effect in the virtual arm.
        """
        return next((e for e in self.effects if e.effect == name), None)


def load_suite(path: Path = SUITE) -> SuiteConfig:
    """Load the cases of a suite; a ConfigError names file, key and expected value."""
    return parse(path.read_text(encoding="utf-8"), SuiteConfig, str(path))
