"""Messages on Zenoh that are forged, repeated, moved to another key, or signed by somebody who may not publish them."""

import queue
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext

from armident.configs import DataError, SessionConfig
from armident.daq.identity import VARIABLE
from armident.daq.identity.certificates import Authority, Role, read_authority, write_identity
from armident.daq.identity.folder import KeyFolder, key_folder
from armident.daq.identity.signatures import LARGEST, Signer, new_nonce, signer_for, trust_for
from armident.daq.recording import Recording
from armident.daq.streaming import Keys, Refusals, encode_block, encode_event, open_session
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.monitoring.recursive.live_watch import live_estimator
from armident.identify.monitoring.worker.worker import Worker
from armident.identify.monitoring.worker.worker_receiver import WorkerReceiver
from tests.integration.test_watch import recorded as of_watch
from tests.integration.test_watch import reference, watching
from tests.integration.test_worker import LONGEST_S, blocks_of, in_a_cell, in_its_file, publish

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return in_its_file("emps", tmp_path_factory.mktemp("recordings"))


@pytest.fixture
def session(request: pytest.FixtureRequest, tmp_path: Path) -> SessionConfig:
    """A cell for one test, whose recordings are in the folder of the test."""
    session = in_a_cell("emps", request.node.name, {"method": "idim-ls"})
    return session.model_copy(update={"recording": session.recording.model_copy(update={"directory": tmp_path})})


