"""Everything that reads what others wrote, by name."""

from tests.fuzz import read_bus, read_configs, read_imports, read_recordings, read_zenoh
from tests.fuzz.harness import Target

TARGETS: dict[str, Target] = {
    target.name: target
    for module in (read_recordings, read_configs, read_zenoh, read_bus, read_imports)
    for target in module.TARGETS
}
