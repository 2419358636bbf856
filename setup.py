"""Build of the kernels' machine code into the wheel; everything else of the build is in pyproject.toml."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.build_py import build_py

PROJECT = tomllib.loads(Path(__file__).with_name("pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


class BuildKernels(build_py):
    """Compiles the kernels of the modules that were built; a checkout compiles its own (`make install`)."""

    def run(self) -> None:
        """Build the modules, then their kernels."""
        super().run()
        if not self.editable_mode:
            # The packages of an isolated build are on the path of the environment.
            path = [str(Path(self.build_lib).absolute()), *filter(None, [os.environ.get("PYTHONPATH")])]
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path)}
            # -P: the modules are those of the build, not those of the working directory
            subprocess.run([sys.executable, "-P", "-m", "armident.compiled"], env=environment, check=True)


class Binary(Distribution):
    """Makes the wheel one of this platform and version of Python."""

    def has_ext_modules(self) -> bool:
        """Say that machine code is in it."""
        return True


setup(
    cmdclass={"build_py": BuildKernels},
    distclass=Binary,
    # the kernels are compiled by the numba of the installation, and their modules import these
    setup_requires=[*PROJECT["dependencies"], *EXTRAS["identify"], *EXTRAS["virtual"]],
)
