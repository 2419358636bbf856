"""Kernel and tools of the guest: five Debian packages, unpacked into a private folder; nothing is installed, no root.

``user-mode-linux`` of Debian testing (from 6.16 on) runs guests by seccomp, which is fast, and on CPUs with AMX; that
of Debian 12 does neither. Its C library is unpacked beside it and entered in the binary.
"""

import fcntl
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from armident.configs.errors import ArmidentError

GUEST_PACKAGES = ("user-mode-linux", "libc6")
HOST_PACKAGES = ("patchelf", "busybox-static", "can-utils")
SUITES = ("testing", "unstable")
KEYRING = Path("/usr/share/keyrings/debian-archive-keyring.gpg")
# In the order of loading; modules that the kernel lacks are left out.
MODULES = ("can-dev", "can", "can-raw", "can-bcm", "can-gw", "can-isotp", "can-j1939", "vcan")
NEEDED_MODULES = {"can", "can-raw", "vcan"}


def cache_folder() -> Path:
    """Folder of packages and locks: ``$VCAN_CACHE``, else ``armident/vcan`` in the user's cache folder."""
    if "VCAN_CACHE" in os.environ:
        return Path(os.environ["VCAN_CACHE"]).absolute()
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "armident" / "vcan"


def obstacle() -> str | None:
    """Reason why the packages are not available on this machine; ``None`` if no obstacle is known."""
    if kernel(cache_folder() / "root").exists():
        return None
    if shutil.which("dpkg") is None:
        return "no dpkg to unpack Debian packages with"
    if "VCAN_DEBS" in os.environ:
        folder = Path(os.environ["VCAN_DEBS"])
        missing = [p for p in GUEST_PACKAGES + HOST_PACKAGES if not list(folder.glob(f"{p}_*.deb"))]
        return f"VCAN_DEBS={folder} lacks {', '.join(missing)}" if missing else None
    if shutil.which("apt-get") is None or not KEYRING.exists():
        return f"no apt-get with {KEYRING} to fetch Debian packages with (VCAN_DEBS may name a folder that has them)"
    return None


def kernel(root: Path) -> Path:
    """Path of the kernel's executable. ``root``: folder of the unpacked packages."""
    return root / "usr" / "bin" / "linux.uml"


def provide() -> Path:
    """Folder with kernel, ``modules/`` and ``bin/``; fetched and unpacked if it does not exist yet."""
    cache = cache_folder()
    root = cache / "root"
    if _works(root):
        return root
    cache.mkdir(parents=True, exist_ok=True)
    with _locked(cache / "lock"):
        if _works(root):
            return root
        reason = obstacle()
        if reason is not None:
            raise ArmidentError(f"no User-Mode Linux: {reason}")
        unpacking = cache / "unpacking"
        shutil.rmtree(unpacking, ignore_errors=True)
        log = cache / "setup.log"
        try:
            with log.open("w") as output:
                _collect(unpacking / "debs", output.fileno())
                _unpack(unpacking, root, output.fileno())
        except (OSError, subprocess.CalledProcessError, LookupError) as error:
            raise ArmidentError(f"no User-Mode Linux: {error} (log: {log})") from error
        shutil.rmtree(root, ignore_errors=True)
        unpacking.rename(root)
        if not _works(root):
            raise ArmidentError(f"{kernel(root)} was unpacked but does not start on this machine")
    return root


def _works(root: Path) -> bool:
    try:
        return subprocess.run([kernel(root), "--version"], capture_output=True, check=False).returncode == 0
    except OSError:
        return False


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    with path.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _collect(folder: Path, log: int) -> None:
    """Copy the five packages into ``folder`` from ``VCAN_DEBS``, or download them by apt."""
    folder.mkdir(parents=True)
    if "VCAN_DEBS" in os.environ:
        for deb in sorted(Path(os.environ["VCAN_DEBS"]).glob("*.deb")):
            shutil.copy(deb, folder)
        return
    release, mirror = _debian()
    for suite in SUITES:
        try:
            _apt_download(folder, mirror, {release: HOST_PACKAGES, suite: GUEST_PACKAGES}, log)
        except subprocess.CalledProcessError:
            if suite == SUITES[-1]:
                raise
        else:
            return


