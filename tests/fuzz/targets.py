"""Everything that reads what others wrote, by name."""

from tests.fuzz import read_bags, read_bus, read_configs, read_imports, read_recordings, read_zenoh
from tests.fuzz.harness import Target

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (read_recordings, read_configs, read_zenoh, read_bus, read_imports, read_bags)
    for target in module.TARGETS
}

IMPORTERS = tuple(name for name in TARGETS if name.startswith("import") or name in ("urdf", "eds"))
"""Names of the targets that read files of other tools."""
