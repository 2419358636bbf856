"""Execution of a command under a User-Mode Linux kernel with vcan buses, on this machine's file system.

The guest sees the host's files read-only; /tmp, the working directory and caches are writable. It has no stdin, no
terminal and only the loopback network. Environment, exit status, Ctrl-C and SIGTERM pass.
"""

import ctypes
import fcntl
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import FrameType

from armident.configs.errors import ArmidentError
from armident.drivers.vcan import packages

FORWARDED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE_S = 15.0
"""Time for a command to end after a signal, before the guest is killed, s."""
NICENESS = -10
"""Nice value of the guest."""
MALLOC_TUNABLES = "glibc.malloc.mmap_threshold=1073741824:glibc.malloc.trim_threshold=1073741824"
"""Tunables of glibc that keep freed memory in the process, because page faults are slow in a guest."""
CACHES = {"MPLCONFIGDIR": "matplotlib", "XDG_CACHE_HOME": "guest", "XDG_STATE_HOME": "guest-state"}
"""Environment variables of folders that programs write, and their default folders in the cache of armident. The user's
own ones are read-only in the guest."""
MAPPINGS = Path("/proc/sys/vm/max_map_count")
"""Most mappings of a process (documentation of the Linux kernel, sysctl/vm). In a guest, each page of a process that
is not beside its neighbour in the memory of the guest is one mapping of the host."""
MEMORY_UNITS = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30}
"""Units of the kernel's ``mem=``."""
PR_SET_PDEATHSIG = 1
"""Option of ``prctl`` (linux/prctl.h)."""


