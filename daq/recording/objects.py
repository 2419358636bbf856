"""Recordings in an object store (S3 and what else fsspec reads): their URLs, opened and listed like files."""

import glob
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PosixPath
from typing import Any, BinaryIO, cast

from armident.configs import ArmidentError, ConfigError
from armident.extras import install_line, needed_extra

_URL = re.compile(r"([a-z][a-z0-9+.-]+):/+(?=[^/])")
"""Begin of a URL; a path (`pathlib`) has one of its two slashes only."""


_OPTIONS: dict[str, dict[str, Any]] = {"s3": {"config_kwargs": {"retries": {"max_attempts": 1}}}}
"""Options of file systems: s3fs tries again itself, and twenty-five attempts take minutes without a network."""


class ObjectUrl(PosixPath):
    """URL of an object, such as ``s3://bucket/cell/run.mcap``, where a path is expected: name and stem are its own."""

    def __str__(self) -> str:
        return _URL.sub(r"\1://", super().__str__(), count=1)


def located(path: Path | str) -> Path:
    """Return a path, or the URL of an object if it begins like one; ``file://`` is a path."""
    text = str(path)
    if text.startswith("file:/"):
        return Path(re.sub("^file:/+", "/", text))
    return ObjectUrl(text) if _URL.match(text) else Path(path)


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open a file, or an object of which only what is read is fetched; ConfigError if missing or replaced."""
    if not isinstance(path, ObjectUrl):
        with path.open("rb") as file:
            yield file
        return
    with _explained(path):
        files, name = _file_system(path)
        with files.open(name, "rb", cache_type="none") as remote:
            yield cast(BinaryIO, remote)


def matching(pattern: str) -> list[Path]:
    """Return the files or objects of a pattern in order; ConfigError if an object store cannot be listed."""
    url = located(pattern)
    if not isinstance(url, ObjectUrl):
        return [Path(name).resolve() for name in sorted(glob.glob(str(url), recursive=True))]
    with _explained(url):
        files, name = _file_system(url)
        return [ObjectUrl(files.unstrip_protocol(each)) for each in sorted(files.glob(name))]


def _file_system(url: ObjectUrl) -> tuple[Any, str]:
    """Return the file system of fsspec for a URL, and the name of the object in it."""
    from fsspec.core import url_to_fs

    options = _OPTIONS.get(str(url).partition(":")[0], {})
    # A listing that was kept would hide that an object has been replaced.
    return cast("tuple[Any, str]", url_to_fs(str(url), use_listings_cache=False, **options))


@contextmanager
def _explained(url: ObjectUrl) -> Iterator[None]:
    """Turn an error of the object store into one line."""
    try:
        yield
    except ArmidentError:
        raise
    except ImportError as error:
        extra = needed_extra(error) or ("objects" if "s3fs" in str(error) else None)
        raise ConfigError(f"{url}: {_line(error)}" if extra is None else install_line(str(url), [extra])) from error
    except FileNotFoundError as error:
        raise ConfigError(f"{url}: no such recording, or no such bucket") from error
    except PermissionError as error:
        raise ConfigError(f"{url}: no permission: {_line(error)}; check the credentials (AWS_PROFILE)") from error
    except Exception as error:
        # The libraries of the object stores have no common class: network, time limit, credentials, address.
        raise ConfigError(f"{url}: cannot be read: {_line(error)}") from error


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__
