"""Behaviour of each oddity of virtual drives, by name."""

from collections.abc import Callable, Mapping, Sequence

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
from armident.virtual_robot.oddities import Oddity

Factory = Callable[[Drive, SessionConfig], Oddity]

BEHAVIOURS: Mapping[str, Factory] = {
    "no1019": lambda drive, session: Absent(od.SYNC_COUNTER_OVERFLOW),
    "no60c0": lambda drive, session: Absent(0x60C0),
    "no60c2": lambda drive, session: Absent(od.INTERPOLATION_PERIOD),
    "interpolation_rounds": lambda drive, session: InterpolationRounds(),
    "no608f": lambda drive, session: Absent(od.ENCODER_RESOLUTION),
    "no6075": lambda drive, session: Absent(od.RATED_CURRENT),
    "no_product_code": lambda drive, session: Absent(od.IDENTITY, 2),
    "no1017": lambda drive, session: Absent(od.HEARTBEAT_PRODUCER),
    "no_supervision": lambda drive, session: Absent(od.HEARTBEAT_PRODUCER, guarding=False),
    "heartbeat_rounds": lambda drive, session: HeartbeatRounds(),
    "bit30_kept": lambda drive, session: Bit30(demanded=False),
    "bit30_demanded": lambda drive, session: Bit30(demanded=True),
    "pdo_fixed": PdoFixed,
    "pdo_fixed_other": lambda drive, session: PdoFixed(drive, None),
    "cob_fixed": CobFixed,
    "write_late": lambda drive, session: WriteLate(drive, 0.05),
    "mode_when_enabled": lambda drive, session: ModeLate(drive, 0, 0.05),
    "mode_unknown": lambda drive, session: ModeLate(drive, -1, 1.5),
    "target_follows": lambda drive, session: TargetFollows(drive),
    "abort_busy": lambda drive, session: AbortBusy(drive),
    "twice": lambda drive, session: Twice(drive, 0.0),
    "twice_late": lambda drive, session: Twice(drive, 0.02),
    "slow_sdo": lambda drive, session: SlowSdo(),
    "short_answer": lambda drive, session: ShortAnswer(),
    "other_client": lambda drive, session: OtherClient(drive),
    "autostart": lambda drive, session: Autostart(drive),
    "slow_boot": lambda drive, session: SlowBoot(drive, 2.0),
    "emcy_burst": lambda drive, session: EmcyBurst(drive),
}
"""Function that makes the behaviour of each oddity, by name."""


def make_oddities(names: Sequence[str], drive: Drive, session: SessionConfig) -> list[Oddity]:
    """Return the behaviours of the oddities of a drive. ``names``: names of `ODDITIES`."""
    return [BEHAVIOURS[name](drive, session) for name in names]
