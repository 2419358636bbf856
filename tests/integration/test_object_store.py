"""Recordings in an object store: read by range, identified in place, and errors of one line."""

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from distributed import LocalCluster
from typer.testing import CliRunner, Result

import armident
from armident.configs import ConfigError, DataError
from armident.daq.cli import application
from armident.daq.recording import RecordingWriter, StreamLayout, read_recording
from tests.fixtures.arms import recording
from tests.fixtures.objects import BUCKET, ObjectStore, found_in, object_store

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]
URL = f"s3://{BUCKET}/cell_1/emps.mcap"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ObjectStore]:
    log = tmp_path_factory.mktemp("store") / "log"
    with object_store(log) as found, pytest.MonkeyPatch.context() as patch, found_in(found, patch):
        yield found


@pytest.fixture(scope="module")
def file(store: ObjectStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of 25 s in chunks of half a second, as a capture writes it, beside the object `URL`."""
    made = replace(recording("emps", "emps_excitation", 1), metadata={"cell": "cell_1"})
    path = tmp_path_factory.mktemp("file") / "emps.mcap"
    layouts = [StreamLayout.of(stream, ["joint_1"]) for stream in made.streams.values()]
    with RecordingWriter(path, made.robot, None, made.sample_rate_hz, layouts, made.metadata, 500_000_000) as writer:
        for first in range(0, int(made.samples.sync[-1]) + 1, 100):
            for stream in made.streams.values():
                part = (stream.sync >= first) & (stream.sync < first + 100)
                raw = {name: values[part] for name, values in stream.raw.items()}
                writer.append(stream.name, stream.sync[part], stream.t_ns[part], raw)
        writer.close({})
    store.put(path, "cell_1/emps.mcap")
    return path


def command(*words: str) -> Result:
    return CliRunner().invoke(application([words[0]]), list(words))


def test_a_tenth_of_a_recording_takes_a_fraction_of_its_bytes(store: ObjectStore, file: Path) -> None:
    size = file.stat().st_size
    store.received = 0
    whole = read_recording(URL)
    assert size < store.received < 1.1 * size
    store.received = 0
    part = read_recording(URL, (10.0, 12.5))
    assert store.received < 0.2 * size
    local = read_recording(file)
    assert whole.sha256 == local.sha256
    assert str(whole.path) == URL
    assert part.samples.sync.tolist() == list(range(10_000, 12_501))
    assert np.array_equal(part.samples.raw["position"], local.samples.raw["position"][10_000:12_501])


def test_a_recording_is_identified_and_checked_in_place(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = command("identify", URL, "--method", "idim-ls")
    assert done.exit_code == 0, done.stderr
    document = json.loads((tmp_path / "emps.identification" / "identification.json").read_text())
    assert document["recording"]["path"] == URL
    assert document["recording"]["sha256"] == read_recording(file).sha256
    same = armident.identify(file, method="idim-ls")
    assert [one["value"] for one in document["parameters"]] == same.theta.tolist()
    assert command("check", URL).exit_code == 0


def test_a_fleet_takes_a_pattern_of_objects(store: ObjectStore, file: Path, tmp_path: Path) -> None:
    store.put(file.read_bytes()[:3000], "cell_2/emps.mcap")
    words = ["reidentify", "--recordings", f"s3://{BUCKET}/cell_*/*.mcap", "--json"]
    words += ["--store", f"sqlite:///{tmp_path}/history.sqlite"]
    refused = command(*words)
    assert refused.exit_code == 2
    assert "--out: missing" in refused.stderr
    # The worker is a thread of this process, which has imported everything.
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp://", dashboard_address=None
    ) as remote:
        done = command(*words, "--out", str(tmp_path / "results"), "--scheduler", remote.scheduler_address)
    assert done.exit_code == 1, done.stderr
    one, other = json.loads(done.stdout)["runs"]
    assert (one["recording"], one["error"]) == (URL, None)
    assert Path(one["identification"]) == tmp_path / "results/cell_1/emps.identification/identification.json"
    assert other["recording"] == f"s3://{BUCKET}/cell_2/emps.mcap"
    assert "truncated before its first chunk" in other["error"]
    nothing = command(*words[:2], f"s3://{BUCKET}/cell_9/*.mcap", *words[3:])
    assert nothing.exit_code == 2
    assert "no such file" in nothing.stderr


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (f"s3://{BUCKET}/none.mcap", "no such recording, or no such bucket"),
        ("s3://elsewhere/run.mcap", "no such recording, or no such bucket"),
        ("nonsense://plant/run.mcap", "Protocol not known: nonsense"),
    ],
)
def test_an_object_that_is_not_there_is_one_line(file: Path, url: str, message: str) -> None:
    done = command("identify", url)
    assert done.exit_code == 2
    assert done.stderr.startswith(f"{url}: ") or f" {url}: " in done.stderr
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_an_object_that_is_cut_off_is_read_as_far_as_it_goes(store: ObjectStore, file: Path) -> None:
    half = file.read_bytes()[: file.stat().st_size // 2]
    torn = read_recording(store.put(half, "torn/emps.mcap"))
    assert torn.missing is not None
    assert 10_000 < torn.samples.sync.size < 15_000
    with pytest.raises(DataError, match="empty, not a recording"):
        read_recording(store.put(b"", "torn/empty.mcap"))


def test_a_missing_extra_names_its_installation(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(ConfigError, match=r"emps\.mcap needs extra packages: pip install 'armident\[objects\]'"):
        read_recording(URL)


def test_without_permission_the_credentials_are_named(store: ObjectStore, file: Path) -> None:
    store.ask_for_permission()
    try:
        with pytest.raises(ConfigError, match=r"no permission: [^;]+; check the credentials"):
            read_recording(URL)
    finally:
        store.ask_for_permission(False)


def test_a_network_that_is_gone_is_one_line(store: ObjectStore, file: Path) -> None:
    store.left = 0
    try:
        with pytest.raises(ConfigError, match=r"emps\.mcap: cannot be read: "):
            read_recording(URL)
    finally:
        store.left = float("inf")
