"""The page of a plant: its contents, what is damaged or hostile, and its borders."""

import json
import os
import re
import sqlite3
import time
from contextlib import closing
from html import escape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from armident.daq.identity.certificates import Role
from armident.daq.identity.signatures import signer_for
from armident.daq.streaming import Keys, encode_event, open_session
from armident.identify.documents.diagnosis import DiagnosisDocument
from armident.identify.documents.files import load_document
from armident.identify.documents.identification import IdentificationDocument
from armident.identify.documents.rounding import alike
from armident.identify.monitoring.worker.ledger import FILE, Ledger, view_of
from armident.identify.page.attention import SILENT_S, CellView, words
from armident.identify.page.site import PAGE_POLICY, REPORT_POLICY
from tests.fixtures import plant
from tests.unit.identify.page.conftest import Page, Serve, health

pytestmark = pytest.mark.slow

NAME = plant.name_of(5)


def text_of(html: str) -> str:
    """Words of a page in one line, without tags."""
    return " ".join(re.sub("<[^>]*>", " ", html).split())


def test_the_cell_that_needs_somebody_comes_first_with_what_to_do(page: Page) -> None:
    _, _, html = page.get("/")
    assert "<h1>1 of 2 cells needs somebody</h1>" in html
    cells = re.findall(r'href="/cells/(\w+)">\1<', html)
    assert cells == ["press_4", "press_2"]
    first, second = html.split('href="/cells/press_2"')
    assert "The arm has changed: fv1" in text_of(first)
    assert f"armident history --database sqlite:///{page.plant.cells['press_4'].folders[0] / 'history.sqlite'}" in first
    assert "1 recording could not be identified. Read the reasons; retry or ignore each." in text_of(second)


def test_a_cell_shows_its_parameters_with_standard_deviations_and_verdict(page: Page, made: Path) -> None:
    document = load_document(made / "press_2" / f"{NAME}.identification/identification.json", IdentificationDocument)
    _, _, html = page.get("/cells/press_2")
    for p in document.parameters:
        value, std = alike(p.value, p.std)
        row = f'<th scope="row">{p.name}</th><td class="n">{value}</td><td class="n">{std}</td>'
        assert row in html
    assert f"{document.verdict} " in text_of(html)
    assert f"{document.relative_error_pct:.1f} %" in html


def test_drift_is_a_line_for_each_parameter_and_marks_those_that_have_changed(page: Page) -> None:
    found = {}
    for cell in ("press_2", "press_4"):
        _, _, html = page.get(f"/cells/{cell}")
        found[cell] = dict(re.findall(r'aria-label="(\w+): [^"]* runs: 4(, changed)?"', html))
    assert not any(found["press_2"].values())
    assert {name for name, changed in found["press_4"].items() if changed} == {"fv1", "fc1"}
    assert set(found["press_2"]) == set(found["press_4"]) >= {"fv1", "fc1"}


def test_a_diagnosis_shows_its_findings_and_the_curves_of_its_report(page: Page, made: Path) -> None:
    _, _, html = page.get("/cells/press_4")
    document = load_document(made / "press_4" / f"{NAME}.diagnosis/diagnosis.json", DiagnosisDocument)
    assert document.findings
    for f in document.findings:
        words = f"{f.evidence['title']}, probability {f.probability}; error {f.gap_before:.2f} → {f.gap_after:.2f} %"
        assert escape(words, quote=False) in html
    pictures = re.findall(r'<img [^>]*alt="([^"]*)" src="([^"]*)"', html)
    kinds = {alt for alt, _ in pictures}
    assert {"residual of joint_1", "torque error by joint", "probabilities before and after, and the motion"} <= kinds
    for _, source in pictures:
        status, headers, svg = page.get(source)
        assert (status, headers["content-type"]) == (200, "image/svg+xml")
        assert "<svg" in svg
    assert page.get(f"/cells/press_4/results/{NAME}.diagnosis/figures/99")[0] == 404


def test_reports_and_documents_are_served_in_a_sandbox(page: Page, made: Path) -> None:
    for kind in ("identification", "diagnosis", "investigation"):
        for file in ("report.html", f"{kind}.json"):
            status, headers, text = page.get(f"/cells/press_4/results/{NAME}.{kind}/{file}")
            assert status == 200
            assert text == (made / "press_4" / f"{NAME}.{kind}" / file).read_text()
            assert headers["content-security-policy"] == REPORT_POLICY
            assert "sandbox" in REPORT_POLICY


class Tags(HTMLParser):
    """Collects what a strict policy forbids."""

    def __init__(self) -> None:
        super().__init__()
        self.inline: list[str] = []
        self.open = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open = tag if tag in ("script", "style") else ""
        self.inline += [f"{tag} {name}" for name, _ in attrs if name == "style" or name.startswith("on")]
        self.inline += [
            f"{tag} {v}" for n, v in attrs if n in ("src", "href", "action") and (v or "").startswith("http")
        ]

    def handle_data(self, data: str) -> None:
        if self.open and data.strip():
            self.inline.append(data)
        self.open = ""


