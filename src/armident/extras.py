"""Optional parts of the distribution, and the command that installs one that is missing."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

EXTRAS: dict[str, tuple[str, ...]] = {
    "identify": (
        "clarabel", "coal", "filterpy", "jinja2", "markupsafe", "matplotlib", "scipy", "sqlalchemy",
        "threadpoolctl",
    ),
    "virtual": ("clarabel", "pinocchio", "scipy"),
    "fleet": ("distributed",),
    "objects": ("fsspec", "s3fs"),
    "opcua": ("asyncua",),
    "page": ("starlette", "uvicorn"),
    "parquet": ("pyarrow",),
    "postgresql": ("psycopg",),
    "viewer": ("foxglove_schemas_protobuf", "mcap_protobuf", "rerun"),
}  # fmt: skip
"""Modules that each extra brings; the base has none of them."""


def needed_extra(error: ImportError, package: str = "") -> str | None:
    """Return the extra that brings the module missing in ``error``, if any; ``virtual_robot`` needs ``virtual``."""
    module = (error.name or "").partition(".")[0]
    found = [extra for extra, modules in EXTRAS.items() if module in modules]
    if "virtual" in found and "virtual_robot" in package:
        return "virtual"
    return found[0] if found else None


def missing_library(error: ImportError) -> str | None:
    """Return the line that names the library of the system that an import lacks, and its package; else ``None``."""
    name, found, _ = str(error).partition(": cannot open shared object file")
    package = name.replace(".so.", "").lower()
    return f"{name} is missing on this system (Debian, Ubuntu: apt-get install {package})" if found else None


def install_line(what: str, extras: Iterable[str]) -> str:
    """Return the line that names the missing extras of ``what`` and the command that installs them."""
    return f"{what} needs extra packages: pip install 'armident[{','.join(extras)}]'"


@contextmanager
def named_extra(what: str, package: str) -> Iterator[None]:
    """Give the error of an import of ``what`` that lacks an extra the command that installs it."""
    try:
        yield
    except ImportError as error:
        extra = needed_extra(error, package)
        if extra is None:
            raise
        raise ImportError(install_line(what, [extra]), name=error.name) from error


def require(what: str, *extras: str) -> None:
    """Raise ConfigError, with the install command, if modules of extras of ``what`` cannot be found; import nothing."""
    from importlib.util import find_spec

    from armident.configs.errors import ConfigError

    missing = [extra for extra in extras if any(find_spec(module) is None for module in EXTRAS[extra])]
    if missing:
        raise ConfigError(install_line(what, missing))
