"""Coverage of the 2-sigma intervals of IDIM-PIV; 200 runs: ``tests.statistics.coverage``."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from tests.statistics import coverage as campaign_module
from tests.statistics.coverage import (
    ESSENTIAL,
    FIRST_SEED,
    NOMINAL,
    SIGMAS,
    Runs,
    campaign,
    coverage,
    distances,
    fingerprint,
    main,
    table,
    truth,
)

LEVEL = 0.01
"""Probability of a false alarm of each of the two tests on simulated recordings."""


def drawn(understated: float, runs: int = 200, bias: float = 0.0) -> Runs:
    """Runs whose reported standard deviations are ``understated`` times the true ones."""
    rng = np.random.default_rng(0)
    names, values = truth()
    b = len(names)
    mixing = np.eye(b) + 0.2 * rng.standard_normal((b, b)) / np.sqrt(b)
    covariance = mixing @ mixing.T
    std = np.sqrt(np.diag(covariance))
    theta = values + bias * std + rng.standard_normal((runs, b)) @ mixing.T
    reported = np.broadcast_to(understated**2 * covariance, (runs, b, b))
    flags = np.ones(runs, np.bool_)
    return Runs(names, values, np.arange(runs), theta, reported, flags, ~flags)


def test_right_intervals_are_called_right_and_the_truth_is_as_far_as_chance_puts_it() -> None:
    runs = drawn(1.0)
    rows = coverage(runs)
    assert [row.name for row in rows] == list(ESSENTIAL)
    # 92 % of 200 is 2.4 standard deviations of the count below the nominal coverage.
    assert sum(row.verdict == "ok" for row in rows) >= 25
    assert not any(row.verdict in ("low", "high") for row in rows)
    assert np.mean([row.share for row in rows]) == pytest.approx(NOMINAL, abs=0.01)
    assert np.mean([row.inflation for row in rows]) == pytest.approx(1.0, abs=0.03)
    assert distances(runs).mean() == pytest.approx(len(ESSENTIAL), rel=4 * np.sqrt(2 / len(ESSENTIAL) / 200))


@pytest.mark.parametrize(("understated", "bias"), [(0.7, 0.0), (1.0, 1.0)], ids=["understated", "biased"])
def test_understated_or_biased_estimates_are_called_low(understated: float, bias: float) -> None:
    rows = coverage(drawn(understated, bias=bias))
    assert all(row.verdict == "low" for row in rows)
    assert all(row.inflation == pytest.approx(1 / understated, rel=0.2) for row in rows)
    assert np.mean([row.bias for row in rows]) == pytest.approx(bias, abs=0.1)


def test_overstated_standard_deviations_are_called_high() -> None:
    assert all(row.verdict == "high" for row in coverage(drawn(2.0)))


@pytest.mark.slow
def test_a_campaign_goes_on_where_it_stopped_and_main_tells_by_its_exit_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    right, simulated = drawn(1.0, 40), []
    folder = tmp_path / fingerprint("idim-piv", 1.0)
    folder.mkdir(parents=True)

    def store(seed: int, scale: float = 1.0) -> None:
        k = seed - FIRST_SEED
        np.savez(
            folder / f"{seed:06d}.npz",
            theta=right.theta[k],
            covariance=scale * right.covariance[k],
            converged=True,
            stepped_back=False,
        )

    def once(seed: int, folder: Path, **_: object) -> Path:
        path = folder / f"{seed:06d}.npz"
        if not path.exists():
            simulated.append(seed)
            store(seed)
        return path

    monkeypatch.setattr(campaign_module, "run_once", once)
    for seed in range(FIRST_SEED, FIRST_SEED + 30):
        store(seed)
    runs = campaign(range(FIRST_SEED, FIRST_SEED + 40), tmp_path)
    assert simulated == list(range(FIRST_SEED + 30, FIRST_SEED + 40))
    np.testing.assert_array_equal(runs.theta, right.theta)
    assert main(["--runs", "40", "--cache", str(tmp_path)]) == 0
    assert "runs 40, not converged 0" in capsys.readouterr().out
    for seed in range(FIRST_SEED, FIRST_SEED + 40):
        store(seed, 0.25)
    assert main(["--runs", "40", "--cache", str(tmp_path)]) == 1
    assert "low" in capsys.readouterr().out


def test_runs_of_other_settings_are_not_taken_for_these() -> None:
    assert len({fingerprint("idim-piv", 1.0), fingerprint("idim-iv", 1.0), fingerprint("idim-piv", 2.0)}) == 3


@pytest.mark.nightly
@pytest.mark.timeout(600)
def test_intervals_of_idim_piv_cover_the_truth_of_the_virtual_tx40(tmp_path: Path) -> None:
    count = 12
    runs = campaign(range(FIRST_SEED, FIRST_SEED + count), tmp_path)
    rows = coverage(runs)
    report = table(runs, rows)
    assert runs.converged.all(), report
    # Every parameter: one-sided binomial test, the level shared by the parameters (Bonferroni).
    least = stats.binom.ppf(LEVEL / len(rows), count, NOMINAL)
    assert all(row.covered >= least for row in rows), report
    # All together: the parameters of one run are correlated, the runs are not.
    shares = np.mean(np.abs(runs.deviations[:, runs.columns()]) <= SIGMAS, axis=1)
    assert stats.ttest_1samp(shares, NOMINAL).pvalue > LEVEL, report
