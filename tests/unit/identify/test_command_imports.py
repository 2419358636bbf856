"""A command imports no large library that it does not use: half a second of CPU each, before the work begins."""

import subprocess
import sys

import pytest

HEAVY = {
    "scipy.stats": "scipy.special has the same distributions",
    "scipy.signal": "imports scipy.stats; armident.identify.signals.recursive has the filters",
    "scipy.interpolate": "only a gap of a recording needs it",
    "scipy.ndimage": "only the simulation of a diagnosis needs it",
    "matplotlib": "only a report needs it",
    "jinja2": "only a report needs it",
    "sqlalchemy": "only the history needs it",
    "pinocchio": "only the virtual robot and the export need it",
    "numba.core.inline_closurecall": "only the compiler needs it",
}
"""Modules, and why the commands do without."""


def _imported(script: str) -> set[str]:
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\n{script}\nprint(*sys.modules)"], capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "module",
    [
        "armident.daq.api",
        "armident.identify.setup.check",
        "armident.identify.api.setup_api",
        "armident.identify.api.identification_api",
        "armident.identify.api.diagnosis_api",
        "armident.identify.cli.result_commands",
    ],
)
def test_a_command_imports_no_library_that_it_does_not_use(module: str) -> None:
    assert not {name: HEAVY[name] for name in _imported(f"import {module}") & set(HEAVY)}


def test_the_check_needs_nothing_of_the_identification() -> None:
    names = _imported("import armident.identify.api.setup_api")
    assert not {name for name in names if name.startswith(("armident.identify.diagnosis", "clarabel"))}
    assert "armident.identify.identification.pipeline" not in names


def test_kernels_run_without_the_registries_of_the_compiler() -> None:
    script = (
        "import numpy\nfrom armident.identify.signals.recursive import recursive_filter\n"
        "assert recursive_filter([1.0], [1.0, -1.0], numpy.ones(3)).tolist() == [1.0, 2.0, 3.0]"
    )
    assert "numba.core.inline_closurecall" not in _imported(script)
