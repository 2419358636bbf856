"""Commands and Python of the documentation run as a reader would run them; the site builds without warnings.

Every block of a page runs in one temporary folder, in order: first those with commands, then those in Python as one
programme. A command may exit with 4 ("changed" or "unexplained"). Comments in a page are invisible to the reader:

``<!-- run before: COMMANDS -->``
    Commands that make the files that the reader already has.
``<!-- not run here: REASON -->``
    The next block does not run in this test.
"""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
GENERATED = "docs/reference"
PAGES = sorted(
    page
    for path in (*(REPOSITORY / "docs").rglob("*.md"), *(REPOSITORY / "configs" / "examples").glob("*/README.md"))
    if not str(page := path.relative_to(REPOSITORY)).startswith(GENERATED)
)
"""Pages with blocks; the others consist of directives."""
BLOCK = re.compile(
    r"^(?P<indent> *)<!-- (?P<comment>run before|not run here):(?P<text>.*?)-->"
    r"|^(?P<margin> *)```(?P<language>[\w{}]*)(?: \S+)?\n(?P<code>.*?)^ *```$",
    re.MULTILINE | re.DOTALL,
)
LANGUAGES = {"sh", "python", "sql", "yaml", "toml", "json", "text", "ini", "{toctree}", "{literalinclude}"}
PAGE_S = 900.0
"""Time limit of a page, s: ten times what the slowest one takes on an idle machine."""
TRAP = "trap 'code=$?; [ $code -eq 4 ] || { echo \"exit code $code: $BASH_COMMAND\" >&2; exit $code; }' ERR\n"


@dataclass(frozen=True)
class Page:
    """Commands and Python of a page, in their order, and the reasons for which blocks do not run.

    ``commands``, ``python``: code of the blocks; ``reasons``: reason of each block that does not run.
    """

    commands: tuple[str, ...]
    python: tuple[str, ...]
    reasons: tuple[str, ...]
    languages: tuple[str, ...]


def read_page(path: Path) -> Page:
    """Read the blocks of a page."""
    commands, python, reasons, languages = [], [], [], []
    skipped = False
    for match in BLOCK.finditer(path.read_text(encoding="utf-8")):
        if match["comment"] == "run before":
            commands.append(match["text"])
        elif match["comment"] == "not run here":
            reasons.append(match["text"].strip())
            skipped = True
        else:
            languages.append(match["language"])
            code = "\n".join(line.removeprefix(match["margin"]) for line in match["code"].splitlines())
            if not skipped and match["language"] == "sh":
                commands.append(code)
            elif not skipped and match["language"] == "python":
                python.append(code)
            skipped = False
    return Page(tuple(commands), tuple(python), tuple(reasons), tuple(languages))


RUNNING = [page for page in PAGES if (read := read_page(REPOSITORY / page)).commands or read.python]


@pytest.mark.nightly
@pytest.mark.timeout(PAGE_S + 20)
@pytest.mark.parametrize("page", RUNNING, ids=str)
def test_the_blocks_of_a_page_run(page: Path, tmp_path: Path) -> None:
    blocks = read_page(REPOSITORY / page)
    if page.name == "README.md":  # of an example, whose folder was copied
        shutil.copytree(REPOSITORY / page.parent, tmp_path, dirs_exist_ok=True)
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "REPOSITORY": str(REPOSITORY),
    }
    scripts = [
        ["bash", "-c", TRAP + "\n".join((*blocks.commands, "true"))],
        [sys.executable, "-c", "\n\n".join(blocks.python)],
    ]
    for script in scripts:
        done = subprocess.run(
            script, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=PAGE_S
        )
        assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"


def test_most_pages_with_commands_run() -> None:
    assert len(RUNNING) >= 8
    assert Path("docs/tutorial.md") in RUNNING
    assert Path("docs/your-arm.md") in RUNNING


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_every_block_has_a_language_and_every_exception_a_reason(page: Path) -> None:
    blocks = read_page(REPOSITORY / page)
    assert set(blocks.languages) <= LANGUAGES
    assert all(len(reason.split()) >= 4 for reason in blocks.reasons)


@pytest.mark.nightly
@pytest.mark.timeout(PAGE_S + 20)
def test_the_site_builds_without_warnings(tmp_path: Path) -> None:
    pytest.importorskip("sphinx")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html", "docs", str(tmp_path)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=PAGE_S)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "armident identify" in text
    assert "relative_error_pct_by_joint" in (tmp_path / "reference" / "files.html").read_text(encoding="utf-8")
