"""Random arms: physics against Pinocchio, properties of the generator, and the files of a case."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from armident.compiled import PLAIN, compiled
from armident.configs import load_robot
from armident.daq.recording import read_recording
from tests.evaluation.plants.arm import Arm, random_arm
from tests.evaluation.plants.bodies import evaluate
from tests.evaluation.plants.cases import RandomCase, kind_of, make_case
from tests.evaluation.plants.disk import write_case, write_recordings
from tests.evaluation.plants.draft import configuration, draw_draft
from tests.evaluation.plants.effects import NAMED, OUTSIDE
from tests.evaluation.plants.friction import friction_impulses, one_impulse
from tests.evaluation.plants.halves import DEVELOPMENT, HALVES, VALIDATION, Half
from tests.evaluation.plants.mistakes import MISTAKES
from tests.evaluation.plants.slots import COULOMB, SMOOTHING, VISCOUS
from tests.evaluation.plants.truth import ACCEPTED, SHARES, block
from tests.evaluation.plants.visibility import pin, rigid_residual

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
SEEDS = range(12)
BLOCK = len(block())


def arm(seed: int, half: Half = "development") -> Arm:
    return random_arm(np.random.default_rng(seed), HALVES[half])


def pinocchio_model(drawn: Arm) -> Any:
    model, parent = pin.Model(), 0
    for j in range(drawn.n):
        alpha, d, theta, r = drawn.mdh[j]
        about_x = pin.SE3(pin.utils.rotate("x", alpha), np.zeros(3)) * pin.SE3(np.eye(3), np.array([d, 0.0, 0.0]))
        about_z = pin.SE3(pin.utils.rotate("z", theta), np.array([0.0, 0.0, r]))
        kind = pin.JointModelPZ() if drawn.prismatic[j] else pin.JointModelRZ()
        parent = model.addJoint(parent, kind, about_x * about_z, f"axis_{j + 1}")
        body = pin.Inertia(drawn.mass[j], drawn.com[j], drawn.inertia[j])
        model.appendBodyToJoint(parent, body, pin.SE3.Identity())
    model.gravity.linear = drawn.gravity
    return model


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_mass_matrix_and_bias_torques_are_those_of_pinocchio(seed: int) -> None:
    drawn = replace(arm(seed), gravity=np.array([1.0, -2.0, 9.0]))
    q, qd = np.random.default_rng(seed + 100).normal(size=(2, drawn.n))
    M, bias = evaluate(q, qd, drawn.gravity, *drawn.bodies)
    model = pinocchio_model(drawn)
    data = model.createData()
    upper = pin.crba(model, data, q)
    np.testing.assert_allclose(np.triu(M), np.triu(upper), rtol=1e-9, atol=1e-9 * np.abs(M).max())
    expected = pin.nonLinearEffects(model, data, q, qd)
    np.testing.assert_allclose(bias, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.nightly
@pytest.mark.parametrize("half", HALVES)
@pytest.mark.parametrize("seed", SEEDS)
def test_every_body_exists_and_every_joint_resists(seed: int, half: Half) -> None:
    drawn = arm(seed, half)
    assert 2 <= drawn.n <= 7
    for j in range(drawn.n):
        second = 0.5 * np.trace(drawn.inertia[j]) * np.eye(3) - drawn.inertia[j]
        assert np.linalg.eigvalsh(second).min() > 0.0
    assert drawn.mass.min() > 0.0
    assert drawn.rotor.min() > 0.0
    assert drawn.laws[:, [VISCOUS, COULOMB]].min() > 0.0
    assert drawn.resolution.min() > 0.0


def test_the_halves_differ_in_seeds_and_ranges() -> None:
    assert len({ranges.entropy for ranges in HALVES.values()}) == len(HALVES)
    ranges = ("mass", "length", "ratio", "dry", "noise", "bandwidth", "rates", "wider")
    assert all(getattr(DEVELOPMENT, name) != getattr(VALIDATION, name) for name in ranges)
    orders = {tuple(kind_of(half, k) for k in range(BLOCK)) for half in HALVES}
    assert len(orders) == len(HALVES)


@pytest.mark.parametrize("half", HALVES)
def test_every_block_holds_every_kind_in_its_share(half: Half) -> None:
    for number in range(3):
        kinds = [kind_of(half, number * BLOCK + k) for k in range(BLOCK)]
        assert sorted(kinds) == sorted(block())
    healthy = sum(family == "healthy" for family, _ in block())
    assert healthy >= 0.25 * BLOCK


def test_every_kind_has_a_law_and_accepted_names() -> None:
    kinds = {kind for kinds in SHARES.values() for kind in kinds}
    assert kinds == set(ACCEPTED)
    assert kinds == {*NAMED, *OUTSIDE, *MISTAKES, "healthy", "missing_rotor"}
    for family, of_family in SHARES.items():
        for kind in of_family:
            assert bool(ACCEPTED[kind]) == (family in ("effect", "setup")), kind


def index_of(kind: str, number: int = 0) -> int:
    return [k for k in range(2 * BLOCK) if kind_of("development", k)[1] == kind][number]


@pytest.fixture(scope="module")
def tight_spot() -> RandomCase:
    return make_case("development", index_of("tight_spot"), with_twin=True)


@pytest.mark.slow
@pytest.mark.nightly
def test_a_case_is_the_same_every_time_and_another_number_is_another_case(tight_spot: RandomCase) -> None:
    again = make_case("development", index_of("tight_spot"))
    assert again.truth == tight_spot.truth
    for one, other in zip(again.recordings, tight_spot.recordings, strict=True):
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[name], other[name]) for name in one)
    another = make_case("development", index_of("tight_spot", 1))
    assert another.truth.noise != tight_spot.truth.noise


@pytest.mark.slow
@pytest.mark.nightly
def test_a_twin_differs_from_its_case_by_the_effect_alone(tight_spot: RandomCase) -> None:
    twin = tight_spot.twin
    assert twin is not None
    assert twin.truth.family == "healthy"
    assert twin.truth.noise == tight_spot.truth.noise
    assert twin.robot == tight_spot.robot
    names = [name for name in twin.recordings[0] if name.startswith("qr")]
    assert all(np.array_equal(twin.recordings[0][n], tight_spot.recordings[0][n]) for n in names)


@pytest.mark.slow
@pytest.mark.nightly
def test_the_visibility_is_the_ratio_of_the_residuals_at_the_joint(tight_spot: RandomCase) -> None:
    truth = tight_spot.truth
    j = [joint.name for joint in tight_spot.robot.joints].index(truth.joints[0])
    assert truth.visibility == pytest.approx(truth.residual[j] / truth.healthy_residual[j])
    assert tight_spot.twin is not None
    np.testing.assert_allclose(tight_spot.twin.truth.residual, truth.healthy_residual, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("half", HALVES)
def test_the_rigid_model_leaves_the_noise_of_a_healthy_arm(half: Half) -> None:
    healthy = [k for k in range(BLOCK) if kind_of(half, k)[0] == "healthy"][:4]
    for index in healthy:
        truth = make_case(half, index).truth
        assert truth.visibility == 1.0
        # 900 samples: 12 % are five standard deviations of the noise's, without the parameters of the model.
        np.testing.assert_allclose(truth.residual, truth.noise, rtol=0.2)


@pytest.mark.slow
@pytest.mark.nightly
def test_without_noise_pinocchio_explains_the_torques_of_the_simulation() -> None:
    seed = (DEVELOPMENT.entropy, 2, index_of("healthy"), 0)
    draft = draw_draft(np.random.default_rng([*seed, 0]), DEVELOPMENT, seed)
    run, smoothing = draft.healthy, draft.plant.laws[:, SMOOTHING]
    robot = configuration(draft.plant.arm, "healthy")
    residual = rigid_residual(robot, run.q, run.qd, run.qdd, run.torque, smoothing)
    # The step is of first order where dry friction changes sign within it.
    assert (residual / run.torque.std(axis=0)).max() < 0.005


@compiled(kept=True, **PLAIN)
def with_friction(v: Floats, step: Floats, rows: Integers, bounds: Floats, smoothing: Floats, impulses: Floats) -> None:
    """A kernel around the function of kernels."""
    friction_impulses(v, step, rows, bounds, smoothing, impulses)


@compiled(kept=True, **PLAIN)
def impulse_of(speed: float, weight: float, level: float, smoothing: float) -> float:
    """A kernel around the function of kernels."""
    found: float = one_impulse(speed, weight, level, level, smoothing)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("drive", "moves"), [(0.9, False), (1.1, True), (-1.1, True)])
def test_dry_friction_holds_a_joint_up_to_its_bound(drive: float, moves: bool) -> None:
    mass, step, level = 2.0, 1e-3, 3.0
    v = np.array([step * drive * level / mass])
    rows, bounds = np.array([[0, -1]]), np.full((1, 2), step * level)
    with_friction(v, np.array([[1.0 / mass]]), rows, bounds, np.zeros(1), np.zeros(1))
    expected = step * level * (abs(drive) - 1.0) / mass * np.sign(drive) if moves else 0.0
    assert v[0] == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("speed", [1e-4, 1e-2, 0.3, -0.3])
def test_friction_with_a_smooth_sign_is_that_of_the_velocity_after_the_step(speed: float) -> None:
    weight, level, smoothing = 0.5, 3e-3, 0.01
    impulse = impulse_of(speed, weight, level, smoothing)
    assert impulse == pytest.approx(level * np.tanh((speed - weight * impulse) / smoothing), rel=1e-6)


@pytest.mark.slow
@pytest.mark.nightly
def test_the_files_of_a_case_are_read_back(tight_spot: RandomCase, tmp_path: Path) -> None:
    write_case(tight_spot, tmp_path)
    name = tight_spot.truth.name
    assert load_robot(tmp_path / f"{name}.yaml") == tight_spot.robot
    with np.load(tmp_path / f"{name}_a.npz") as arrays:
        assert set(arrays) == set(tight_spot.recordings[0])
    assert json.loads((tmp_path / f"{name}.truth.json").read_text())["kind"] == "tight_spot"
    paths = write_recordings(tight_spot, tmp_path, "case")
    recording = read_recording(paths["b"])
    assert recording.sample_rate_hz == pytest.approx(tight_spot.truth.rate_hz)
    np.testing.assert_array_equal(recording.samples.si("position")[:, 0], tight_spot.recordings[1]["q1"])
