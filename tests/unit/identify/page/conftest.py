"""The plant of these tests, and a page that is served as the command serves it."""

import http.client
import json
import shutil
import socket
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send

from armident.identify.monitoring.worker.ledger import FILE
from armident.identify.page.cells import cells_in
from armident.identify.page.plant import Plant
from armident.identify.page.serve import LOOPBACK
from armident.identify.page.site import site
from tests.fixtures import plant


class Page:
    """A served page, and its plant."""

    def __init__(self, plant: Plant, port: int, paths: list[str]) -> None:
        self.plant, self.port, self._paths = plant, port, paths

    def requests(self, path: str) -> int:
        """Number of requests for a path so far."""
        return self._paths.count(path)

    def get(self, path: str, host: str | None = None, method: str = "GET") -> tuple[int, dict[str, str], str]:
        """Status, headers and text of an answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request(method, path, headers={} if host is None else {"Host": host})
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, dict(answer.headers), text

    def read(self) -> None:
        """Read folders and histories now."""
        self.plant.read_files()
        self.plant.read_histories()


Serve = Callable[..., Page]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cell without a change, and one that has changed and was diagnosed."""
    folder = tmp_path_factory.mktemp("plant")
    for cell in ("press_2", "press_4"):
        plant.session(folder, cell)
        plant.results(folder, cell)
        plant.weekly(folder, cell, changed=cell == "press_4")
    plant.diagnosed(folder, "press_4")
    return folder


@pytest.fixture
def copied(made: Path, tmp_path: Path) -> Path:
    """A copy of the plant that a test may damage."""
    copy = Path(shutil.copytree(made, tmp_path / "plant", symlinks=True))
    for file in copy.glob("*.yaml"):
        file.write_text(file.read_text().replace(str(made), str(copy)))
    with closing(sqlite3.connect(copy / "press_2" / FILE)) as db, db:
        db.execute(
            "UPDATE experiments SET paths = replace(paths, ?, ?), result = replace(result, ?, ?)",
            2 * (str(made), str(copy)),
        )
    return copy


@pytest.fixture(scope="session")
def serving() -> Iterator[Serve]:
    """Serves the sessions of a folder, whose results are beside them."""
    with ExitStack() as stack:

        def serve(folder: Path) -> Page:
            shown = Plant(cells_in([folder], folder, None))
            listening = socket.create_server(("127.0.0.1", 0))
            application, paths = site(shown, LOOPBACK), list[str]()

            async def counted(scope: Scope, receive: Receive, send: Send) -> None:
                paths.append(scope.get("path", ""))
                await application(scope, receive, send)

            options = uvicorn.Config(counted, log_config=None, access_log=False)
            server = uvicorn.Server(options)
            thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
            thread.start()

            def end() -> None:
                server.should_exit = True
                thread.join()
                shown.listener.close()

            stack.callback(end)
            page = Page(shown, listening.getsockname()[1], paths)
            page.read()
            while not server.started:
                time.sleep(0.01)
            return page

        yield serve


@pytest.fixture(scope="session")
def page(made: Path, serving: Serve) -> Page:
    """The page of the plant, which no test changes."""
    return serving(made)


def health(**more: object) -> bytes:
    """A health message of a capture that runs well."""
    content = {
        "file": "emps-20261129T190000-000Z.mcap", "rows": 1000, "rows_in_gaps": 0, "rows_not_written": 0, "sync": 1000,
        "frames_per_s": 3000.0, "buses_down": 0, "disk_free_bytes": 300_000_000_000, "clock_synchronised": 1,
    }  # fmt: skip
    return json.dumps(content | more).encode()
