"""Compilation of the kernels by numba, before they are used; their machine code is kept on disk.

``python -m armident.compiled`` compiles what the kernels declare; `make install` and the build of a wheel run it. A
file is named by a hash of all that it depends on: bytecode and constants of the kernel and of what it calls in any
module, types, options, processor, versions of Python and numba. So no code is stale, and no folder has to be writable.
What is not declared is compiled when it is first called, and kept as well.
"""

import hashlib
import os
import pickle
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import cache
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar

import llvmlite.binding
import numba
import numpy as np
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature

from armident.extras import needed_extra

F = TypeVar("F", bound=Callable[..., Any])

BASELINE = "x86-64-v3"
"""Processor for which the declared signatures are compiled, where this machine has its features."""
_FEATURES = ("avx", "avx2", "bmi", "bmi2", "cx16", "f16c", "fma", "lzcnt", "movbe", "popcnt", "sahf", "sse4.2", "xsave")
"""Features of `BASELINE` (x86-64 psABI, microarchitecture levels) that LLVM names."""

ARITHMETIC: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz"}}
"""Options of the kernels of the model: a division by zero is no error, products and sums may be fused."""
PLAIN: dict[str, Any] = {"error_model": "numpy", "nogil": False}
"""Options of the kernels of the virtual arm: a division by zero is no error, the interpreter waits."""
UNCOUNTED: dict[str, Any] = {"_nrt": False}
"""Option of kernels that allocate nothing: no reference counts, for the caller keeps the arrays alive.

An atomic increment costs as much as the arithmetic, and thirty arrays in a tuple take as long to count as to use.
"""

SHIPPED = Path(__file__).with_name("kernels")
"""Folder of the machine code in this installation; part of a wheel."""

_KERNELS: list[tuple[Any, tuple[str, ...]]] = []
_TYPES: dict[str, Any] = dict(vars(numba.types))


def compiled(*signatures: str, kept: bool = False, nogil: bool = True, **options: Any) -> Callable[[F], F]:
    """Compile a kernel that Python calls with arguments of the ``signatures``; without any, one that kernels call.

    Signatures list numba's types, ``f8[:, ::1], i8``, and tuples of `structure`. ``kept``: keep code of first calls.
    """

    def decorate(function: F) -> F:
        called_by_kernels = not (signatures or kept)
        chosen = {"nogil": nogil, "no_cfunc_wrapper": True, "no_cpython_wrapper": called_by_kernels, **options}
        kernel: Any = numba.njit(**chosen)(function)
        if called_by_kernels:
            kernel._insert, kernel._compile_for_args = _ignore, _refuse  # a call without wrapper ends the process
        else:
            kernel._cache = _MachineCode(kernel)
            _KERNELS.append((kernel, signatures))
        found: F = kernel
        return found

    return decorate


def _ignore(*_: Any, **__: Any) -> None:
    pass


def _refuse(*_: Any, **__: Any) -> None:
    raise TypeError("only kernels call this function; call its py_func")


def inlined(function: F) -> F:
    """Compile a helper, no allocation, into its callers, where the compiler sees distinct arrays and short loops."""
    return compiled(nogil=False, forceinline=True, **ARITHMETIC, **UNCOUNTED)(function)


def structure(fields: str) -> Callable[[F], F]:
    """Declare the types of a named tuple's fields, so that signatures can name it."""

    def decorate(cls: F) -> F:
        _TYPES[cls.__name__] = numba.types.BaseTuple.from_types(declared(fields), cls)
        return cls

    return decorate


def declared(signature: str) -> tuple[Any, ...]:
    """Return the types of a signature."""
    types: tuple[Any, ...] = eval(f"({signature},)", _TYPES)
    return types


class _MachineCode:
    """Cache of a kernel, in the protocol of numba's dispatcher: a file for each signature and processor."""

    def __init__(self, kernel: Dispatcher) -> None:
        self._kernel, self.meaning = kernel, b""
        self.cache_path = str(SHIPPED)

    def load_overload(self, signature: Any, target: Any) -> Any:
        path = self.path(signature, target)
        # what machine code calls; the registries of the compiler, 0.3 s to import, are only read when one compiles
        rtsys.initialize(target)
        return CompileResult._rebuild(target, *pickle.loads(path.read_bytes())) if path else None

    def save_overload(self, signature: Any, result: Any) -> None:
        if result.library.has_dynamic_globals:
            raise ValueError(f"{self._kernel}: its machine code holds addresses of this process")
        data = dumps(result._reduce())
        name = self.names(signature, result.target_context)[-1]
        for folder in _folders():
            with suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
                new = folder / f"{name}.{os.getpid()}"
                new.write_bytes(data)
                new.replace(folder / name)
                return

    def path(self, signature: Any, target: Any) -> Path | None:
        """Return the file of the machine code, if there is one."""
        paths = (folder / name for folder in _folders() for name in self.names(signature, target))
        return next((path for path in paths if path.is_file()), None)

    def names(self, signature: Any, target: Any) -> tuple[str, ...]:
        """Return the names of the file for the processor of a wheel, if this one has its features, and for this one."""
        self.meaning = self.meaning or b"\0".join(_meaning(self._kernel, set()))
        types = normalize_signature(signature)[0]
        fields = [getattr(kind, "fields", ()) for kind in types]
        here = target.codegen().magic_tuple()
        function = self._kernel.py_func
        found = []
        for processor in dict.fromkeys(((here[0], BASELINE, ""), here) if _has_baseline() else (here,)):
            kept = repr((processor, types, fields, numba.__version__, sys.implementation.cache_tag)).encode()
            digest = hashlib.sha256(kept + self.meaning).hexdigest()
            found.append(f"{function.__module__}.{function.__qualname__}-{digest[:32]}.code")
        return tuple(found)