@pytest.mark.parametrize("path", ["/", "/cells/press_4", "/cells/nothing"])
def test_a_page_has_no_inline_script_and_style_and_nothing_of_other_hosts(page: Page, path: str) -> None:
    _, headers, html = page.get(path)
    tags = Tags()
    tags.feed(html)
    assert tags.inline == []
    assert headers["content-security-policy"] == PAGE_POLICY
    assert "unsafe" not in PAGE_POLICY
    assert headers["x-content-type-options"] == "nosniff"
    assert '<noscript><meta http-equiv="refresh"' in html


def test_tables_lists_and_figures_have_names_and_headers(page: Page) -> None:
    _, _, html = page.get("/cells/press_4")
    assert len(re.findall("<table", html)) == len(re.findall("<thead", html)) > 0
    assert all(
        'scope="col"' in header for header in re.findall(r"<th\b[^>]*>", "".join(re.findall("<thead.*?</thead>", html)))
    )
    assert all("aria-label=" in svg for svg in re.findall(r"<svg[^>]*>", html))
    assert all('alt="' in image for image in re.findall(r"<img[^>]*>", html))
    assert '<a class="skip" href="#content">' in html
    for label in re.findall('aria-labelledby="([^"]+)"', html):
        assert html.count(f'id="{label}"') == 1


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "192.0.2.7", ""])
def test_a_request_for_another_host_is_refused(page: Page, host: str) -> None:
    assert page.get("/", host)[0] == 400


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:8484", "[::1]:8484", "LOCALHOST:1"])
def test_a_request_for_this_machine_is_answered(page: Page, host: str) -> None:
    assert page.get("/", host)[0] == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
@pytest.mark.parametrize("path", ["/", "/cells/press_4", f"/cells/press_4/results/{NAME}.diagnosis/report.html"])
def test_the_page_only_reads(page: Page, method: str, path: str) -> None:
    assert page.get(path, method=method)[0] == 405


def test_reading_changes_no_file(copied: Path, serving: Serve) -> None:
    def contents() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in sorted(copied.rglob("*")) if path.is_file()}

    before = contents()
    shown = serving(copied)
    shown.get("/cells/press_4")
    assert contents() == before


def test_a_ledger_is_read_in_a_folder_that_may_not_be_written_beside_a_worker(tmp_path: Path) -> None:
    """A worker that holds a write lock is not waited for, and does not wait."""
    ledger = Ledger(tmp_path / FILE, "worker")
    ledger.add(64 * "a", "first", [tmp_path / "first.mcap"])
    with ledger.announcement(64 * "a"):
        begin = time.monotonic()
        assert view_of(tmp_path / FILE, 10).summary.states["waiting"] == 1
        assert time.monotonic() - begin < 5.0
    tmp_path.chmod(0o555)
    try:
        ((entry, _),) = view_of(tmp_path / FILE, 10).last
        assert entry.name == "first"
    finally:
        tmp_path.chmod(0o755)


HOSTILE = '<img src=x onerror="alert(1)">'


def test_hostile_names_and_messages_are_only_text(copied: Path, serving: Serve) -> None:
    out = copied / "press_2"
    (out / f"{HOSTILE}.mcap").write_bytes(b"")
    (out / f"{HOSTILE}.diagnosis").mkdir()
    (out / f"{HOSTILE}.diagnosis" / "diagnosis.json").write_text("{")
    ledger = Ledger(out / FILE, "worker")
    ledger.add(64 * "c", HOSTILE, [out / "x.mcap"])
    assert ledger.claim(64 * "c")
    ledger.finish(64 * "c", "failed", None, HOSTILE)
    file = out / f"{NAME}.identification/identification.json"
    content = json.loads(file.read_text())
    reason = {"level": "unusable", "kind": "x", "joint": None, "message": HOSTILE, "next_step": HOSTILE}
    content |= {"verdict": "unusable", "reasons": [reason], "method": HOSTILE}
    content["parameters"][0]["name"] = HOSTILE
    file.write_text(json.dumps(content))
    shown = serving(copied)
    live = shown.plant.listener.live["press_2"]
    live.take_health(health(file=HOSTILE, temperature_joint_1_c=HOSTILE))
    live.take_status(json.dumps({"component": "worker", "state": HOSTILE, "capture": HOSTILE}).encode())
    for path in ("/", "/cells/press_2"):
        status, _, html = shown.get(path)
        assert status == 200
        assert "<img src=x" not in html
        assert "&lt;img src=x" in html


