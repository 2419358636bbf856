"""Compilation before use: machine code is never stale, and nothing compiles at run time."""

import importlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

import armident.compiled
from armident.configs import load_robot, load_session
from armident.daq.guard.monitor import MotionMonitor
from armident.daq.guard.motion_limits import motion_limits_of
from armident.daq.matching.assembler import Assembler, TpdoStream
from armident.daq.recording import write_recording
from armident.drivers.can.frames import frames
from armident.drivers.canopen import sync_loop
from tests.fixtures import arms
from tests.fixtures.undeclared import UNDECLARED

CALLER = """
from armident.compiled import compiled
from callee import twice

@compiled("f8")
def kernel(x):
    return twice(x) + 1.0
"""
CALLEE = """
from armident.compiled import compiled
from constants import FACTOR

@compiled()
def twice(x):
    return FACTOR * x
"""

WATCH = """
import sys
from numba.core import event
from armident.daq.cli import main

class Listener(event.Listener):
    def on_start(self, event):
        function = event.data["dispatcher"].py_func
        if function.__module__.startswith("armident"):
            print(f"compiled: {function.__module__}.{function.__qualname__}{event.data['args']}", file=sys.stderr)

    def on_end(self, event):
        pass

event.register("numba:compile", Listener())
"""
COMMANDS = """
for command in sys.argv[1:]:
    try:
        main(command.split())
    except SystemExit as end:
        assert end.code in (None, 0), (command, end.code)
"""


