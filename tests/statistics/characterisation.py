"""Coverage of the 95 % intervals of a characterisation on the virtual EMPS, with known effects and without.

    python -m tests.statistics.characterisation            # 20 seeds
    python -m tests.statistics.characterisation --seeds 5

Each seed plays constant speeds and reversals. Counted are the intervals that contain the truth, and on the healthy
axis what is seen although it is not there.
"""

import argparse
from collections import Counter
from collections.abc import Sequence

import numpy as np

import armident
from armident.configs import Scenario, load_robot
from armident.configs.schema.scenario import HiddenEffect
from armident.identify.investigation.motions import ConstantSpeeds, MotionFamily, Reversals, reach_of

FC, FV, STRIBECK, VELOCITY, DISPLACEMENT, RIPPLE, ORDER = 20.3935, 203.5034, 8.0, 0.01, 5e-5, 1.5, 50.0
"""Friction of the virtual EMPS (N, N s/m, N, m/s, m), and its ripple (N, cycles per metre: a pitch of 20 mm)."""
SIZES: tuple[tuple[MotionFamily, float], ...] = ((ConstantSpeeds(), 0.15), (Reversals(), 0.1))
"""Motions, with their amplitude over the range of the axis."""
SHARE = 0.6
"""Speed and acceleration of the motions over their limits, before the factor of `reach_of`."""

EFFECTS = (
    ("stribeck_friction", {"extra": STRIBECK, "velocity": VELOCITY}),
    ("presliding_friction", {"deflection": DISPLACEMENT}),
    ("cogging_torque", {"amplitude": RIPPLE, "harmonic": 1.0}),
)


def recordings(seed: int, effects: Sequence[tuple[str, dict[str, float]]]) -> list[armident.Recording]:
    """Return the recordings of both motions of the virtual EMPS with hidden effects."""
    robot = load_robot("emps")
    limits = robot.joints[0].limits
    reach = reach_of(robot, np.zeros(1), np.array([SHARE * limits.velocity]), np.array([SHARE * limits.acceleration]))
    hidden = tuple(HiddenEffect(effect=name, joint="joint_1", parameters=values) for name, values in effects)
    scenario = Scenario(schema="armident/scenario/1", effects=hidden) if hidden else None
    return [
        armident.simulate_recording("emps", family.trajectory(reach, 0, size), scenario=scenario, seed=10 * seed + k)
        for k, (family, size) in enumerate(SIZES)
    ]


def friction_at(speed: float) -> float:
    """Return the true friction of the axis with `EFFECTS` at a speed, N."""
    return FC + FV * speed + STRIBECK * float(np.exp(-((speed / VELOCITY) ** 2)))


def contained(found: armident.Characterisation, beside: armident.Characterisation) -> dict[str, bool]:
    """Return, for each quantity of the axis with `EFFECTS`, True if its interval contains the truth.

    ``beside``: the same axis without the Stribeck friction, which has no bristle in the simulation: for the stiffness.
    """
    document, presliding = found.document, beside.document.presliding
    assert document.friction is not None
    assert document.ripple is not None
    assert presliding is not None
    truth = {"fc": FC, "fv": FV, "fva": 0.0, "fst": STRIBECK, "velocity": VELOCITY}
    estimates = {name: document.friction.curve.get(name) for name in truth}
    estimates["ripple"] = document.ripple.peaks[0].amplitude if document.ripple.peaks else None
    estimates["stiffness"] = presliding.stiffness
    truth |= {"ripple": RIPPLE, "stiffness": FC / DISPLACEMENT}
    return {name: one is not None and one.low <= truth[name] <= one.high for name, one in estimates.items()}


def seen(found: armident.Characterisation) -> dict[str, bool]:
    """Return, for each effect that a joint may have, True if it is seen."""
    document = found.document
    assert document.friction is not None
    assert document.ripple is not None
    assert document.presliding is not None
    return {
        "stribeck": "fst" in document.friction.curve,
        "ripple": bool(document.ripple.peaks),
        "presliding": document.presliding.stiffness is not None,
    }


def main() -> None:
    """Print how many intervals contain the truth, and how often a healthy axis shows what is not there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    right, points, inside, false = Counter[str](), 0, 0, Counter[str]()
    for seed in range(1, seeds + 1):
        found = armident.characterise(recordings(seed, EFFECTS), "joint_1")
        beside = armident.characterise(recordings(seed, EFFECTS[1:]), "joint_1")
        right.update(name for name, yes in contained(found, beside).items() if yes)
        assert found.document.friction is not None
        for point in found.document.friction.points:
            if point.friction is not None:
                points += 1
                inside += point.friction.low <= friction_at(point.speed) <= point.friction.high
        healthy = seen(armident.characterise(recordings(seed, ()), "joint_1"))
        false.update(name for name, yes in healthy.items() if yes)
        print(
            f"{seed}: {dict(right)}; friction {inside} of {points}; seen on the healthy axis {dict(false)}", flush=True
        )


if __name__ == "__main__":
    main()