def _debian() -> tuple[str, str]:
    """Code name of this Debian release and its configured mirror (``$VCAN_MIRROR`` replaces it)."""
    facts = dict(line.split("=", 1) for line in Path("/etc/os-release").read_text().splitlines() if "=" in line)
    release = facts.get("VERSION_CODENAME", "").strip('"')
    if facts.get("ID", "").strip('"') != "debian" or not release:
        release = "bookworm"
    if "VCAN_MIRROR" in os.environ:
        return release, os.environ["VCAN_MIRROR"]
    listing = ["apt-get", "indextargets", "--format", "$(RELEASE) $(REPO_URI)"]
    for line in subprocess.run(listing, capture_output=True, text=True, check=True).stdout.splitlines():
        name, _, address = line.partition(" ")
        if name == release:
            return release, address
    raise LookupError("apt has no Debian mirror configured; VCAN_MIRROR may name one")


def _apt_download(folder: Path, mirror: str, wanted: dict[str, tuple[str, ...]], log: int) -> None:
    """Download packages by suite with private package lists: needs no root and does not change the machine's lists."""
    state = folder.parent / "apt"
    shutil.rmtree(state, ignore_errors=True)
    for part in ("lists/partial", "cache/archives/partial"):
        (state / part).mkdir(parents=True)
    sources = state / "sources.list"
    sources.write_text("".join(f"deb [signed-by={KEYRING}] {mirror} {suite} main\n" for suite in wanted))
    options = {
        "Dir::Etc::SourceList": sources,
        "Dir::Etc::SourceParts": "/dev/null",
        "Dir::State::Lists": state / "lists",
        "Dir::Cache": state / "cache",
        "APT::Sandbox::User": "root",
        "Acquire::Retries": 3,
        "Acquire::Languages": "none",
    }
    apt = ["apt-get", "-q", *(word for key, value in options.items() for word in ("-o", f"{key}={value}"))]
    names = [f"{name}/{suite}" for suite, packages in wanted.items() for name in packages]
    for action in (["update"], ["download", *names]):
        subprocess.run([*apt, *action], cwd=folder, stdout=log, stderr=log, check=True)
    shutil.rmtree(state)


def _unpack(folder: Path, root: Path, log: int) -> None:
    """Unpack ``folder/debs`` for the later path ``root`` of ``folder``."""
    for deb in sorted((folder / "debs").glob("*.deb")):
        target = folder / "libc" if deb.name.startswith("libc6_") else folder
        target.mkdir(exist_ok=True)
        subprocess.run(["dpkg", "-x", deb, target], stdout=log, stderr=log, check=True)
    loader = _one(folder / "libc", "ld-linux-x86-64.so.2").relative_to(folder)
    names = ["--set-interpreter", str(root / loader), "--set-rpath", str(root / loader.parent)]
    subprocess.run([_one(folder, "patchelf"), *names, kernel(folder)], stdout=log, stderr=log, check=True)
    modules = folder / "modules"
    modules.mkdir()
    found = {path.stem: path for path in (folder / "usr" / "lib" / "uml").rglob("*.ko")}
    if not found.keys() >= NEEDED_MODULES:
        raise LookupError(f"the kernel package lacks {', '.join(sorted(NEEDED_MODULES - found.keys()))}")
    for k, name in enumerate(name for name in MODULES if name in found):
        shutil.copy(found[name], modules / f"{k}-{name}.ko")
    tools = folder / "bin"
    tools.mkdir(exist_ok=True)
    if not (tools / "busybox").exists():
        shutil.copy(_one(folder / "usr" / "bin", "busybox"), tools / "busybox")
    for tool in ("candump", "cansend", "cangen"):
        shutil.copy(folder / "usr" / "bin" / tool, tools)
    (tools / "ip").symlink_to("busybox")
    for rest in ("debs", "usr/lib", "usr/share"):
        shutil.rmtree(folder / rest)


def _one(folder: Path, name: str) -> Path:
    path = next((p for p in sorted(folder.rglob(name)) if p.is_file() and not p.is_symlink()), None)
    if path is None:
        raise LookupError(f"the packages hold no {name}")
    return path
