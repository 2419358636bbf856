"""Build of the compiled loops of `armident.drivers.compiled`; everything else of the build is in pyproject.toml."""

import subprocess
import sys
import warnings
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

HERE = Path(__file__).resolve().parent
COMPILE = "compile-loops"
"""Argument with which this file compiles the loops instead of setting up the distribution."""


class BuildKernels(build_ext):
    """Compiles the loops with numba ahead of time, so that an installation needs no compiler."""

    def run(self) -> None:
        """Build nothing for a checkout: its loops change, and numba compiles them when they are first used."""
        if not self.editable_mode:
            super().run()

    def build_extension(self, ext: Extension) -> None:
        """Build the extension module, or warn that it could not be built."""
        target = Path(self.get_ext_fullpath(ext.name)).absolute()
        # In a process of its own: numba's compiler runs a set-up, which would end this one.
        command = [sys.executable, str(HERE / "setup.py"), COMPILE, str(target)]
        done = subprocess.run(command, cwd=HERE / "src", capture_output=True, text=True, check=False)
        if done.returncode != 0 or not target.exists():
            errors = [line for line in done.stderr.splitlines() if "Error: " in line]
            reason = (errors or [f"exit code {done.returncode}"])[-1]
            warnings.warn(f"the wheel has no compiled loops, and cannot capture without numba: {reason}", stacklevel=1)

    def get_outputs(self) -> list[str]:
        """Return the files that were built."""
        return [name for name in super().get_outputs() if Path(name).exists()]


def compile_loops(target: Path) -> None:
    """Compile all loops into an extension module, with their signatures from examples of their arguments."""
    sys.path.insert(0, str(HERE / "src"))
    import numpy as np
    from numba import int32, int64, typeof, types
    from numba.core.compiler import Flags
    from numba.pycc import CC, compiler

    from armident.daq.matching import pdo_matching
    from armident.daq.matching.state import StreamShape, new_state, output_buffers
    from armident.drivers.can.frames import frames
    from armident.drivers.canopen import sync_loop
    from armident.drivers.compiled import MODE, kernel_name

    if MODE != "by numba":
        raise RuntimeError(f"the loops are compiled {MODE}")

    def flags() -> Flags:
        """Return numba's options with the interpreter's lock released: the SYNC loop runs beside other threads."""
        made = Flags()
        made.release_gil, made.error_model = True, "python"
        return made

    compiler.Flags = flags
    state = new_state([StreamShape(1, 1, 8, 8)], [8], [8], [8], [0], *np.full((2, 1, 1), -1, np.int64))
    received = frames(2)
    columns = [received[field] for field in ("can_id", "length", "t_ns")] + [received["data"].view("<u8")]
    batch = (int64, *map(typeof, columns), int64, int64, int64, int64, int64, typeof(state))
    samples = typeof(output_buffers(state, 1))
    row, table = types.Array(int64, 1, "C"), types.Array(int32, 2, "C")
    loop = (row, int64, int64, row, row, row, row, row, int64, table, row, row, table, int64, row)
    ahead = CC(target.name.partition(".")[0], source_module=pdo_matching)
    for function, signature in (
        (pdo_matching.count_sync, int64(*batch)),
        (pdo_matching.match, types.none(*batch, samples)),
        (pdo_matching.finish, types.none(int64, typeof(state), samples)),
        (sync_loop._run, types.none(*loop)),
    ):
        ahead.export(kernel_name(function), signature)(function.py_func)
    target.parent.mkdir(parents=True, exist_ok=True)
    ahead.output_dir, ahead.output_file = str(target.parent), target.name
    ahead.compile()


if sys.argv[1:2] == [COMPILE]:
    compile_loops(Path(sys.argv[2]))
else:
    setup(ext_modules=[Extension("armident._kernels", sources=[])], cmdclass={"build_ext": BuildKernels})