@pytest.mark.parametrize(
    "path",
    [
        "/cells/press_2/results/..%2F..%2F/report.html",
        "/cells/press_2/results/x.identification%2F..%2F..%2F..%2Fsecret.identification/report.html",
        "/cells/press_2/results/linked.identification/report.html",
        "/cells/press_2/results/filed.identification/report.html",
        f"/cells/press_2/results/{NAME}.identification/..%2F..%2Fhistory.sqlite",
        f"/cells/press_2/results/{NAME}.identification/model.yaml",
        f"/cells/press_2/results/{NAME}.identification/diagnosis.json",
        "/cells/press_2/results/history.sqlite/report.html",
        "/cells/..%2Fpress_2",
        "/assets/..%2Fcell.html",
        "/assets/cell.html",
    ],
)
def test_no_path_leaves_the_results(copied: Path, serving: Serve, path: str) -> None:
    secret = copied.parent / "secret.identification"
    secret.mkdir(exist_ok=True)
    (secret / "report.html").write_text("secret")
    (secret / "identification.json").write_text("{}")
    (copied / "press_2" / "linked.identification").symlink_to(secret)
    (copied / "press_2" / "filed.identification").mkdir()
    (copied / "press_2" / "filed.identification" / "report.html").symlink_to(secret / "report.html")
    status, _, text = serving(copied).get(path)
    assert status == 404
    assert "secret" not in text


def test_a_result_outside_is_not_linked(copied: Path, serving: Serve) -> None:
    with closing(sqlite3.connect(copied / "press_2" / FILE)) as db, db:
        db.execute("UPDATE experiments SET result = '/etc/passwd' WHERE state = 'done'")
    assert "passwd" not in serving(copied).get("/cells/press_2")[2]


def test_huge_documents_and_pipes_do_not_stall_the_page(copied: Path, serving: Serve) -> None:
    out = copied / "press_2"
    for name, size in (("huge", 100_000_000), ("later", 0)):
        (out / f"{name}.identification").mkdir()
        (out / f"{name}.identification" / "identification.json").write_bytes(b"")
        os.truncate(out / f"{name}.identification" / "identification.json", size)
    (out / "later.identification" / "identification.json").unlink()
    os.mkfifo(out / "later.identification" / "identification.json")
    (out / "huge.diagnosis").mkdir()
    (out / "huge.diagnosis" / "report.html").write_bytes(b"")
    os.truncate(out / "huge.diagnosis" / "report.html", 100_000_000)
    shown = serving(copied)
    assert "identification.json: 100 MB, more than a document has; it is not read" in text_of(shown.get("/")[2])
    assert shown.get("/cells/press_2")[0] == 200


@pytest.mark.parametrize(
    ("file", "said"),
    [
        (FILE, "worker.sqlite: damaged"),
        ("history.sqlite", "The history cannot be read: sqlite:///"),
        (f"{NAME}.identification/identification.json", "identification.json: line 1: not valid JSON"),
        (f"{NAME}.diagnosis/diagnosis.json", "diagnosis.json: line 1: not valid JSON"),
        (f"{NAME}.investigation/investigation.json", "investigation.json: line 1: not valid JSON"),
    ],
)
def test_what_is_damaged_is_said_in_its_place_and_the_rest_is_shown(
    copied: Path, serving: Serve, file: str, said: str
) -> None:
    (copied / "press_4" / file).write_bytes(b"[" + bytes(5000))
    shown = serving(copied)
    assert shown.get("/")[0] == 200
    status, _, html = shown.get("/cells/press_4")
    assert status == 200
    assert said in text_of(html)
    rest = {
        FILE: "1 done, 1 failed, 1 waiting",
        "history.sqlite": "runs: 4",
        f"{NAME}.identification/identification.json": "Parameters with standard deviations",
        f"{NAME}.diagnosis/diagnosis.json": "Torque error on held-out data",
        f"{NAME}.investigation/investigation.json": "probabilities before and after",
    }
    assert {name for name, part in rest.items() if part not in html} == {file}


def test_a_document_that_is_nested_too_deeply_is_said(copied: Path, serving: Serve) -> None:
    (copied / "press_2" / f"{NAME}.identification/identification.json").write_text("[" * 100_000)
    html = serving(copied).get("/")[2]
    assert "not valid JSON: nested too deeply" in html
    # The command works in any folder.
    assert f"armident identify {copied / 'press_2' / NAME}.mcap" in html


def test_a_ledger_of_another_version_and_a_wrong_session_are_said(copied: Path, serving: Serve) -> None:
    with closing(sqlite3.connect(copied / "press_2" / FILE)) as db, db:
        db.execute("PRAGMA user_version = 99")
    (copied / "weld_1.yaml").write_text("schema: armident/session/1\ncell: weld_1\nrobots: emps\n")
    html = serving(copied).get("/")[2]
    assert "ledger of version 99" in html
    assert "The session cannot be used" in html
    assert "press_4" in html


