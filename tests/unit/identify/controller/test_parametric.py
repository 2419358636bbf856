"""Parametric controllers: refined instrumental variables find gains, filters and delays that they are shown."""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.io import loadmat

from armident.configs import DataError
from armident.identify.controller.law import Stretch, Structure, columns, simulate_law, taps
from armident.identify.controller.parametric import ControlLaw, identify_parametric
from armident.identify.controller.riv import refined_iv

Floats = NDArray[np.float64]

DT = 1e-3
MASS, FRICTION = 2.0, 3.0


@dataclass(frozen=True)
class Drive:
    """A drive written down step by step: kp 1/s, kv N s/m, reset time s, filter pole, feed-forward, limit N."""

    kp: float = 60.0
    kv: float = 120.0
    ti: float | None = None
    pole: float = 0.0
    velocity_samples: int = 1
    forward: float = 0.0
    acceleration: float = 0.0
    late: int = 0
    limit: float = np.inf


def run(drive: Drive, noise: float = 0.0, colour: float = 0.0, seed: int = 0, steps: int = 12000) -> Stretch:
    """Position, reference and recorded torque of a sliding mass under the drive, its encoder of 1e-6 m.

    ``noise`` (N) is on the recorded torque alone, an AR(1) with coefficient ``colour``.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(steps) * DT
    r = 0.3 * np.sin(2 * np.pi * 0.7 * t) + 0.1 * np.sin(2 * np.pi * 2.3 * t + 1) + 0.01 * np.sin(2 * np.pi * 11 * t)
    q, qd, filtered, integral = r[0], 0.0, 0.0, 0.0
    m, nu, asked = np.zeros(steps), np.zeros(steps), np.zeros(steps)
    for k in range(steps):
        m[k] = np.round(q / 1e-6) * 1e-6
        before = max(k - drive.velocity_samples, 0)
        v = (m[k] - m[before]) / (drive.velocity_samples * DT)
        rd = (r[k] - r[max(k - 1, 0)]) / DT
        rdd = (r[k] - 2 * r[k - 1] + r[k - 2]) / DT**2 if k > 1 else 0.0
        filtered += (1 - drive.pole) * (v - drive.forward * rd - filtered)
        wanted = drive.kp * (r[k] - m[k]) - filtered
        if drive.ti is not None:
            integral += DT * wanted / drive.ti
        asked[k] = drive.kv * (wanted + integral) + drive.acceleration * rdd
        nu[k] = np.clip(asked[max(k - drive.late, 0)], -drive.limit, drive.limit)
        qdd = (nu[k] - FRICTION * qd) / MASS
        q, qd = q + DT * qd + DT**2 / 2 * qdd, qd + DT * qdd
    coloured = np.zeros(steps)
    for k, white in enumerate(noise * rng.standard_normal(steps)):
        coloured[k] = colour * coloured[k - 1] + white
    return Stretch(m, r, nu + coloured, np.zeros(steps))


def identified(stretch: Stretch, structure: Structure | None = None, limit: float | None = None) -> ControlLaw:
    found = identify_parametric(
        [stretch.q[:, None]],
        [stretch.r[:, None]],
        [stretch.nu[:, None]],
        DT,
        structure=structure,
        saturation=None if limit is None else np.array([limit]),
    )
    (law,) = found.responses
    assert isinstance(law, ControlLaw)
    return law


def value(law: ControlLaw, name: str) -> float:
    return law.gains[name].value


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drive", "structure"),
    [
        (Drive(), Structure()),
        (Drive(velocity_samples=2), Structure(velocity_taps=2)),
        (Drive(forward=1.0), Structure(velocity="error")),
        (Drive(forward=0.6), Structure(velocity="both")),
        (Drive(pole=0.8), Structure(filtered="velocity")),
        (Drive(acceleration=2.0), Structure(acceleration=True)),
        (Drive(ti=0.05), Structure(integral=True)),
        (Drive(ti=0.05, forward=1.0), Structure(velocity="error", integral=True)),
        (Drive(ti=0.05, forward=0.6), Structure(velocity="both", integral=True)),
        (Drive(late=1), Structure(delay=1)),
    ],
)
def test_structure_and_gains_of_a_drive_are_found(drive: Drive, structure: Structure) -> None:
    law = identified(run(drive, noise=0.05))
    assert law.structure == structure
    assert law.converged
    assert value(law, "kp") == pytest.approx(drive.kp, rel=2e-3)
    assert value(law, "kv") == pytest.approx(drive.kv, rel=2e-3)
    assert value(law, "stiffness") == pytest.approx(drive.kp * drive.kv, rel=2e-3)
    age = drive.late + drive.velocity_samples / 2 + drive.pole / (1 - drive.pole)
    assert value(law, "velocity_delay") == pytest.approx(age, abs=0.02)
    if drive.ti is not None:
        assert value(law, "ti") == pytest.approx(drive.ti, rel=1e-2)
    if structure.velocity == "both":
        assert value(law, "velocity_feedforward") == pytest.approx(drive.forward, rel=1e-2)
    if structure.acceleration:
        assert value(law, "acceleration_feedforward") == pytest.approx(drive.acceleration, rel=1e-2)
    if structure.filtered:
        corner = -np.log(drive.pole) / (2 * np.pi * DT)
        assert value(law, "corner") == pytest.approx(corner, rel=1e-2)
    assert law.fit_pct > 99.99


def test_refined_iv_keeps_the_filter_that_least_squares_loses_in_the_noise() -> None:
    drive, noise = Drive(pole=0.8), 3.0
    stretch = run(drive, noise=noise)
    law = identified(stretch, Structure(filtered="velocity"))
    corner = -np.log(drive.pole) / (2 * np.pi * DT)
    assert abs(value(law, "corner") - corner) < 3 * law.gains["corner"].std < 0.2 * corner
    # The same law as one equation: past torque and error among the regressors, no instruments.
    (e, v), y = columns(stretch, Structure(), np.zeros(2), DT).T, stretch.nu[Structure().lead :]
    x = np.stack([y[:-1], e[1:], e[:-1], v[1:]], axis=1)
    pole = np.linalg.lstsq(x, y[1:], rcond=None)[0][0]
    assert pole < 0.4


@pytest.mark.slow
def test_standard_deviations_are_those_of_the_scatter_under_coloured_noise() -> None:
    drive, structure = Drive(pole=0.8), Structure(filtered="velocity")
    quiet = run(drive, steps=4000)
    rng = np.random.default_rng(5)
    z = []
    for _ in range(60):
        noise = np.zeros(4000)
        white = rng.standard_normal(4000)
        for k in range(1, 4000):
            noise[k] = 0.9 * noise[k - 1] + white[k]
        law = identified(Stretch(quiet.q, quiet.r, quiet.nu + noise, quiet.added), structure)
        corner = -np.log(drive.pole) / (2 * np.pi * DT)
        truth = {"kp": drive.kp, "kv": drive.kv, "corner": corner}
        z.append([(value(law, name) - exact) / law.gains[name].std for name, exact in truth.items()])
    # Chi-square of 60 degrees of freedom: 0.53 to 1.65 holds the mean square with 99.9 %.
    spread = np.mean(np.square(z), axis=0)
    assert ((spread > 0.53) & (spread < 1.65)).all(), spread


def test_a_noise_model_that_hides_a_missing_filter_is_not_used() -> None:
    stretch = run(Drive(pole=0.9), noise=0.01)
    lacking = Structure()
    law = identified(stretch, lacking)
    simple = refined_iv([stretch], lacking, DT, noise_model=False).theta
    np.testing.assert_allclose([value(law, "kp") * value(law, "kv"), value(law, "kv")], simple, rtol=1e-6)


@pytest.mark.slow
def test_saturated_samples_are_left_out() -> None:
    drive = Drive(limit=100.0)
    stretch = run(drive)
    limited = int(np.sum(np.abs(stretch.nu) >= drive.limit))
    assert limited > 0.05 * stretch.nu.size
    law = identified(stretch, limit=drive.limit)
    # Samples within a thousandth of the limit count, too.
    assert limited <= law.saturated <= limited + 20
    assert value(law, "kp") == pytest.approx(drive.kp, rel=1e-3)
    assert value(law, "kv") == pytest.approx(drive.kv, rel=1e-3)
    assert abs(value(identified(stretch, Structure()), "kv") - drive.kv) > 0.02 * drive.kv


FORMS: tuple[Literal["position", "error", "both"], ...] = ("position", "error", "both")
FILTERS: tuple[Literal["velocity", "command"] | None, ...] = (None, "velocity", "command")
STRUCTURES = [
    Structure(velocity, n, filtered, integral, acceleration, delay)
    for velocity, n, filtered, integral, acceleration, delay in product(
        FORMS, (1, 3), FILTERS, (False, True), (False, True), (0, 2)
    )
]


def test_discrete_controller_is_the_law_that_was_fitted() -> None:
    for structure in STRUCTURES:
        steps, law = with_taps(structure)
        np.testing.assert_allclose(steps, law, rtol=1e-9, atol=1e-9 * np.abs(law).max(), err_msg=str(structure))


def with_taps(structure: Structure) -> tuple[Floats, Floats]:
    """Torques of a discrete controller and of the law, after the start."""
    rng = np.random.default_rng(0)
    steps = 400
    q, r = (np.cumsum(rng.standard_normal(steps)) * 1e-3 for _ in range(2))
    theta = rng.uniform(0.5, 1.5, structure.size)
    theta[structure.names.index("e")] *= 30.0
    if structure.filtered:
        theta[-1] = 0.7
    law = simulate_law(Stretch(q, r, np.zeros(steps), np.zeros(steps)), structure, theta, DT)
    error, position, output = taps(structure, theta, DT)
    e, nu = r - q, np.concatenate([np.zeros(structure.lead), law])
    k = np.arange(structure.lead + 100, steps)[:, None]
    made = e[k - np.arange(error.size)] @ error + q[k - np.arange(position.size)] @ position
    return made + nu[k - 1 - np.arange(output.size)] @ output, nu[k[:, 0]]


def test_what_cannot_be_identified_is_said() -> None:
    moving = run(Drive(), steps=1000)
    q, r, nu = (x[:, None] for x in (moving.q, moving.r, moving.nu))
    with pytest.raises(DataError, match="motor 2: position and reference never differ"):
        identify_parametric([np.hstack([q, r])], [np.hstack([r, r])], [np.hstack([nu, nu])], DT)
    with pytest.raises(DataError, match="motor 1: no 200 samples in a row are below its saturation"):
        identify_parametric([q], [r], [nu], DT, saturation=np.array([1e-6]))
    with pytest.raises(DataError, match="motor 1: its torque never changes"):
        identify_parametric([q], [r], [0 * nu], DT)
    with pytest.raises(DataError, match="2 structures and 1 saturations for 1 motors"):
        identify_parametric([q], [r], [nu], DT, structure=[Structure(), Structure()])
    still = np.full_like(q, 0.1)
    step = np.where(np.arange(1000) < 500, 0.1, 0.2)[:, None]
    with pytest.raises(DataError, match="motor 1: the motion does not determine a law of this structure"):
        identify_parametric([still], [step], [100 * (step - still)], DT, structure=Structure())


def emps(shared_data: Path, name: str) -> dict[str, Floats]:
    file = shared_data / "emps" / name
    if not file.is_file():
        pytest.skip(f"no {file.name} in the measured data")
    return {key: data.astype(float).reshape(-1, 1) for key, data in loadmat(file).items() if not key.startswith("__")}


FORCE_PER_VOLT = 35.15065


def emps_law(data: dict[str, Floats], force: Floats, added: Floats | None = None) -> ControlLaw:
    found = identify_parametric(
        [data["qm"]],
        [data["qg"]],
        [force],
        DT,
        saturation=np.array([10 * FORCE_PER_VOLT]),
        gain=np.array([FORCE_PER_VOLT]),
        added_motor=None if added is None else [added],
    )
    (law,) = found.responses
    assert isinstance(law, ControlLaw)
    return law


def test_recorded_gains_of_emps_come_out_to_four_digits(shared_data: Path) -> None:
    data = emps(shared_data, "DATA_EMPS.mat")
    law = emps_law(data, FORCE_PER_VOLT * data["vir"])
    assert value(law, "kp") == pytest.approx(data["kp"].item(), rel=1e-4)
    assert value(law, "kv") == pytest.approx(data["kv"].item(), rel=1e-4)
    # The published simulation has the same velocity over two samples, but a whole sample of delay that is not there.
    assert law.structure == Structure(velocity_taps=2)
    assert value(law, "velocity_delay") == pytest.approx(1.0, abs=0.01)
    assert value(law, "error_delay") == 0.0


@pytest.mark.slow
def test_recorded_gains_of_emps_come_out_under_pulses_and_so_does_their_size(shared_data: Path) -> None:
    data = emps(shared_data, "DATA_EMPS_PULSES.mat")
    force, pulses = FORCE_PER_VOLT * data["vir"], FORCE_PER_VOLT * data["pulses_N"]
    law = emps_law(data, force, pulses)
    assert law.structure == Structure(velocity_taps=2, added=True)
    assert value(law, "kp") == pytest.approx(data["kp"].item(), rel=1e-4)
    assert value(law, "kv") == pytest.approx(data["kv"].item(), rel=1e-4)
    # Pulses recorded as 5 V stand in the voltage with 5.07 V.
    assert value(law, "added") == pytest.approx(1.014, abs=5e-4)
    as_recorded = emps_law(data, force - pulses)
    assert value(as_recorded, "kp") == pytest.approx(data["kp"].item(), rel=0.02)
    assert value(as_recorded, "kv") == pytest.approx(data["kv"].item(), rel=0.02)


def test_a_drive_without_velocity_loop_is_seen_as_a_stiffness() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(3000) * DT
    r, q = np.sin(3 * t), np.sin(3 * t - 0.1)
    law = identified(Stretch(q, r, 5.0 * (r - q) + 0.01 * rng.standard_normal(t.size), np.zeros(t.size)))
    assert abs(value(law, "stiffness") - 5.0) < 3 * law.gains["stiffness"].std < 0.05
    assert abs(value(law, "kv")) < 3 * law.gains["kv"].std
