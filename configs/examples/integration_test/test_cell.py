"""Integration tests of a cell, with a virtual arm in place of the real one."""

from pathlib import Path

import numpy as np

import armident
from armident.testing.virtual_arm import Captures, VirtualArms

HERE = Path(__file__).parent


def test_the_arm_is_captured_and_identified(virtual_arm: VirtualArms, capture: Captures) -> None:
    """Capture and identification recover the mass on the lift and its friction."""
    arm = virtual_arm(HERE / "picker.yaml", scenario={"friction": {"lift": {"coulomb": 15.0, "viscous": 60.0}}})
    recording = capture(arm)
    found = armident.identify(recording, method="idim-ls").parameters
    # The lift moves all links, and the inertia of its motor cannot be distinguished from their mass.
    moved = sum(arm.truth[name] for name in ("m1", "m2", "m3", "ia1"))
    assert abs(found["m1r"].value - moved) < 0.03 * moved
    assert abs(found["fc1"].value - 15.0) < 2.0


def test_a_dry_lift_needs_more_force(virtual_arm: VirtualArms, capture: Captures) -> None:
    """A lift without grease needs more force than its weight and its usual friction."""
    arm = virtual_arm(HERE / "picker.yaml", scenario=HERE / "dry_lift.yaml", noise=0.0)
    assert arm.truth["fc1"] == 45.0
    recording = capture(arm, duration_s=3.0)
    force = recording.samples.si("current")[:, 0]
    weight = 9.81 * sum(arm.truth[name] for name in ("m1", "m2", "m3"))
    assert np.abs(force - weight).max() > 45.0