def test_messages_of_a_capture_are_heard_and_its_end_is_no_alarm(tmp_path: Path, serving: Serve) -> None:
    # The ports of a cell follow from its name.
    name = f"live_{os.getpid()}"
    plant.session(tmp_path, name)
    shown = serving(tmp_path)
    shown.plant.listener.check()
    cell, keys = shown.plant.cells[name], Keys(name, "emps")
    assert cell.session is not None
    roles: tuple[Role, ...] = ("capture", "worker", "viewer")
    signers = {role: signer_for(cell.session, role) for role in roles}

    def put(key: str, payload: bytes, role: Role | None = "capture") -> bytes | None:
        attachment = None if role is None else signers[role].attachment(key, payload)
        capture.put(key, payload, attachment=attachment)
        return attachment

    def until(state: str, *message: Any) -> CellView:
        """Publish a message again and again, as a capture does, until the cell has a state."""
        for _ in range(400):
            if message:
                put(*message)
            if (view := shown.plant.view(name)).state[1] == state:
                return view
            time.sleep(0.05)
        raise AssertionError(f"{view.state} instead of {state}")

    with open_session(cell.session, "capture") as capture:
        token = capture.liveliness().declare_token(keys.alive("worker"))
        until("waiting")
        until("recording", keys.health, health(rows=999, rows_in_gaps=1))
        huge = b'{"rows": ' + b"9" * 4000 + b"}"
        for garbage in (b"\xff", b"[]", b"{", b"[" * 100_000, bytes(1 << 20), b'{"rows": 1e999}', huge):
            for key in (keys.health, keys.status, keys.events):
                put(key, garbage)
        view = until("bus down", keys.health, health(rows=999, rows_in_gaps=1, buses_down=1))
        assert view.number("rows") == 999
        assert view.gap_share == pytest.approx(1e-3)
        assert view.problems[0].text == "1 of the buses of the capture is down."
        assert "bus down" in text_of(shown.get("/")[2])
        late = CellView(cell, view.files, None, view.live, view.now + 2 * SILENT_S)
        assert late.state[1].startswith("not heard for")
        assert late.level == "act"
        view = until("recording", keys.health, health(disk_free_bytes=1e9, sync=1002))
        assert view.problems[0].text == "Only 1.0 GB are free"
        until("recording", keys.health, health(sync=1003))
        # Forged, of another role, and repeated: none counts.
        down = health(sync=1003, buses_down=1)
        old = put(keys.health, down)
        until("bus down")
        until("recording", keys.health, health(sync=1004))
        put(keys.health, down, None)
        put(keys.health, down, "viewer")
        put(keys.health, down, "worker")
        capture.put(keys.health, down, attachment=old)
        put(keys.status, json.dumps({"component": "worker", "state": "identifying"}).encode(), "worker")
        for _ in range(400):
            if "worker" in (view := shown.plant.view(name)).live.status:
                break
            time.sleep(0.05)
        assert view.live.status["worker"].content["state"] == "identifying"
        assert view.state[1] == "recording"
        end = {"capture": "emps-1", "blocks": 1, "counters": {}, "gaps": [], "marks": [], "paths": []}
        assert until("waiting", keys.events, encode_event("experiment_end", end)).level != "act"
        token.undeclare()


def test_a_worker_that_is_missing_is_named_with_the_command(copied: Path, serving: Serve) -> None:
    shown = serving(copied)
    with closing(sqlite3.connect(copied / "press_2" / FILE)) as db, db:
        db.execute("UPDATE experiments SET added = added - 1000")
    shown.read()
    view = shown.plant.view("press_2")
    view.live.began -= 60.0
    (problem,) = [each for each in shown.plant.view("press_2").problems if each.level == "act"]
    assert problem.text == "1 recording waits and no worker runs"
    assert problem.command == f"armident worker --config {copied / 'press_2.yaml'}"


def test_a_hundred_cells_are_shown(tmp_path: Path, made: Path, serving: Serve) -> None:
    for k in range(100):
        plant.session(tmp_path, f"cell_{k:02d}")
        (tmp_path / f"cell_{k:02d}" / f"{NAME}.identification").symlink_to(made / "press_2" / f"{NAME}.identification")
    _, _, html = serving(tmp_path).get("/")
    assert len(re.findall(r'<th scope="row"><a href="/cells/cell_\d\d">', html)) == 100


@pytest.mark.parametrize(("seconds", "said"), [(-1, "0 s"), (59, "59 s"), (61, "1 min"), (7300, "2 h"), (3e5, "3 d")])
def test_a_time_span_in_words(seconds: float, said: str) -> None:
    assert words(seconds) == said
