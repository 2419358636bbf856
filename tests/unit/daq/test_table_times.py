"""Times of tables: units, dates, gaps, jitter and polled rows."""

from pathlib import Path

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from typer.testing import CliRunner

from armident.configs import ConfigError, DataError
from armident.daq.cli import application
from armident.daq.interchange.exporting import export_recording
from armident.daq.interchange.importing import import_recording
from tests.unit.daq.tables import NAMES, N, motion, same, written
from tests.unit.daq.test_importing import PANDA, TX40, moving_panda


@pytest.mark.parametrize("unit", ["min", "h", "ticks"])
def test_a_unit_of_times_that_is_not_read_is_refused(tmp_path: Path, unit: str) -> None:
    values = motion() * np.append(1 / 60, np.ones(2 * N))
    path = written(tmp_path / "a.csv", values, [f"time [{unit}]", *NAMES[1:]])
    with pytest.raises(DataError, match=f"the time column states the unit '{unit}', expected s, ms, us or ns"):
        import_recording(path, TX40)


@pytest.mark.parametrize(("unit", "factor"), [("msec", 1e3), ("\u03bcs", 1e6), ("milliseconds", 1e3), ("sec.", 1.0)])
def test_units_of_times_have_many_spellings(tmp_path: Path, unit: str, factor: float) -> None:
    values = motion() * np.append(factor, np.ones(2 * N))
    found = import_recording(written(tmp_path / "a.csv", values, [f"Time ({unit})", *NAMES[1:]]), TX40)
    assert found.sample_rate_hz == pytest.approx(1000)


def test_each_column_of_times_has_the_unit_of_its_own_name(tmp_path: Path) -> None:
    values = np.insert(motion(200, 100.0), 1, 0.0, axis=1)
    values[:, 1] = 1e6 * values[:, 0]
    values[:, 0] *= 1e3
    found = import_recording(written(tmp_path / "a.csv", values, ["t [ms]", "timestamp_us", *NAMES[1:]]), TX40)
    assert found.sample_rate_hz == pytest.approx(100)


def test_a_date_of_another_form_is_named(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion(), sep=";")
    names, *rows = path.read_text().splitlines()
    path.write_text("\n".join([names, *(f"06.03.2026 15:00:{row}" for row in rows)]) + "\n")
    with pytest.raises(
        DataError, match=r"line 2 has '06\.03\.2026 .*expected numbers; dates are read in the form 2026"
    ):
        import_recording(path, TX40)


def test_dates_in_the_column_of_times_are_read(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion(200), cell="{:.9f}")
    lines = path.read_text().splitlines()
    dated = [f"2026-03-06T15:00:0{line}" for line in lines[1:]]
    path.write_text("\n".join([lines[0], *dated]) + "\n")
    found = import_recording(path, TX40)
    assert same(found, motion(200))
    assert found.sample_rate_hz == pytest.approx(1000, rel=1e-4)


