"""What a target is, and how one input is tried: within a time of the processor and a size of memory."""

import hashlib
import random
import re
import resource
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import FrameType

from armident.configs import ArmidentError, ConfigError, DataError
from tests.fuzz.mutate import Mutator

CORPUS = Path(__file__).parent / "corpus"
ROOMS = ("configs", "drivers", "daq", "identify", "virtual_robot")
SLOW_S = 5.0
"""Longest time of the processor that an input may take, s."""
MEMORY = 1_000_000_000
"""Most address space that an input may add, bytes."""
FOREIGN_WORDS = re.compile(
    r"Traceback|Error\b|Exception|object has no|codec can't|invalid literal|could not convert|NoneType"
)
"""Words of Python, which no message for the user has."""


class TooSlowError(BaseException):
    """An input takes too long; no handler of errors catches it on the way."""


class MisreadError(AssertionError):
    """Something was accepted that is not what was written."""


@dataclass(frozen=True)
class Target:
    """Something that reads what others wrote.

    Parameters
    ----------
    name
        What it is called on the command line, and its folder in the corpus.
    make_seeds
        Inputs to begin with, the same in every run.
    mutate
        Makes an input of known ones.
    check
        Reads an input in a folder of its own; returns whether it was accepted. Raises what the reader raises, and
        `MisreadError` where it accepted something that is not what was written.
    """

    name: str
    make_seeds: Callable[[], list[bytes]]
    mutate: Mutator
    check: Callable[[bytes, Path], bool]

    @cached_property
    def seeds(self) -> list[bytes]:
        """The inputs to begin with."""
        return self.make_seeds()

    def warm_up(self, folder: Path) -> None:
        """Try the inputs to begin with, so that what has to be compiled for them is."""
        for data in self.seeds:
            with suppress(ConfigError, DataError):
                self.check(data, folder)

    def corpus(self) -> list[Path]:
        """Inputs that failed once."""
        return sorted(path for path in (CORPUS / self.name).glob("*") if path.is_file())

    def inputs(self, seed: int) -> Iterator[bytes]:
        """Inputs without end, the same for the same number."""
        rng = random.Random(f"{self.name} {seed}")
        known = self.seeds + [path.read_bytes() for path in self.corpus()]
        while True:
            yield self.mutate(rng, known)


@dataclass(frozen=True)
class Finding:
    """An input that did what no input may: the input, and where it happened in words."""

    target: str
    data: bytes
    where: str
    trace: str

    def keep(self) -> Path:
        """Put the input into the corpus."""
        folder = CORPUS / self.target
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / hashlib.sha256(self.data).hexdigest()[:12]
        path.write_bytes(self.data)
        return path


def attempt(target: Target, data: bytes, folder: Path) -> bool | Finding:
    """Try one input: whether it was accepted, or what is wrong with how it was treated."""
    try:
        with _limited(), warnings.catch_warnings():
            # A warning of NumPy would be printed between the messages for the user.
            warnings.simplefilter("error", RuntimeWarning)
            return target.check(data, folder)
    except (ConfigError, DataError) as error:
        text = str(error)
        if not text.strip() or "\n" in text or len(text) > 2000:
            return Finding(target.name, data, f"an error that is not one line: {text[:200]!r}", traceback.format_exc())
        if FOREIGN_WORDS.search(text.replace(str(folder), "")):
            return Finding(target.name, data, f"words of Python: {text[:200]!r}", traceback.format_exc())
        return False
    except TooSlowError:
        return Finding(target.name, data, f"slower than {SLOW_S:g} s", traceback.format_exc())
    except ArmidentError as error:
        return Finding(target.name, data, f"{type(error).__name__}: {error}", traceback.format_exc())
    except Exception as error:
        return Finding(target.name, data, _place(error), traceback.format_exc())


def _place(error: BaseException) -> str:
    """The kind of an exception, and the innermost line of ours that it came through."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if any(f"/{room}/" in f.filename for room in ROOMS)]
    where = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else "?"
    return f"{type(error).__name__} at {where}: {str(error)[:160]}"


@contextmanager
def _limited() -> Iterator[None]:
    """Limits of time and memory while a block runs."""

    def over(_: int, __: FrameType | None) -> None:
        raise TooSlowError

    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGPROF, over)
    signal.setitimer(signal.ITIMER_PROF, SLOW_S)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, handler)