class Package:
    """Three modules of a program with a kernel, and the folder of its machine code."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.code = folder, folder / "code"
        monkeypatch.syspath_prepend(str(folder))
        monkeypatch.setattr(armident.compiled, "_folders", lambda: (self.code,))
        monkeypatch.setattr(armident.compiled, "_KERNELS", [])
        for name, text in (("caller", CALLER), ("callee", CALLEE), ("constants", "FACTOR = 2.0\n")):
            self.write(name, text)

    def write(self, name: str, text: str) -> None:
        (self.folder / f"{name}.py").write_text(text)

    def run(self) -> tuple[float, bool]:
        """Import the modules anew, and call the kernel: its result, and whether its machine code was there."""
        for name in ("caller", "callee", "constants"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        sys.dont_write_bytecode, before = True, sys.dont_write_bytecode
        try:
            kernel: Any = importlib.import_module("caller").kernel
        finally:
            sys.dont_write_bytecode = before
        return kernel(3.0), sum(kernel.stats.cache_hits.values()) == 1


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Package:
    return Package(tmp_path, monkeypatch)


def test_machine_code_is_found_again(package: Package) -> None:
    assert package.run() == (7.0, False)
    assert package.run() == (7.0, True)
    assert len(list(package.code.iterdir())) == 1


def test_an_edit_of_a_callee_in_another_module_is_seen(package: Package) -> None:
    package.run()
    times = os.stat(package.folder / "callee.py")
    package.write("callee", CALLEE.replace("FACTOR * x", "FACTOR - x"))
    # not even with the size and the time of the file before
    os.utime(package.folder / "callee.py", ns=(times.st_atime_ns, times.st_mtime_ns))
    assert package.run() == (0.0, False)
    package.write("callee", CALLEE)
    assert package.run() == (7.0, True)


def test_an_edit_of_a_constant_in_another_module_is_seen(package: Package) -> None:
    package.run()
    package.write("constants", "FACTOR = 5.0\n")
    assert package.run() == (16.0, False)


def test_options_of_a_callee_are_seen(package: Package) -> None:
    package.run()
    package.write("callee", CALLEE.replace("@compiled()", "@compiled(fastmath=True)"))
    assert package.run() == (7.0, False)


def test_comments_docstrings_and_times_of_files_change_nothing(package: Package) -> None:
    package.run()
    package.write("callee", "# A comment.\n" + CALLEE.replace("    return", '    """Twice."""\n    return'))
    package.write("caller", CALLER + "# the end\n")
    assert package.run() == (7.0, True)


def test_a_folder_that_cannot_be_written_is_read(package: Package, monkeypatch: pytest.MonkeyPatch) -> None:
    package.run()
    monkeypatch.setattr(Path, "mkdir", lambda *_, **__: pytest.fail("a folder was made"))
    assert package.run() == (7.0, True)


def test_without_a_folder_that_can_be_written_a_kernel_runs(package: Package) -> None:
    package.code.write_text("a file in the place of the folder")
    assert package.run() == (7.0, False)


def test_a_function_that_only_kernels_call_is_refused_from_python(package: Package) -> None:
    package.run()
    with pytest.raises(TypeError, match="only kernels call this function"):
        importlib.import_module("callee").twice(3.0)


@pytest.mark.slow
def test_every_process_gives_machine_code_the_same_name() -> None:
    modules = ("armident.identify.robot.kernels", "armident.daq.matching.pdo_matching")
    program = (
        "import armident.compiled as c, importlib, sys\n"
        "list(map(importlib.import_module, sys.argv[1:]))\n"
        "for kernel, _ in c._KERNELS:\n"
        "    kernel._cache.names((), c.cpu_target.target_context)\n"
        "    if kernel.py_func.__module__ in sys.argv[1:]: print(kernel._cache.meaning)\n"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", program, *modules],
            env={**os.environ, "PYTHONHASHSEED": str(seed)},
            capture_output=True,
            check=True,
            timeout=120,
        ).stdout
        for seed in (1, 2)
    }
    assert len(found) == 1
    assert b" at 0x" not in found.pop()


def test_kernels_of_a_bus_are_declared() -> None:
    """Compile nothing undeclared in the calls of a capture on every bus; the fixture fails the test otherwise."""
    for fd in (False, True):
        for buses in (1, 2):
            streams = [TpdoStream("samples", 1, (0x181, 0x182), 8), TpdoStream("demand", 5, (0x281, 0x282), 4)]
            assembler = Assembler(streams, ("a", "b"), 1_000_000, bus_of=(0, buses - 1))
            assembler.warm_up(frames(2, fd=fd))
            assembler.push(frames(1, fd=fd), None)
            assembler.finish(0)
    state, late = np.zeros(sync_loop.STATE_SIZE, np.int64), np.zeros(sync_loop.BINS, np.int64)
    one, other, third, times = np.zeros((4, 1), np.int64)
    sync_loop.Loop(one, 1_000_000, 240, state, late, other, third, times)
    session = load_session("tx40_cell.yaml")
    robot = load_robot(session.robot)
    for count in (0, 1, 2):
        MotionMonitor(session, robot, motion_limits_of(robot)).check(frames(count), 0)


def test_a_kernel_that_compiles_at_run_time_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(armident.compiled, "_folders", lambda: (tmp_path,))
    monkeypatch.setattr(armident.compiled, "_KERNELS", [])

    def kernel(x: float) -> float:
        return 2.0 * x

    kernel.__module__ = "armident.daq"
    declared: Any = armident.compiled.compiled("f8")(kernel)
    declared.compile((numba.f8,))
    assert UNDECLARED.taken() == []
    assert declared(np.float32(3.0)) == 6.0
    (found,) = UNDECLARED.taken()
    assert found.startswith("armident.daq.")
    assert found.endswith("kernel(float32,)")


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(1200)
def test_nothing_compiles_at_run_time(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "armident.compiled"], check=True, timeout=900)
    for robot, motion in (("emps", "emps_1"), ("tx40", "tx40_excitation")):
        write_recording(arms.recording(robot, motion, 1, period=arms.FAST), tmp_path / f"{robot}.mcap")
    commands = (
        "robot --config emps.yaml --to-file simulated.mcap",
        "identify emps.mcap --out emps",
        "identify tx40.mcap --out tx40",
        "diagnose emps.mcap --out diagnosis",
        "trajectory --config emps.yaml --out trajectory.yaml --evaluations 20",
        "watch emps.mcap --reference emps/identification.json",
    )
    words = [sys.executable, "-c", WATCH + COMMANDS, *commands]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stderr.splitlines() if line.startswith("compiled: ")] == []
