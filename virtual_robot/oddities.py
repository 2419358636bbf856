"""Oddities of drives: what CiA 301 and CiA 402 leave optional, masked, rounded, delayed or temporary (`ODDITIES`)."""

from collections.abc import Mapping

from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.session import Bus

ODDITIES: Mapping[str, str] = {
    "no1019": "no SYNC counter (1019h)",
    "no60c0": "no interpolation sub-mode (60C0h)",
    "no60c2": "no interpolation time (60C2h): set points are interpolated by the time set before",
    "interpolation_rounds": "interpolation time (60C2h) in steps of 3 of its units",
    "no608f": "no encoder resolution (608Fh)",
    "no6075": "no rated current (6075h)",
    "no_product_code": "no product code (1018h:2)",
    "no1017": "no heartbeat (1017h), but answers to node guarding",
    "no_supervision": "no heartbeat (1017h), and no answers to node guarding",
    "heartbeat_rounds": "heartbeat period (1017h) in steps of 64 ms",
    "bit30_kept": "bit 30 (no RTR) of the COB-IDs of TPDOs is always set",
    "bit30_demanded": "COB-IDs of TPDOs are refused without bit 30 (no RTR)",
    "pdo_fixed": "PDO mapping is read-only, and is that of the session",
    "pdo_fixed_other": "PDO mapping is read-only, and is the default of the EDS",
    "cob_fixed": "COB-IDs of PDOs are read-only, and are those of the session",
    "write_late": "a written value reads back only 50 ms later",
    "mode_when_enabled": "mode of operation (6061h) is 0 until 50 ms after enabling",
    "mode_unknown": "mode of operation (6061h) is -1 until 1.5 s after enabling",
    "target_follows": "target position (607Ah) follows the position until the drive is enabled",
    "abort_busy": "every 7th SDO request is aborted (08000020h, 08000021h and 08000022h in turn)",
    "twice": "every SDO answer comes twice",
    "twice_late": "every SDO answer comes again 20 ms later",
    "slow_sdo": "SDO answers take 50 ms",
    "short_answer": "SDO answers to writes have four bytes",
    "other_client": "another client reads 1001h on the SDO channel at up to 200 Hz",
    "autostart": "becomes operational by itself 30 ms after each NMT command to pre-operational",
    "slow_boot": "is switched on with the first NMT command, and needs 2 s to boot",
    "emcy_burst": "3000 emergency messages within about a second, from 0.5 s after NMT start on",
}
"""Description of each oddity by name."""


class Oddity:
    """Deviation of a virtual drive from an ordinary one; this base class deviates in nothing."""

    answers_guarding = True
    """``True`` if the drive answers node guarding while it sends no heartbeat."""

    def preset(self) -> None:
        """Set objects to other power-on values."""

    def read(self, index: int, subindex: int) -> bytes | None:
        """Bytes that an SDO request reads; ``None``: those of the object. SdoAbortedError if the drive refuses."""
        return None

    def write(self, index: int, subindex: int, data: bytes) -> bytes:
        """Bytes that are stored when an SDO request writes; raises SdoAbortedError if the drive refuses."""
        return data

    def request(self, data: bytes) -> bool:
        """Return ``True`` if an SDO request is served."""
        return True

    def respond(self, data: bytes) -> list[bytes]:
        """Return the answers that are sent for one answer of the SDO server."""
        return [data]

    def nmt(self, command: int) -> bool:
        """Return ``True`` if an NMT command is executed. ``command``: command specifier."""
        return True

    def begin(self, bus: Bus) -> None:
        """Begin to run on a bus."""

    def end(self) -> None:
        """End what was begun."""


def describe_oddities() -> str:
    """Text table of all oddities."""
    width = max(map(len, ODDITIES))
    return "\n".join(f"{name:{width}}  {meaning}" for name, meaning in ODDITIES.items())


def drive_oddities(
    scenario: Scenario | None, robot: RobotConfig, where: str = "scenario"
) -> dict[str, tuple[str, ...]]:
    """Names of the oddities of each drive, by joint; raises ConfigError if a joint or an oddity is unknown."""
    joints = [joint.name for joint in robot.joints]
    found: dict[str, tuple[str, ...]] = {}
    for name, drive in ({} if scenario is None else scenario.drives).items():
        if name not in joints:
            raise ConfigError(f"{where}: drives.{name}: not a joint of {robot.name} ({', '.join(joints)})")
        for oddity in drive.oddities:
            if oddity not in ODDITIES:
                raise ConfigError(
                    f"{where}: drives.{name}.oddities: {oddity!r} is not an oddity of virtual drives "
                    f"({', '.join(ODDITIES)})"
                )
        found[name] = drive.oddities
    return found
