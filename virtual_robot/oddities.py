"""Oddities of drives by name: what CiA 301 and CiA 402 leave optional, masked, rounded, delayed or temporary."""

from collections.abc import Callable, Mapping, Sequence

from armident.configs import ConfigError, RobotConfig
from armident.configs.schema.scenario import Scenario
from armident.configs.schema.session import SessionConfig
from armident.drivers.canopen import objects as od
from armident.virtual_robot.node import Drive
from armident.virtual_robot.odd_objects import (
    Absent,
    Bit30,
    CobFixed,
    HeartbeatRounds,
    InterpolationRounds,
    ModeLate,
    PdoFixed,
    TargetFollows,
    TimersSet,
    WriteLate,
)
from armident.virtual_robot.odd_services import (
    AbortBusy,
    Autostart,
    EmcyBurst,
    OtherClient,
    ShortAnswer,
    SlowBoot,
    SlowSdo,
    Twice,
)
from armident.virtual_robot.oddity import Oddity

ODDITIES: Mapping[str, tuple[str, Callable[[Drive, SessionConfig], Oddity]]] = {
    "no1019": ("no SYNC counter (1019h)", lambda drive, session: Absent(od.SYNC_COUNTER_OVERFLOW)),
    "no60c0": ("no interpolation sub-mode (60C0h)", lambda drive, session: Absent(0x60C0)),
    "no60c2": (
        "no interpolation time (60C2h): set points are interpolated by the time set before",
        lambda drive, session: Absent(od.INTERPOLATION_PERIOD),
    ),
    "interpolation_rounds": (
        "interpolation time (60C2h) in steps of 3 of its units",
        lambda drive, session: InterpolationRounds(),
    ),
    "no608f": ("no encoder resolution (608Fh)", lambda drive, session: Absent(od.ENCODER_RESOLUTION)),
    "no6075": ("no rated current (6075h)", lambda drive, session: Absent(od.RATED_CURRENT)),
    "no_product_code": ("no product code (1018h:2)", lambda drive, session: Absent(od.IDENTITY, 2)),
    "no1017": (
        "no heartbeat (1017h), but answers to node guarding",
        lambda drive, session: Absent(od.HEARTBEAT_PRODUCER),
    ),
    "no_supervision": (
        "no heartbeat (1017h), and no answers to node guarding",
        lambda drive, session: Absent(od.HEARTBEAT_PRODUCER, guarding=False),
    ),
    "heartbeat_rounds": ("heartbeat period (1017h) in steps of 64 ms", lambda drive, session: HeartbeatRounds()),
    "bit30_kept": (
        "bit 30 (no RTR) of the COB-IDs of TPDOs is always set",
        lambda drive, session: Bit30(demanded=False),
    ),
    "bit30_demanded": (
        "COB-IDs of TPDOs are refused without bit 30 (no RTR)",
        lambda drive, session: Bit30(demanded=True),
    ),
    "pdo_fixed": ("PDO mapping is read-only, and is that of the session", PdoFixed),
    "pdo_fixed_other": (
        "PDO mapping is read-only, and is the default of the EDS",
        lambda drive, session: PdoFixed(drive, None),
    ),
    "cob_fixed": ("COB-IDs of PDOs are read-only, and are those of the session", CobFixed),
    "tpdo_timers": (
        "TPDOs have an inhibit time (180xh:3) of 50 ms and an event timer (180xh:5) of 100 ms",
        lambda drive, session: TimersSet(drive, 500, 100, fixed=False),
    ),
    "tpdo_timers_fixed": (
        "inhibit time (180xh:3) of TPDOs is read-only, and is 50 ms",
        lambda drive, session: TimersSet(drive, 500, 0, fixed=True),
    ),
    "no_inhibit_time": (
        "no inhibit time (1800h:3)",
        lambda drive, session: Absent(od.TPDO_COMMUNICATION, od.INHIBIT_TIME),
    ),
    "write_late": ("a written value reads back only 50 ms later", lambda drive, session: WriteLate(drive, 0.05)),
    "mode_when_enabled": (
        "mode of operation (6061h) is 0 until 50 ms after enabling",
        lambda drive, session: ModeLate(drive, 0, 0.05),
    ),
    "mode_unknown": (
        "mode of operation (6061h) is -1 until 1.5 s after enabling",
        lambda drive, session: ModeLate(drive, -1, 1.5),
    ),
    "target_follows": (
        "target position (607Ah) follows the position until the drive is enabled",
        lambda drive, session: TargetFollows(drive),
    ),
    "abort_busy": (
        "every 7th SDO request is aborted (08000020h, 08000021h and 08000022h in turn)",
        lambda drive, session: AbortBusy(drive),
    ),
    "twice": ("every SDO answer comes twice", lambda drive, session: Twice(drive, 0.0)),
    "twice_late": ("every SDO answer comes again 20 ms later", lambda drive, session: Twice(drive, 0.02)),
    "slow_sdo": ("SDO answers take 50 ms", lambda drive, session: SlowSdo()),
    "short_answer": ("SDO answers to writes have four bytes", lambda drive, session: ShortAnswer()),
    "other_client": (
        "another client reads 1001h on the SDO channel at up to 200 Hz",
        lambda drive, session: OtherClient(drive),
    ),
    "autostart": (
        "becomes operational by itself 30 ms after each NMT command to pre-operational",
        lambda drive, session: Autostart(drive),
    ),
    "slow_boot": (
        "is switched on with the first NMT command, and needs 2 s to boot",
        lambda drive, session: SlowBoot(drive, 2.0),
    ),
    "emcy_burst": (
        "3000 emergency messages within about a second, from 0.5 s after NMT start on",
        lambda drive, session: EmcyBurst(drive),
    ),
}
"""Description of each oddity, and function that makes its behaviour, by name."""


def make_oddities(names: Sequence[str], drive: Drive, session: SessionConfig) -> list[Oddity]:
    """Return the behaviours of the oddities of a drive. ``names``: names of `ODDITIES`."""
    return [ODDITIES[name][1](drive, session) for name in names]


def describe_oddities() -> str:
    """Text table of all oddities."""
    width = max(map(len, ODDITIES))
    return "\n".join(f"{name:{width}}  {meaning}" for name, (meaning, _) in ODDITIES.items())


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
