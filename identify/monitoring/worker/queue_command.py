"""Command ``armident queue``: the recordings of a worker, as its ledger has them."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from fnmatch import fnmatchcase
from pathlib import Path

from armident.configs import ConfigError, load_session
from armident.identify.documents.base import plain
from armident.identify.monitoring.worker.ledger import ACTIONS, FILE, Ledger, LedgerEntry, unique_owner


def queue_command(action: str, names: Sequence[str], config: Path | None, out: Path | None, *, as_json: bool) -> None:
    """Carry out ``armident queue``; ConfigError if there is no ledger, or a name is of no recording."""
    if action not in ("list", *ACTIONS):
        raise ConfigError(f"no action {action!r}; choose from list, {', '.join(ACTIONS)}")
    if out is None and config is None:
        raise ConfigError("--config: give the session of the worker, or --out with the folder of its results")
    folder = out or load_session(config or "", "identify").recording.directory
    if not (folder / FILE).is_file():
        raise ConfigError(f"{folder / FILE}: no worker has used this folder; give its --out")
    ledger = Ledger(folder / FILE, unique_owner())
    if action == "list":
        entries = ledger.entries()
        if names:
            entries = [each for each in entries if each.name in names or any(fnmatchcase(each.name, n) for n in names)]
        _show(entries, as_json=as_json)
        return
    if not names:
        raise ConfigError(f"{action}: name the recordings; armident queue list shows them")
    changed = ledger.change(action, names)
    if not changed:
        called = ", ".join(names)
        raise ConfigError(
            f"{action}: no recording without a result is called {called}; a file without an end is entered when it "
            "ends, or has not changed for a minute"
        )
    print(json.dumps({"changed": changed}) if as_json else "\n".join(f"{name}: {action}" for name in changed))


def _show(entries: Sequence[LedgerEntry], *, as_json: bool) -> None:
    counts = Counter(each.state for each in entries)
    if as_json:
        print(json.dumps({"counts": counts, "recordings": [plain(asdict(each)) for each in entries]}, indent=1))
        return
    for each in entries:
        print(f"{each.state:8} {each.name}{f': {each.message}' if each.message else ''}")
    print(", ".join(f"{number} {state}" for state, number in sorted(counts.items())) or "no recordings")
