"""Extras: a missing one is one line with the command that installs it."""

import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

from armident.configs import ConfigError
from armident.extras import EXTRAS, needed_extra, require

DISTRIBUTIONS = {
    "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    "markupsafe": "jinja2",
    "mcap_protobuf": "mcap-protobuf-support",
    "pinocchio": "pin",
    "rerun": "rerun-sdk",
}
"""Distributions whose name is another than that of the module."""


def run_without(hidden: set[str], program: str, cwd: Path) -> "subprocess.CompletedProcess[str]":
    hide = f"import sys\nsys.modules.update(dict.fromkeys({sorted(hidden)!r}))\n"
    command = [sys.executable, "-c", hide + program]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120, check=False)


def test_the_table_lists_modules_of_the_distributions_of_each_extra() -> None:
    required = importlib.metadata.requires("armident") or []
    of_extra: dict[str, set[str]] = {extra: set() for extra in EXTRAS}
    base = set()
    for line in required:
        name = line.replace("[", " ").replace(">", " ").replace("<", " ").replace(";", " ").split()[0]
        extra = line.partition('extra == "')[2].rstrip('"')
        if extra in of_extra:
            of_extra[extra].add(name)
        elif not extra:
            base.add(name)
    for extra, modules in EXTRAS.items():
        assert {DISTRIBUTIONS.get(module, module) for module in modules} == of_extra[extra], extra
        assert not of_extra[extra] & base


@pytest.mark.slow
def test_a_command_or_a_name_without_its_extra_names_the_installation(tmp_path: Path) -> None:
    commands = {
        ("identify", "run.mcap"): "identify",
        ("check", "run.mcap"): "identify",
        ("history",): "identify",
        ("robot", "--to-file", "run.mcap"): "virtual",
        ("demo",): "identify,virtual",
    }
    names = {
        "compare": "identify",
        "identify('run.mcap')": "identify",
        "simulate_recording('emps', 'emps_excitation')": "virtual",
    }
    program = (
        "import armident\nfrom armident.daq.cli import main\n"
        f"for words in {[list(words) for words in commands]!r}:\n"
        "    try:\n        main(words)\n    except SystemExit as end:\n        print(end.code)\n"
        f"for name in {list(names)!r}:\n"
        "    try:\n        eval('armident.' + name)\n    except ImportError as error:\n        print(error)\n"
    )
    done = run_without({module for modules in EXTRAS.values() for module in modules}, program, tmp_path)
    needs = "needs extra packages: pip install"
    assert done.stderr.splitlines() == [
        f"armident: armident {words[0]} {needs} 'armident[{extra}]'" for words, extra in commands.items()
    ]
    assert done.stdout.splitlines() == ["2"] * len(commands) + [
        f"armident.{name.partition('(')[0]} {needs} 'armident[{extra}]'" for name, extra in names.items()
    ]


def test_a_missing_module_of_no_extra_is_not_taken_for_one() -> None:
    assert needed_extra(ImportError("no name")) is None
    assert needed_extra(ModuleNotFoundError("x", name="somebodys_plugin")) is None
    assert needed_extra(ModuleNotFoundError("x", name="scipy.linalg"), "armident.virtual_robot.cli") == "virtual"


def test_extras_that_are_there_are_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    require("this", *EXTRAS)
    monkeypatch.setitem(EXTRAS, "fleet", ("no_such_module",))
    with pytest.raises(ConfigError, match=r"^this needs extra packages: pip install 'armident\[fleet\]'$"):
        require("this", "identify", "fleet")


@pytest.mark.slow
def test_the_packages_of_a_capture_machine_import_no_module_of_an_extra(tmp_path: Path) -> None:
    program = (
        "import armident.configs, armident.daq, armident.drivers, importlib, pkgutil\n"
        "for package in (armident.configs, armident.daq, armident.drivers):\n"
        "    for found in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        try:\n"
        "            found.name.endswith('__main__') or importlib.import_module(found.name)\n"
        "        except ImportError as error:\n"
        "            print(found.name, error.name)\n"
    )
    done = run_without({module for modules in EXTRAS.values() for module in modules}, program, tmp_path)
    assert done.returncode == 0, done.stderr
    assert not done.stdout