@pytest.mark.parametrize(("unit", "factor"), [("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_times_in_another_unit_are_recognised(tmp_path: Path, unit: str, factor: float) -> None:
    for rate in (100.0, 1000.0, 5000.0):
        values = motion(2000, rate)
        values[:, 0] = (1000 + values[:, 0]) * factor
        path = written(tmp_path / "a.csv", values, cell="{:.16g}")
        with pytest.raises(DataError, match=rf"in {unit} it would be {rate:.0f} Hz: --time-unit {unit}"):
            import_recording(path, TX40)
        found = import_recording(path, TX40, time_unit=unit)
        assert found.sample_rate_hz == pytest.approx(rate, rel=1e-6)
    with pytest.raises(ConfigError, match="--time-unit: expected one of s, ms, us, ns, found min"):
        import_recording(path, TX40, time_unit="min")


@pytest.mark.parametrize("step", [1e-10, 1e-200, 5e-324])
@pytest.mark.parametrize("repeats", [1, 2])
def test_steps_below_a_nanosecond_are_no_clock(tmp_path: Path, step: float, repeats: int) -> None:
    values = motion(500, 1000.0)
    values[:, 0] = np.arange(500) // repeats * step
    path = written(tmp_path / "a.csv", values, cell="{:.17g}")
    for rate in (None, 1000.0):
        with pytest.raises(DataError, match=r"shorter than 1 ns.*--time-unit"):
            import_recording(path, TX40, resample_hz=rate)


def test_times_of_less_than_a_period_are_not_resampled(tmp_path: Path) -> None:
    values = motion(500, 1e6)
    with pytest.raises(DataError, match=r"span 0.000499 s, less than a period of --resample 1000; .*--time-unit"):
        import_recording(written(tmp_path / "a.csv", values, cell="{:.17g}"), TX40, resample_hz=1000.0)


def test_slow_motion_and_low_rates_are_seconds(tmp_path: Path) -> None:
    for rate, share in ((30.0, 1.0), (1000.0, 0.001), (5000.0, 1.0)):
        values = motion(600, rate)
        values[:, 1 : N + 1] *= share
        assert import_recording(written(tmp_path / "a.csv", values), TX40).sample_rate_hz == pytest.approx(rate)


def test_a_rate_that_contradicts_the_times_is_refused_with_both(tmp_path: Path) -> None:
    path = written(tmp_path / "a.csv", motion())
    for rate in (500.0, 998.0 * 1.02, 5000.0):
        with pytest.raises(DataError, match=rf"--rate {rate:g} contradicts the times: .* 1000 Hz"):
            import_recording(path, TX40, rate_hz=rate)
    assert import_recording(path, TX40, rate_hz=1000.0).sample_rate_hz == 1000.0


@pytest.mark.parametrize("rate", [None, 1000.0])
def test_missing_rows_are_gaps(tmp_path: Path, rate: float | None) -> None:
    values = motion()
    kept = np.ones(400, bool)
    kept[[10, 11, 50, 51, 52, 53, 200]] = False
    kept[260:350] = False
    kept[np.random.default_rng(4).integers(60, 190, 30)] = False
    found = import_recording(written(tmp_path / "a.csv", values[kept]), TX40, rate_hz=rate)
    assert np.array_equal(found.samples.sync, np.flatnonzero(kept))
    assert found.sample_rate_hz == pytest.approx(1000.0, rel=1e-9), "missing rows do not lower the rate"
    assert same(found, values[kept])
    missing = [n for gap in found.gaps for n in range(gap.first, gap.last + 1)]
    assert missing == np.flatnonzero(~kept).tolist()
    assert found.counters["samples.in_gaps"] == len(missing)


@pytest.mark.parametrize("odd", [0.1, -5.0, 1e12])
def test_a_single_time_out_of_order_is_a_gap(tmp_path: Path, odd: float) -> None:
    values = motion()
    values[200, 0] = odd
    found = import_recording(written(tmp_path / "a.csv", values), TX40)
    assert [(gap.first, gap.last) for gap in found.gaps] == [(200, 200)]
    assert "left out: 1, the first:" in found.metadata["source_remarks"]
    assert "line 202, column t" in found.metadata["source_remarks"]


def test_times_with_too_few_digits_need_a_rate(tmp_path: Path) -> None:
    values = motion()
    values[:, 0] = np.round(values[:, 0], 2)
    path = written(tmp_path / "a.csv", values)
    with pytest.raises(DataError, match=r"too few digits: .*; --rate 1000 if the samples are even"):
        import_recording(path, TX40)
    with pytest.raises(DataError, match=r"359 of 400 rows have the time of the row before: .* too few digits"):
        import_recording(path, TX40, resample_hz=1000.0)
    assert same(import_recording(path, TX40, rate_hz=1000.0), motion())


def test_the_rate_of_the_hint_is_that_of_the_samples(tmp_path: Path) -> None:
    values = motion(600, 3000.0)
    values[:, 0] = np.round(values[:, 0], 4)
    with pytest.raises(DataError, match=r"the times jitter.*--resample 3000 puts"):
        import_recording(written(tmp_path / "a.csv", values), TX40)
    values = np.delete(values, np.s_[100:300], axis=0)
    values[:, 0] += np.random.default_rng(1).uniform(0, 1e-5, len(values))
    with pytest.raises(DataError, match=r"the times jitter.*--resample 3[0-9]00 puts"):
        import_recording(written(tmp_path / "b.csv", values), TX40)


def test_rows_that_are_there_twice_are_taken_once(tmp_path: Path) -> None:
    values = motion()
    found = import_recording(written(tmp_path / "a.csv", values[np.sort(np.append(np.arange(400), [7, 90]))]), TX40)
    assert same(found, values)
    assert "2 duplicate rows with the same time" in found.metadata["source_remarks"]


def jittering(rows: int = 3000, share: float = 0.2) -> np.ndarray:
    """Return a motion sampled at times that are off by a share of the period."""
    values = motion(rows)
    t = values[:, 0] + np.random.default_rng(1).uniform(-share, share, rows) * 1e-3
    phase = np.arange(N)
    amplitude = 0.05 * np.array([joint.limits.velocity for joint in TX40.joints])
    return np.column_stack([t, amplitude * np.sin(6 * t[:, None] + phase), 3 * np.cos(6 * t[:, None] + phase)])


def test_uneven_times_are_resampled_when_asked_and_said(tmp_path: Path) -> None:
    values = np.delete(jittering(), slice(1000, 1100), axis=0)
    path = written(tmp_path / "a.csv", values, cell="{:.12g}")
    with pytest.raises(DataError, match=r"the times jitter.*--resample 1000 puts") as caught:
        import_recording(path, TX40)
    assert "--rate" not in str(caught.value)
    found = import_recording(path, TX40, resample_hz=1000.0)
    t = values[0, 0] + found.samples.sync / 1000.0
    phase = np.arange(N)
    amplitude = 0.05 * np.array([joint.limits.velocity for joint in TX40.joints])
    assert np.abs(found.samples.raw["position"] - amplitude * np.sin(6 * t[:, None] + phase)).max() < 1e-6
    assert len(found.gaps) == 1
    assert 98 <= found.counters["samples.in_gaps"] <= 102
    assert "to 1000 Hz: positions by cubic splines" in found.metadata["resampled"]
    assert import_recording(path, TX40, resample_hz=250.0).sample_rate_hz == 250.0
    out = ["import", str(path), "--config", "tx40.yaml", "--resample", "1000", "--out", str(tmp_path / "a.mcap")]
    assert CliRunner().invoke(application(["import"]), out).exit_code == 0


def test_rows_that_were_polled_twice_as_fast_are_said(tmp_path: Path) -> None:
    values = np.repeat(motion(), 2, axis=0)
    values[:, 0] = np.arange(len(values)) / 2000
    path = written(tmp_path / "a.csv", values)
    remarks = import_recording(path, TX40).metadata["source_remarks"]
    assert "50.1 % of the rows repeat the row before" in remarks
    assert "--resample RATE, with the rate of the controller" in remarks
    assert same(import_recording(path, TX40, resample_hz=1000), motion())


def test_polled_rows_with_times_are_put_on_the_clock_of_the_controller(tmp_path: Path) -> None:
    q, tau = moving_panda()
    rng = np.random.default_rng(5)
    asked = np.sort(np.append(np.arange(len(q)), rng.integers(0, len(q), len(q) // 15)))
    rows = asked[rng.random(len(asked)) > 1 / 12]
    t = np.linspace(0, 4.0, len(rows)) + rng.uniform(0, 4e-4, len(rows))
    names = ["t", *(f"q{j + 1}" for j in range(7)), *(f"tau{j + 1}" for j in range(7))]
    path = written(tmp_path / "a.csv", np.column_stack([t, q[rows], tau[rows]]), names)
    for rate in (None, 1000.0):
        with pytest.raises(DataError, match=r"the samples were polled; --resample RATE"):
            import_recording(path, PANDA, rate_hz=rate)
    found = import_recording(path, PANDA, resample_hz=1000.0)
    asked_for = import_recording(path, PANDA, rate_hz=1000.0, polled=True)
    assert found.sha256 == asked_for.sha256
    assert abs(len(found.samples.sync) - len(q)) < 30
    assert "polled samples put on a clock of 1000 Hz" in found.metadata["source_remarks"]
    with pytest.raises(DataError, match=r"the motion takes .* at the 250 Hz of --resample, but .* by the time column"):
        import_recording(path, PANDA, resample_hz=250.0)


def test_a_table_from_the_newest_to_the_oldest_row_is_turned_round(tmp_path: Path) -> None:
    found = import_recording(written(tmp_path / "a.tsv", motion()[::-1], sep="\t"), TX40)
    assert same(found, motion())
    assert "the newest row comes first" in found.metadata["source_remarks"]
    assert not found.gaps


def test_a_second_run_in_a_table_is_named_with_its_line(tmp_path: Path) -> None:
    twice = np.concatenate([motion(200), motion(200)])
    with pytest.raises(
        DataError, match=r"line 202, column t: .* goes back by 0\.199; another run begins here.*one file"
    ):
        import_recording(written(tmp_path / "a.csv", twice), TX40)


@pytest.mark.parametrize(("unit", "wrap"), [("us", 2**32), ("ms", 2**16), ("ms", 2**32)])
def test_times_of_a_counter_that_wraps_go_on(tmp_path: Path, unit: str, wrap: int) -> None:
    values = motion()
    values[:, 0] = (np.rint(values[:, 0] * {"us": 1e6, "ms": 1e3}[unit]) - 150 + wrap) % wrap
    found = import_recording(written(tmp_path / "a.csv", values, cell="{:.12g}"), TX40, time_unit=unit)
    assert same(found, motion())
    assert f"times begin again after {wrap} (1 times): unwrapped" in found.metadata["source_remarks"]


def test_a_unit_of_times_is_advised_only_if_no_other_is_plausible(tmp_path: Path) -> None:
    values = motion()
    values[:, 0] *= 2e4
    values[:, 1 : N + 1] = values[0, 1 : N + 1]
    with pytest.raises(
        DataError, match=r"in ms it would be 50 Hz and in us it would be 50000 Hz: state the unit with --time-unit$"
    ):
        import_recording(written(tmp_path / "a.csv", values), TX40)


@pytest.mark.parametrize(("unit", "seconds"), [("min", 60.0), ("h", 3600.0), ("days", 86400.0)])
def test_times_in_longer_units_than_seconds_are_refused(tmp_path: Path, unit: str, seconds: float) -> None:
    values = motion()
    values[:, 0] /= seconds
    with pytest.raises(DataError, match=rf"in {unit} it would be 1000 Hz.*: convert the times to s$"):
        import_recording(written(tmp_path / "a.csv", values, cell="{:.16g}"), TX40)


def test_a_column_that_counts_samples_is_not_only_taken_for_milliseconds(tmp_path: Path) -> None:
    values = motion(rate=500.0)
    values[:, 0] = np.arange(len(values))
    path = written(tmp_path / "a.csv", values)
    with pytest.raises(DataError, match=r"--time-unit ms .*counts samples, omit it with --map time=- and give their"):
        import_recording(path, TX40)
    found = import_recording(path, TX40, names={"time": "-"}, rate_hz=500.0)
    assert found.sample_rate_hz == 500.0


def test_two_columns_of_times_are_named(tmp_path: Path) -> None:
    values = motion()
    path = written(tmp_path / "a.csv", np.column_stack([values[:, 0] * 2.0, values]), ["timestamp", *NAMES])
    found = import_recording(path, TX40)
    assert found.sample_rate_hz == pytest.approx(1000.0)
    assert "times taken from t, not from timestamp; --map time=NAME chooses" in found.metadata["source_remarks"]


def test_durations_are_times(tmp_path: Path) -> None:
    values = motion()
    times = (values[:, 0] * 1e9).round().astype("m8[ns]")
    np.savez(tmp_path / "a.npz", t=times, q=values[:, 1 : N + 1], tau=values[:, N + 1 :])
    assert import_recording(tmp_path / "a.npz", TX40).sample_rate_hz == pytest.approx(1000.0)


@pytest.mark.parametrize("order", ["blocks", "reversed blocks", "shuffled"])
def test_rows_out_of_order_are_sorted_by_even_times(tmp_path: Path, order: str) -> None:
    blocks = np.split(np.arange(1000), 10)
    rows = {
        "blocks": np.concatenate(blocks[::-1]),
        "reversed blocks": np.concatenate([block[::-1] for block in blocks]),
        "shuffled": np.random.default_rng(4).permutation(1000),
    }[order]
    found = import_recording(written(tmp_path / "a.csv", motion(1000)[rows], cell="{:.9f}"), TX40)
    assert same(found, motion(1000))
    assert "sorted by time" in found.metadata["source_remarks"]
    overlapping = motion(1000)
    overlapping[600:, 0] -= 0.1004
    with pytest.raises(DataError, match="another run begins here"):
        import_recording(written(tmp_path / "b.csv", overlapping, cell="{:.9f}"), TX40)


def test_the_rate_of_times_in_whole_seconds_is_that_of_their_changes(tmp_path: Path) -> None:
    values = motion(4000, 250.0)
    values[2001, 1:] = values[2000, 1:]  # no duplicate row, although its time is the same
    values[:, 0] = np.floor(values[:, 0] + 0.7)
    path = written(tmp_path / "a.csv", values, cell="{:.9f}")
    with pytest.raises(DataError, match=r"too few digits: .* 250 Hz on average .*--rate 250 if the samples are even"):
        import_recording(path, TX40)
    found = import_recording(path, TX40, rate_hz=250.0)
    assert found.samples.sync.size == 4000
    np.testing.assert_allclose(found.samples.si("position"), values[:, 1 : N + 1], atol=1e-8)


@pytest.mark.parametrize("how", ["date", "epoch", "parquet"])
def test_the_date_of_times_stays_in_recording_and_export(tmp_path: Path, how: str) -> None:
    values = motion(200)
    if how == "parquet":
        stamps = np.datetime64("2026-03-06T15:00:00", "ns") + np.rint(1e9 * values[:, 0]).astype("timedelta64[ns]")
        path = tmp_path / "a.parquet"
        columns = {"timestamp": stamps, **dict(zip(NAMES[1:], values[:, 1:].T, strict=True))}
        pyarrow.parquet.write_table(pyarrow.table(columns), path)
    else:
        path = written(tmp_path / "a.csv", values, cell="{:.9f}")
        names, *rows = path.read_text().splitlines()
        begin = "2026-03-06T15:00:00" if how == "date" else "1772809200"
        path.write_text("\n".join([names, *(f"{begin}{row[1:]}" for row in rows)]) + "\n")
    found = import_recording(path, TX40)
    assert found.samples.t_ns[0] == 1_772_809_200_000_000_000
    export_recording(found, tmp_path / "b.csv")
    assert (tmp_path / "b.csv").read_text().startswith("t [s since 2026-03-06T15:00:00.000000000Z],")