def missing(*modules: str) -> list[str]:
    """Return the names of the modules' kernels of which no machine code is on disk."""
    for module in modules:
        import_module(module)
    target = cpu_target.target_context
    target.refresh()
    return [
        kernel.py_func.__name__
        for kernel, signatures in _KERNELS
        if kernel.py_func.__module__ in modules
        and not all(kernel._cache.path(declared(signature), target) for signature in signatures)
    ]


@cache
def _has_baseline() -> bool:
    features = llvmlite.binding.get_host_cpu_features()
    return all(features.get(name, False) for name in _FEATURES)


@cache
def _folders() -> tuple[Path, ...]:
    """Folders of machine code in the order of their use: of the installation, of the user."""
    cache_home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return SHIPPED, Path(cache_home) / "armident" / "kernels"


def _is_foreign(module: str) -> bool:
    return module.partition(".")[0] in ("numba", "numpy")


def _meaning(value: Any, seen: set[int]) -> Iterator[bytes]:
    """Yield what determines the machine code: options, bytecode and constants of a kernel and of all that it names."""
    if isinstance(value, Dispatcher):
        if id(value) not in seen:
            seen.add(id(value))
            yield from _meaning(tuple(sorted(value.targetoptions.items())), seen)
            yield from _meaning(value.py_func, seen)
    elif isinstance(value, FunctionType) and not _is_foreign(value.__module__):
        code = value.__code__
        # the first constant is the docstring, or None
        constants = code.co_consts[code.co_consts[:1] == (value.__doc__,) :]
        yield repr((value.__module__, value.__qualname__, value.__defaults__)).encode()
        yield from _meaning(code.replace(co_consts=constants), seen)
        named = [value.__globals__[name] for name in code.co_names if name in value.__globals__]
        modules = [part for part in named if isinstance(part, ModuleType) and not _is_foreign(part.__name__)]
        yield from _meaning(
            (*named, *(vars(m)[name] for m in modules for name in code.co_names if name in vars(m))), seen
        )
        for cell in value.__closure__ or ():
            yield from _meaning(cell.cell_contents, seen)
    elif isinstance(value, CodeType):
        yield value.co_code
        yield repr((value.co_names, value.co_varnames, value.co_freevars)).encode()
        yield from _meaning(value.co_consts, seen)
    elif isinstance(value, tuple):
        for part in value:
            yield from _meaning(part, seen)
    elif isinstance(value, set | frozenset):
        yield repr(sorted(map(repr, value))).encode()
    elif isinstance(value, np.ndarray):
        yield repr((value.dtype.str, value.shape)).encode() + value.tobytes()
    elif isinstance(value, numba.types.ExternalFunction):
        yield f"{value.symbol}{value.sig}".encode()
    elif isinstance(value, ModuleType | type | FunctionType):
        yield repr((value.__name__, getattr(value, "_fields", ()))).encode()
    else:
        yield repr(value).encode()


def main() -> None:
    """Compile what is declared and not yet there, on all processors; remove machine code that nothing declares."""
    begun = time.monotonic()
    if _has_baseline():
        options: Any = numba.config
        options.CPU_NAME, options.CPU_FEATURES = BASELINE, ""
    for module in _modules():
        try:
            import_module(module)
        except ImportError as error:
            if needed_extra(error) is None:
                raise
    target = cpu_target.target_context
    target.refresh()
    tasks: list[tuple[int, int, str]] = []
    current = set()
    for number, (kernel, signatures) in enumerate(_KERNELS):
        for signature in signatures:
            name = kernel._cache.names(declared(signature), target)[-1]
            current.add(name)
            if not (SHIPPED / name).is_file():
                tasks.append((len(kernel._cache.meaning), number, signature))
    SHIPPED.mkdir(exist_ok=True)
    for path in SHIPPED.iterdir():
        if path.name.startswith("armident.") and path.name not in current:
            path.unlink(missing_ok=True)
    if not tasks:
        return
    processes = len(os.sched_getaffinity(0))
    print(f"compiling {len(tasks)} kernels on {processes} processors", file=sys.stderr)
    with ProcessPoolExecutor(processes, mp_context=get_context("fork")) as pool:
        for _ in pool.map(_compile, sorted(tasks, reverse=True)):
            pass
    print(f"compiled in {time.monotonic() - begun:.0f} s", file=sys.stderr)


def _compile(task: tuple[int, int, str]) -> None:
    _, number, signature = task
    _KERNELS[number][0].compile(declared(signature))


def _modules() -> Iterator[str]:
    """Yield the modules of this package that have kernels."""
    root = Path(__file__).parent
    for folder, _, files in os.walk(root, followlinks=True):
        for path in (Path(folder, name) for name in files if name.endswith(".py")):
            if path != Path(__file__) and b"from armident.compiled import" in path.read_bytes():
                yield ".".join(("armident", *path.relative_to(root).with_suffix("").parts))


if __name__ == "__main__":
    # the kernels register with the module of this name, not with the one that is run
    import_module("armident.compiled").main()