def launcher_obstacle() -> str | None:
    """Reason why this machine cannot run a guest; ``None`` if no obstacle is known."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return f"User-Mode Linux is for Linux on x86-64, this is {platform.system()} on {platform.machine()}"
    return packages.obstacle()


def launcher_command(command: Sequence[str], buses: int = 1) -> list[str]:
    """Command line that runs a command with the buses ``vcan0`` to ``vcan{buses - 1}``."""
    return [sys.executable, "-m", "armident.drivers.vcan", "-n", str(buses), "--", *command]


def run_in_guest(command: Sequence[str], buses: int = 1, memory: str = "4096M") -> int:
    """Run ``command`` in a guest, in the current directory, and return its exit status."""
    if not re.fullmatch(r"\d+[KMG]?", memory):
        raise ArmidentError(f"{memory!r}: expected the memory of a guest as a number with K, M or G, such as 4096M")
    reason = launcher_obstacle()
    if reason is not None:
        raise ArmidentError(f"no vcan: {reason}")
    root = packages.provide()
    _allow_mappings(memory)
    environment = dict(os.environ)
    caches = [
        Path(environment.setdefault(name, str(packages.cache_folder().parent / folder))).absolute()
        for name, folder in CACHES.items()
    ]
    environment["PATH"] = f"{environment.get('PATH', os.defpath)}:/usr/sbin:/sbin:{root / 'bin'}"
    environment["ARMIDENT_GUEST"] = "1"
    # A page fault is many times slower in a guest than on the host: freed memory stays with its process.
    environment.setdefault("GLIBC_TUNABLES", MALLOC_TUNABLES)
    for cache in caches:
        cache.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        cpu = stack.enter_context(_reserved_cpu())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="armident-vcan-")))
        _write_scripts(folder, root, command, environment, buses, [folder, Path.cwd(), *caches])
        _boot(folder, root, cpu, memory)
        try:
            return int((folder / "status").read_text())
        except (OSError, ValueError):
            log = (folder / "log").read_text(errors="replace").splitlines()
            raise ArmidentError("the vcan guest ended without a status: " + " | ".join(log[-6:])) from None


def _allow_mappings(memory: str) -> None:
    """Allow guest processes all of their memory until the next boot: beyond the limit they hang or end by SIGSEGV."""
    number, unit = (memory[:-1], memory[-1]) if memory[-1:] in MEMORY_UNITS else (memory, "")
    needed = int(number) * MEMORY_UNITS.get(unit, 1) // os.sysconf("SC_PAGE_SIZE")
    with suppress(OSError, ValueError):
        present = int(MAPPINGS.read_text())
        if present >= needed:
            return
        try:
            MAPPINGS.write_text(str(needed))
        except OSError:
            usable = present * os.sysconf("SC_PAGE_SIZE") >> 20
            print(
                f"armident.drivers.vcan: a process with more than {usable} MB may hang in the guest: "
                f"sudo sysctl -w vm.max_map_count={needed}",
                file=sys.stderr,
            )


def _write_scripts(
    folder: Path,
    root: Path,
    command: Sequence[str],
    environment: dict[str, str],
    buses: int,
    writable: Sequence[Path],
) -> None:
    settings = {"MODULES": root / "modules", "RUN": folder, "BUSES": buses}
    head = "".join(f"{name}={shlex.quote(str(value))}\n" for name, value in settings.items())
    init = Path(__file__).with_name("init.sh").read_text(encoding="utf-8")
    (folder / "init").write_text(f"#!{folder / 'busybox'} sh\n{head}{init}", encoding="utf-8")
    (folder / "init").chmod(0o755)
    # a path without spaces for the interpreter line, wherever the cache is
    (folder / "busybox").symlink_to(root / "bin" / "busybox")
    mounts = []
    for path in dict.fromkeys([Path("/tmp"), *(p.resolve() for p in writable)]):
        if "," in str(path):
            raise ArmidentError(f"{path}: a folder with a comma in its name cannot be mounted in the guest")
        quoted = shlex.quote(str(path))
        if path == Path("/"):
            mounts.append("$B mount -o remount,rw /\n")
        elif path == Path("/tmp") or not path.is_relative_to("/tmp"):
            mounts.append(f"$B mount -t hostfs -o {quoted} none {quoted} || give_up mount {quoted}\n")
    (folder / "mounts").write_text("".join(mounts), encoding="utf-8")
    exports = "".join(f"export {k}={shlex.quote(v)}\n" for k, v in environment.items() if k.isidentifier())
    start = f"cd {shlex.quote(str(Path.cwd()))} || exit 126\nexec {shlex.join(command)}\n"
    (folder / "command").write_text(exports + start, encoding="utf-8", errors="surrogateescape")


@contextmanager
def _reserved_cpu() -> Iterator[int]:
    """Reserve one CPU that no other guest uses, if there is one: switches between CPUs at system calls are slow."""
    cpus = sorted(os.sched_getaffinity(0), reverse=True)
    with ExitStack() as stack:
        for cpu in cpus:
            lock = stack.enter_context((packages.cache_folder() / f"cpu{cpu}.lock").open("w"))
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                continue
            yield cpu
            return
        yield cpus[os.getpid() % len(cpus)]


def _boot(folder: Path, root: Path, cpu: int, memory: str) -> None:
    """Boot the guest and wait until it has powered off."""
    libc = ctypes.CDLL(None, use_errno=True)

    def set_up_child() -> None:
        os.sched_setaffinity(0, {cpu})
        libc.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        # A bus at 5 kHz needs priority over other processes; only root may raise it. Where the scheduler groups
        # processes by session, the nice value of the group counts.
        with suppress(OSError):
            os.nice(NICENESS)
            Path("/proc/self/autogroup").write_text(str(NICENESS))

    sys.stdout.flush()
    sys.stderr.flush()
    reading, writing = os.pipe()
    with (folder / "log").open("ab") as log, ExitStack() as stack:
        stack.callback(os.close, writing)
        console = os.dup(log.fileno())
        output, errors = os.dup(1), os.dup(2)
        passed = (console, output, errors, reading)
        arguments = [
            *(f"mem={memory}", "seccomp=auto", "rootfstype=hostfs", "root=none", "hostfs=/", "ro", "quiet"),
            *(f"init={folder / 'init'}", "con=null", f"con0=null,fd:{console}", "ssl=null"),
            *(f"ssl0=null,fd:{output}", f"ssl1=null,fd:{errors}", f"ssl2=fd:{reading},null"),
            *(f"umid=armident{os.getpid()}", f"uml_dir={folder}/"),
        ]
        try:
            guest = subprocess.Popen(
                [packages.kernel(root), *arguments],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                pass_fds=passed,
                preexec_fn=set_up_child,
                start_new_session=True,
                env={**os.environ, "TMPDIR": str(_memory_folder())},
            )
        finally:
            for descriptor in passed:
                os.close(descriptor)
        with _forwarding(guest, writing):
            guest.wait()


def _memory_folder() -> Path:
    """Folder of the file that backs the guest's memory: /dev/shm, unless a container leaves too little space there."""
    shared = Path("/dev/shm")
    if shared.is_dir() and os.access(shared, os.W_OK) and shutil.disk_usage(shared).free > 2 << 30:
        return shared
    return Path(tempfile.gettempdir())


@contextmanager
def _forwarding(guest: "subprocess.Popen[bytes]", channel: int) -> Iterator[None]:
    """Forward signals to the command; kill the guest if the command does not end in time."""
    deadline: list[float] = []

    def forward(number: int, _frame: FrameType | None) -> None:
        os.write(channel, signal.Signals(number).name.removeprefix("SIG").encode() + b"\n")
        if not deadline:
            deadline.append(time.monotonic() + GRACE_S)
            threading.Thread(target=kill_in_time, daemon=True).start()

    def kill_in_time() -> None:
        try:
            guest.wait(max(0.0, deadline[0] - time.monotonic()))
        except subprocess.TimeoutExpired:
            guest.kill()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, forward) for number in FORWARDED}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
