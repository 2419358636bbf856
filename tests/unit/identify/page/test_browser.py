"""The page in Chromium: it draws in light and dark, breaks no policy, and refreshes itself."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from tests.fixtures import plant
from tests.unit.identify.page.conftest import Page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium"),
]
OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--disable-background-networking",
    "--disable-component-update", "--no-first-run", "--hide-scrollbars", "--enable-logging=stderr",
)  # fmt: skip


def browse(page: Page, path: str, profile: Path, *options: str) -> "subprocess.CompletedProcess[str]":
    assert CHROMIUM is not None
    command = [CHROMIUM, *OPTIONS, f"--user-data-dir={profile}", *options, f"http://127.0.0.1:{page.port}{path}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)


@pytest.mark.parametrize(
    "path", ["/", "/cells/press_4", f"/cells/press_4/results/{plant.name_of(5)}.diagnosis/report.html"]
)
def test_a_browser_draws_the_page_in_light_and_dark_and_refuses_nothing(page: Page, path: str, tmp_path: Path) -> None:
    brightness = {}
    for theme, option in (("light", "--window-size=1280,900"), ("dark", "--force-dark-mode")):
        file = tmp_path / f"{theme}.png"
        said = browse(page, path, tmp_path / theme, option, f"--screenshot={file}").stderr
        assert "Content Security Policy" not in said
        assert "Uncaught" not in said
        image = imread(file)[..., :3]
        brightness[theme] = float(np.median(image))
        # Something is drawn on the ground.
        assert float(np.std(image)) > 0.02
    assert brightness["light"] > 0.9
    # Reports are white in both.
    assert (brightness["dark"] < 0.2) == ("results" not in path)


def test_the_page_refreshes_its_live_parts_by_itself(page: Page, tmp_path: Path) -> None:
    """20 s of virtual time hold three refreshes, every 5 s."""
    before = page.requests("/")
    done = browse(page, "/", tmp_path / "profile", "--virtual-time-budget=20000", "--dump-dom")
    assert page.requests("/") - before >= 3
    assert 'id="stale" role="alert" hidden' in done.stdout
    assert "press_4" in done.stdout
