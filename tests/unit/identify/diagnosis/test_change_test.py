"""Chi-square test of parameter change: false-alarm rate and power."""

import numpy as np
import pytest

from armident.configs import DataError
from armident.identify.diagnosis.baseline_comparison import Inconclusive
from armident.identify.diagnosis.change_test import FALSE_ALARMS, compare
from armident.identify.documents.base import RecordingReference
from armident.identify.documents.identification import IdentificationDocument, Parameter

NAMES = [f"p{k}" for k in range(30)]
TRUTH = np.linspace(0.5, 20.0, 30)


def covariance(seed: int = 0) -> np.ndarray:
    """Covariance of correlated parameters of different sizes, about 2 % each."""
    rng = np.random.default_rng(seed)
    mixed = rng.standard_normal((30, 30)) + 3 * np.eye(30)
    scale = 0.02 * TRUTH
    c = mixed @ mixed.T
    d = np.sqrt(np.diag(c))
    return np.asarray(c / np.outer(d, d) * np.outer(scale, scale))


C = covariance()


def identified(
    theta: np.ndarray, c: np.ndarray = C, robot: str = "arm", names: list[str] = NAMES
) -> IdentificationDocument:
    std = np.sqrt(np.diag(c))
    return IdentificationDocument(
        robot=robot,
        recording=RecordingReference(path=None, sha256="0" * 64, sample_rate_hz=5000.0, samples=1),
        method="idim-piv",
        options={},
        parameters=[
            Parameter(name=n, value=float(v), std=float(s), relative_std_pct=None, unit="N m", essential=True)
            for n, v, s in zip(names, theta, std, strict=True)
        ],
        covariance=c.tolist(),
        relative_error_pct=1.0,
        relative_error_pct_by_joint={},
        iterations=1,
        converged=True,
        stop_reason="",
        whiteness=[],
        noise_model={},
        controller={},
        timing_s={},
        versions={},
        warnings=[],
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pairs", "least"),
    [
        # At a rate of 0.025, fewer than 2 alarms of 300 have a probability of 0.4 %.
        (300, 2),
        pytest.param(2000, 0.025 * 2000, marks=[pytest.mark.slow, pytest.mark.nightly]),
    ],
)
def test_alarms_without_a_change_are_as_rare_as_promised(pairs: int, least: float) -> None:
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal(TRUTH, C, 2 * pairs)
    alarms = sum(
        compare(identified(a), identified(b), 0.05).drifted for a, b in zip(draws[::2], draws[1::2], strict=True)
    )
    # Holm and the split of the rate keep below it; two tests of the same numbers overlap. Three standard deviations.
    assert least <= alarms <= 0.05 * pairs + 3 * np.sqrt(0.05 * 0.95 * pairs)


def test_two_hundred_runs_of_the_same_arm_give_no_alarm() -> None:
    draws = np.random.default_rng(2).multivariate_normal(TRUTH, C, 201)
    assert not any(compare(identified(draws[0]), identified(d)).drifted for d in draws[1:])


@pytest.mark.parametrize("k", [0, 7, 29])
def test_a_change_of_one_parameter_is_found_by_name(k: int) -> None:
    rng = np.random.default_rng(3)
    named = 0
    for _ in range(50):
        before, after = rng.multivariate_normal(TRUTH, C, 2)
        after[k] += 0.20 * TRUTH[k]
        drift = compare(identified(before), identified(after))
        assert drift.drifted
        named += drift.changed[:1] == (NAMES[k],)
        assert drift.difference[k] == pytest.approx(0.2 * TRUTH[k], abs=5 * drift.std[k])
        if drift.changed:
            assert f"changed: {drift.changed[0]} {before[NAMES.index(drift.changed[0])]:.4g} -> " in drift.words
    assert named >= 45


def test_a_change_that_no_single_parameter_shows_is_found_jointly() -> None:
    values, vectors = np.linalg.eigh(C / np.outer(np.sqrt(np.diag(C)), np.sqrt(np.diag(C))))
    # Twelve deviations along the best-known direction are less than three in any parameter.
    step = 12 * np.sqrt(2 * values[0]) * vectors[:, 0] * np.sqrt(np.diag(C))
    drift = compare(identified(TRUTH), identified(TRUTH + step))
    assert drift.changed == ()
    assert drift.p_joint < FALSE_ALARMS / 2
    assert drift.drifted
    assert "no single parameter significantly" in drift.words


def test_the_order_of_the_parameters_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    before, after = rng.multivariate_normal(TRUTH, C, 2)
    shuffled = rng.permutation(30)
    turned = identified(before[shuffled], C[np.ix_(shuffled, shuffled)], names=[NAMES[k] for k in shuffled])
    a, b = compare(identified(before), identified(after)), compare(turned, identified(after))
    assert a.chi_square == pytest.approx(b.chi_square)
    np.testing.assert_allclose(a.p_values, b.p_values)


def test_another_robot_or_model_is_refused() -> None:
    with pytest.raises(DataError, match="the baseline is of robot 'arm', the identification of 'other'"):
        compare(identified(TRUTH), identified(TRUTH, robot="other"))
    with pytest.raises(DataError, match="different base parameters: p29, q"):
        compare(identified(TRUTH), identified(TRUTH, names=[*NAMES[:29], "q"]))


def test_a_run_that_did_not_converge_is_not_called_unchanged() -> None:
    """Its deviations are as wild as its values: everything would be within them."""
    wild = identified(TRUTH * 3, C * 1e12).model_copy(update={"converged": False, "stop_reason": "stopped after 20"})
    with pytest.raises(Inconclusive, match=r"the identification did not converge \(stopped after 20\)"):
        compare(identified(TRUTH), wild)
    with pytest.raises(DataError, match="the baseline did not converge"):
        compare(wild, identified(TRUTH))


def test_friction_that_changed_as_a_whole_is_found_where_no_part_is_clear() -> None:
    """Viscous and Coulomb friction, hard to tell apart: their common direction is known ten times better than each."""
    names = [f"{kind}{joint}" for joint in range(1, 7) for kind in ("fv", "fc", "xx", "mx", "my")]
    c = np.diag((0.02 * TRUTH) ** 2)
    for k in (0, 5, 10, 15, 20, 25):
        c[k, k + 1] = c[k + 1, k] = -0.98 * np.sqrt(c[k, k] * c[k + 1, k + 1])
    later = TRUTH.copy()
    later[[5, 6]] += 2.5 * 0.02 * TRUTH[[5, 6]]
    drift = compare(identified(TRUTH, c, names=names), identified(later, c, names=names))
    assert drift.changed == ()
    assert [(group.kind, group.place, group.members) for group in drift.changed_groups] == [
        ("friction", "2", ("fv2", "fc2"))
    ]
    assert drift.drifted
    assert "friction 2 (fv2, fc2 together)" in drift.words


def test_a_run_that_knows_far_less_is_not_called_unchanged() -> None:
    """A hundred times the deviations: a friction that doubled would be within them."""
    with pytest.raises(Inconclusive, match="standard deviations are 1e\\+02 times those of the baseline"):
        compare(identified(TRUTH), identified(2 * TRUTH, C * 1e4))
    with pytest.raises(DataError, match=r"standard deviations are 0\.01 times those of the baseline"):
        compare(identified(TRUTH, C * 1e4), identified(2 * TRUTH))
    assert compare(identified(TRUTH), identified(2 * TRUTH, C * 16)).drifted