@pytest.fixture
def reasons(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Reasons of all refusals, of which the log has the first, the tenth, the hundredth."""
    found: list[str] = []
    monkeypatch.setattr(Refusals, "refuse", lambda _self, _kind, reason: found.append(str(reason)))
    return found


def issued(folder: Path, role: Role, cell: str, authority: Authority | None = None, *, now: Any = None) -> Signer:
    """Return a signer with a key of its own, by default of the authority that the receivers trust."""
    folder.mkdir(parents=True, exist_ok=True)
    trusted = key_folder().path
    shutil.copy(trusted / "authority.pem", folder)
    issuer = authority or read_authority(trusted)
    write_identity(folder, issuer.issue(role, cell, f"{role}.{cell}", [], 30, now))
    return Signer(KeyFolder(folder), role, cell)


def until(condition: Any, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_worker_takes_only_what_is_rightly_signed(
    session: SessionConfig, captured: Recording, tmp_path: Path, reasons: list[str]
) -> None:
    keys, other = Keys(session.cell, "emps"), Keys(session.cell, "other")
    block, second = (encode_block(each) for each in list(blocks_of(captured))[:2])
    event = encode_event("mark", {"text": "x"})
    capture, worker = signer_for(session, "capture"), signer_for(session, "worker")
    foreign = KeyFolder(tmp_path / "foreign", local=True)
    old = issued(tmp_path / "old", "capture", session.cell, now=datetime(2000, 1, 1, tzinfo=UTC))
    right = capture.attachment(keys.samples, block)
    attacks = [
        (keys.events, event, None, "without signature"),
        (keys.samples, block, None, "without signature"),
        (keys.events, event, b"", "no signature"),
        (keys.events, event, b"ARMS" + bytes(9), "no signature"),
        (keys.samples, block, right[:20], "shorter than its head states"),
        (keys.samples, block, b"ARMS\x02" + right[5:], "of version 2"),
        (keys.samples, block, right + bytes(LARGEST), "an attachment of"),
        (keys.samples, block, right[:-1], "does not fit"),
        # The time, the payload, the name of the capture, and the key expression are part of what is signed.
        (keys.samples, block, right[:6] + b"\0" + right[7:], "does not fit"),
        (keys.samples, second, right, "does not fit"),
        (keys.samples, encode_block(replace(next(blocks_of(captured)), capture="c2")), right, "does not fit"),
        (keys.events, block, right, "does not fit"),
        (keys.samples, block, capture.attachment(other.samples, block), "does not fit"),
        (keys.samples, block, worker.attachment(keys.samples, block), "the role worker may not publish it"),
        (keys.events, event, signer_for(session, "operator").attachment(keys.events, event), "operator may not"),
        (keys.events, event, signer_for(session, "viewer").attachment(keys.events, event), "viewer may not publish it"),
        (keys.identification, b"{}", capture.attachment(keys.identification, b"{}"), "capture may not"),
        (keys.samples, block, issued(tmp_path / "wrong", "capture", "x").attachment(keys.samples, block), "of cell x"),
        (keys.samples, block, Signer(foreign, "capture", session.cell).attachment(keys.samples, block),
         "issued by another authority"),
        (keys.samples, block, old.attachment(keys.samples, block), "expired on 2000-01-31"),
    ]  # fmt: skip
    taken: queue.Queue[bytes | None] = queue.Queue()
    with (
        closing(WorkerReceiver(session, keys, lambda d, _: taken.put(d), lambda d, _: taken.put(d), (99999, 99999))) as
        receiver, open_session(session, "worker") as stranger,
    ):  # fmt: skip
        receiver.check()
        until(lambda: seen(stranger, keys, capture, taken))
        reasons.clear()
        for key, data, attachment, _ in attacks:
            stranger.put(key, data, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: len(reasons) >= len(attacks))
        stranger.put(keys.samples, block, attachment=right)
        until(lambda: not taken.empty())
        assert taken.get() == block
        assert not receiver.take_heard()
    for key, _, _, expected in attacks:
        assert any(expected in reason and reason.startswith(f"{key}: ") for reason in reasons), expected
    assert len(reasons) == len(attacks)


def seen(stranger: zenoh.Session, keys: Keys, signer: Signer, taken: "queue.Queue[bytes | None]") -> bool:
    """Publish until the receiver takes it, so that the sessions have found each other."""
    stranger.put(keys.events, b"hello", attachment=signer.attachment(keys.events, b"hello"))
    time.sleep(0.2)
    found = not taken.empty()
    while not taken.empty():
        taken.get()
    return found


def test_a_forged_capture_has_no_result(
    session: SessionConfig, captured: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reasons: list[str]
) -> None:
    foreign = KeyFolder(tmp_path / "foreign", local=True)
    foreign.identity("capture", session.cell)
    with Worker(session, captured.robot, tmp_path) as worker:
        monkeypatch.setenv(VARIABLE, str(foreign.path))
        publish(captured, session, path=tmp_path / "gone.mcap")
        monkeypatch.delenv(VARIABLE)
        assert worker.result(3.0) is None
        assert any("issued by another authority" in reason for reason in reasons)
        publish(captured, session, path=tmp_path / "gone.mcap")
        assert worker.result(LONGEST_S) == 0


def test_a_repeated_capture_has_no_second_result(session: SessionConfig, captured: Recording, tmp_path: Path) -> None:
    keys, heard = Keys(session.cell, "emps"), list[tuple[str, bytes, bytes]]()

    def listen(sample: zenoh.Sample) -> None:
        assert sample.attachment is not None
        heard.append((str(sample.key_expr), bytes(sample.payload), bytes(sample.attachment)))

    def repeat() -> None:
        with open_session(session, "capture") as stranger:
            time.sleep(2.0)
            for key, data, attachment in heard:
                stranger.put(key, data, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK)
            time.sleep(1.0)

    with Worker(session, captured.robot, tmp_path) as worker:
        with open_session(session, "observer") as observer:
            # A busy machine may connect it after the first messages: it asks for those before.
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            declared = [
                zenoh.ext.declare_advanced_subscriber(observer, key, listen, history=history)
                for key in (keys.events, keys.samples)
            ]
            publish(captured, session, path=tmp_path / "gone.mcap")
            assert worker.result(LONGEST_S) == 0
            for each in declared:
                each.undeclare()
        assert len(heard) >= 3
        repeat()
        assert worker.result(2.0) is None
    # Another worker does not know the names of finished captures, but the ledger knows the recording.
    with Worker(session, captured.robot, tmp_path) as worker:
        repeat()
        assert worker.result(4.0) is None
    assert len(list(tmp_path.glob("*.identification"))) == 1


def test_an_event_names_no_file_outside_of_the_folders_of_the_worker(
    session: SessionConfig, captured: Recording, tmp_path: Path, caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Also not by a link in the folder, or through it; the samples of the stream are used."""
    assert captured.path is not None
    (tmp_path / "emps-link.mcap").symlink_to(captured.path)
    inside = tmp_path / "day" / "emps-test.mcap"
    for path in (tmp_path / ".." / captured.path.parent.name / captured.path.name, tmp_path / "emps-link.mcap"):
        caplog.clear()
        own = session.model_copy(update={"cell": f"{session.cell}_{len(path.name)}"})
        own = own.model_copy(update={"recording": own.recording.model_copy(update={"directory": tmp_path / "day"})})
        with Worker(own, captured.robot, tmp_path / "day") as worker:
            publish(captured, own, path=path)
            assert worker.result(LONGEST_S) == 0
        assert f"{path} is not read: it is outside of {tmp_path / 'day'}" in caplog.text
        assert "samples from the stream" in capfd.readouterr().out
        shutil.rmtree(tmp_path / "day")
    inside.parent.mkdir()
    shutil.copy(captured.path, inside)
    with Worker(session, captured.robot, tmp_path / "out") as worker:
        publish(captured, session, path=inside)
        assert worker.result(LONGEST_S) == 0
    assert "samples from the file" in capfd.readouterr().out


def test_a_document_of_a_worker_says_who_signed_it(session: SessionConfig, captured: Recording, tmp_path: Path) -> None:
    with Worker(session, captured.robot, tmp_path) as worker:
        publish(captured, session, path=tmp_path / "gone.mcap")
        assert worker.result(LONGEST_S) == 0
    document = load_document(tmp_path / "gone.identification" / "identification.json", IdentificationDocument)
    assert document.signature is not None
    assert document.provenance is not None
    assert abs(datetime.fromisoformat(document.provenance["time"]).timestamp() - time.time()) < LONGEST_S


@pytest.fixture
def answering(session: SessionConfig) -> Iterator[list[bytes]]:
    """A program that answers queries for results with the attachments of this list, in their order."""
    keys, attachments = Keys(session.cell, "emps"), list[bytes]()

    def answer(query: zenoh.Query) -> None:
        with query:
            if attachments:
                query.reply(keys.identification, b"{}", attachment=attachments.pop(0))
            else:
                signer_for(session, "worker").reply(query, keys.identification, b"{}")

    with open_session(session, "worker") as own:
        declared = own.declare_queryable(keys.identification, answer)
        yield attachments
        declared.undeclare()


def test_an_old_result_is_not_taken_for_the_newest(session: SessionConfig, answering: list[bytes]) -> None:
    """A listener sends a nonce with its query, and knows the time of the last result that it has heard."""
    keys = Keys(session.cell, "emps")
    trust = trust_for(session, keys.base)

    def ask(observer: zenoh.Session) -> tuple[zenoh.Sample, bytes]:
        nonce = new_nonce()
        replies: list[zenoh.Reply] = []
        end = time.monotonic() + 30.0
        while not replies and time.monotonic() < end:
            replies.extend(observer.get(keys.identification, attachment=nonce))
        assert replies[0].ok is not None
        return replies[0].ok, nonce

    with open_session(session, "observer") as observer:
        first, nonce = ask(observer)
        signed = trust.check("answer", first.key_expr, bytes(first.payload), first.attachment, nonce=nonce)
        assert (signed.role, signed.cell) == ("worker", session.cell)
        assert first.attachment is not None
        answering.append(bytes(first.attachment))
        again, nonce = ask(observer)
    with pytest.raises(DataError, match="to another query"):
        trust.check("answer", again.key_expr, bytes(again.payload), again.attachment, nonce=nonce)
    with pytest.raises(DataError, match="an old message"):
        trust.check("publish", again.key_expr, bytes(again.payload), again.attachment, after_ns=signed.time_ns)


def test_a_watch_takes_no_block_of_an_earlier_capture_again(session: SessionConfig, reasons: list[str]) -> None:
    recording = of_watch()
    session = session.model_copy(update={"cell": f"{session.cell}_w"})
    estimator, key = live_estimator(session, recording.robot, reference()), Keys(session.cell, "tx40").samples
    first, second, *_ = (replace(block, sequence=0) for block in blocks_of(recording))
    signer = signer_for(session, "capture")
    sent = [(encode_block(each), signer.attachment(key, encode_block(each)))
            for each in (replace(first, capture="a"), replace(second, capture="b"))]  # fmt: skip
    with watching(session, estimator), open_session(session, "capture") as stranger:
        ready = threading.Event()
        deadline = time.monotonic() + 30.0
        while not ready.is_set() and time.monotonic() < deadline:
            for data, attachment in sent:
                stranger.put(key, data, attachment=attachment)
                time.sleep(0.1)
            if any("a block of capture a: older than those of b" in reason for reason in reasons):
                ready.set()
        assert ready.is_set()
    assert all("capture a: older" in reason for reason in reasons)
