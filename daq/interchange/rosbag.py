"""Joint states (sensor_msgs/msg/JointState) in bags of ROS 2: read by joint names and stamps, and written."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap_ros2.writer import Writer
from numpy.typing import NDArray

from armident.configs import DataError, RobotConfig
from armident.daq.interchange.bag_files import BagReader
from armident.daq.interchange.clocks import FASTEST_HZ, SLOWEST_HZ
from armident.daq.interchange.import_options import ImportOptions
from armident.daq.interchange.joint_messages import DEFINITION, MESSAGE_TYPE, MessageTable, TopicMessages
from armident.daq.interchange.joint_names import JointMatch, match_joints
from armident.daq.interchange.table_files import Source
from armident.daq.interchange.text_files import listed, printable, shortened

TOPIC = "/joint_states"
_NS = 1_000_000_000

LATEST_S = 0.1
"""Longest delay, s, of a message behind those of later stamps: several nodes send at their own pace."""

CLOCKS_DIFFER = 0.1
"""Relative difference of stamps and times of recording above which they are not of one clock, as in a simulation."""

ANOTHER_UNIT = 100.0
"""Ratio of the steps of stamps and of times of recording above which the stamps are in another unit than s and ns."""

SIMULATED_S = 1e8
"""Stamps below this time, s, are those of a simulation, whose clock begins at 0."""


@dataclass(frozen=True)
class JointStates:
    """Positions and efforts (N, n) of a robot, SI, at times (N,), ns; ``clock``: note on times that are no stamps."""

    t_ns: NDArray[np.int64]
    q: NDArray[np.float64]
    tau: NDArray[np.float64]
    remarks: tuple[str, ...] = ()
    clock: str = ""


def read_joint_states(
    path: Path,
    robot: RobotConfig,
    *,
    topic: str | None = None,
    joints: Sequence[str] | None = None,
    by_position: bool = False,
) -> JointStates:
    """Return positions and efforts of a robot's joints from a bag, by their names in every message.

    ``topic``: ``None`` is the only one with these joints; ``joints``: their names in the bag. Messages of one stamp are
    one sample. Times are the stamps, or those of recording if none is set. What is damaged is left out, with a remark.
    """
    reader = BagReader(path, MESSAGE_TYPE)
    found: dict[str, TopicMessages] = {}
    for message in reader:
        topic_messages = found.setdefault(message.topic, TopicMessages(printable(message.topic)))
        topic_messages.add(message.logged_ns, message.data, message.encoding)
    try:
        chosen, match, remarks = _choose(reader, found, robot, topic, joints, by_position)
        t_ns, q, tau, clock, passed = _samples(chosen, match, robot)
    except DataError as error:
        lost = f" ({'; '.join(reader.losses)})" if reader.losses else ""
        raise DataError(f"{path}: {error}{lost}") from error
    return JointStates(t_ns, q, tau, (*match.remarks, *remarks, *passed, *chosen.remarks(), *reader.losses), clock)


def joint_state_table(path: Path, robot: RobotConfig, options: ImportOptions) -> Source:
    """Return the joint states of a bag as a table, with its stamps."""
    chosen = {name: options.get(name) for name in ("topic", "joints", "by_position") if options.get(name)}
    states = read_joint_states(path, robot, **chosen)  # type: ignore[arg-type]
    times = (states.t_ns - states.t_ns[0]) / 1e9
    return Source(
        path, {"t": times, "q": states.q, "tau": states.tau}, notes=states.remarks, t_ns=states.t_ns, clock=states.clock
    )


def _choose(
    reader: BagReader,
    found: dict[str, TopicMessages],
    robot: RobotConfig,
    topic: str | None,
    joints: Sequence[str] | None,
    by_position: bool,
) -> tuple[TopicMessages, JointMatch, list[str]]:
    """Return the messages of the topic, the robot's joints in them, and a remark on other topics."""
    topics = sorted(name for name, kind in reader.topics.items() if kind == MESSAGE_TYPE)
    if not topics:
        have = ", ".join(f"{shortened(name)} ({shortened(kind)})" for name, kind in sorted(reader.topics.items()))
        found_instead = f"{have}; record a topic of this type, such as {TOPIC}" if have else "no topic"
        raise DataError(f"no topic of {MESSAGE_TYPE} in CDR; found {found_instead}")
    if topic is not None:
        name = topic if topic in topics else f"/{topic}"
        if name not in topics:
            raise DataError(f"--topic: no joint states on {topic}; the bag has {', '.join(map(shortened, topics))}")
        topics = [name]
    full = [found[name] for name in topics if name in found]
    if not full:
        raise DataError(f"no message on {', '.join(map(shortened, topics))}")
    if len(full) == 1:
        full[0].refuse_unusable()
        return full[0], match_joints(full[0].names(), robot.joints, by_position=by_position, joints=joints), []
    matches: list[tuple[TopicMessages, JointMatch]] = []
    for messages in full:
        try:
            match = match_joints(messages.names(), robot.joints, by_position=by_position, joints=joints)
        except DataError:
            continue
        matches.append((messages, match))
    contents = "; ".join(f"{m.topic}: {m.count} messages of {listed(m.names())}" for m in full)
    if len(matches) != 1:
        how = "joints of the robot on several topics" if matches else "no topic has the joints of the robot"
        wanted = ", ".join(joint.source_name or joint.name for joint in robot.joints)
        raise DataError(f"{how}; --topic NAME chooses one of {contents}; the robot has {wanted}")
    chosen, match = matches[0]
    return chosen, match, [f"topic {chosen.topic} is read, as only it has the joints of the robot ({contents})"]


def _samples(
    messages: TopicMessages, match: JointMatch, robot: RobotConfig
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], str, list[str]]:
    """Return times (N,), positions and efforts (N, n) of the stamps with all joints, their clock, and remarks."""
    tables = messages.tables()
    ours = [table for table in tables if set(table.names) & set(match.names)]
    others = [table for table in tables if table not in ours]
    remarks = []
    if others:
        names = dict.fromkeys(name for table in others for name in table.names)
        count = sum(table.number.size for table in others)
        remarks.append(f"{count} messages of other joints ignored: {', '.join(names)}")
    for what, given in (("positions", [t.q for t in ours]), ("efforts", [t.tau for t in ours])):
        if all(values is None for values in given):
            raise DataError(f"the messages on {messages.topic} have no {what} of {', '.join(match.names)}")
    times, clock = _times(messages.topic, ours)
    remarks += [clock] * bool(clock)
    stamps = np.unique(np.concatenate(times))
    shape = (2, stamps.size, robot.n)
    values, known = np.zeros(shape), np.zeros(shape, dtype=bool)
    repeated = 0
    for table, t in zip(ours, times, strict=True):
        repeated += _fill(values, known, np.searchsorted(stamps, t), table, match.names, messages.topic)
    if repeated:
        remarks.append(f"{repeated} messages on {messages.topic} repeat the one before: ignored")
    whole = known.all(axis=(0, 2))
    if not whole.any():
        raise DataError(
            f"no stamp on {messages.topic} has positions and efforts of all joints {', '.join(match.names)}: "
            "messages of different stamps are not joined"
        )
    if not whole.all():
        first = int(np.flatnonzero(~whole)[0])
        lacks = [name for k, name in enumerate(match.names) if not known[:, first, k].all()]
        remarks.append(
            f"{int((~whole).sum())} stamps without all joints are left out, the first "
            f"{(stamps[first] - stamps[0]) / _NS:.6g} s after the begin: without {', '.join(lacks)}"
        )
    return stamps[whole], values[0, whole], values[1, whole], clock, remarks


def _times(topic: str, tables: Sequence[MessageTable]) -> tuple[list[NDArray[np.int64]], str]:
    """Return the times of the messages of each table, and a sentence if they are not the stamps."""
    stamps = np.concatenate([table.stamp for table in tables])
    logged = np.concatenate([table.logged for table in tables])
    number = np.concatenate([table.number for table in tables])
    clock = ""
    unset = int((stamps == 0).sum())
    if unset == stamps.size:
        stamps, clock = logged, f"stamps on {topic} are not set: times are those of recording"
    elif unset and stamps.max() > SIMULATED_S * _NS:
        raise DataError(f"{unset} of {stamps.size} messages on {topic} have no stamp: their times are unknown")
    else:
        _refuse_other_unit(topic, stamps, logged)
    if (stamps < 0).any():
        raise DataError(f"message {number[stamps < 0][0]} on {topic} has a stamp before 1970")
    for order in (np.argsort(number), np.lexsort((number, logged))):
        back = np.maximum.accumulate(stamps[order]) - stamps[order]
        if back.max() <= LATEST_S * _NS:
            break
    else:
        k = int(np.flatnonzero(back > LATEST_S * _NS)[0])
        raise DataError(
            f"message {number[order][k]} on {topic} has a stamp {back[k] / _NS:.6g} s before that of an earlier one: "
            "the clock was set back, or the bag holds several runs"
        )
    _refuse_jump(topic, stamps[order], logged[order], number[order])
    ends = np.cumsum([table.number.size for table in tables])[:-1]
    return np.split(stamps, ends), clock


def _refuse_other_unit(topic: str, stamps: NDArray[np.int64], logged: NDArray[np.int64]) -> None:
    """Refuse stamps at a rate that no arm has, where the times of recording tell another one by orders of magnitude."""
    steps = [np.diff(np.unique(times)) / _NS for times in (stamps, logged)]
    if any(each.size < 2 for each in steps):
        return
    own, wall = (float(np.median(each)) for each in steps)
    if SLOWEST_HZ * own <= 1.0 <= FASTEST_HZ * own or not SLOWEST_HZ * wall <= 1.0 <= FASTEST_HZ * wall:
        return
    if max(own / wall, wall / own) > ANOTHER_UNIT:
        raise DataError(
            f"stamps on {topic} are {own:.6g} s apart ({1 / own:.6g} Hz), but were recorded every {wall:.6g} s "
            f"({1 / wall:.6g} Hz): they are not in s and ns; correct them where they are published"
        )


def _refuse_jump(topic: str, stamps: NDArray[np.int64], logged: NDArray[np.int64], number: NDArray[np.int64]) -> None:
    """Refuse stamps that jump ahead of the recorder's clock, where both otherwise advance alike."""
    steps, walls = np.diff(stamps) / _NS, np.diff(logged) / _NS
    ahead = steps - walls
    usual = steps < LATEST_S
    if not usual.any() or abs(walls[usual].sum() - steps[usual].sum()) > CLOCKS_DIFFER * steps[usual].sum():
        return
    k = int(np.argmax(ahead))
    if ahead[k] > max(LATEST_S, steps[k] / 2):
        raise DataError(
            f"message {number[k + 1]} on {topic} has a stamp {steps[k]:.6g} s after that of the one before, and was "
            f"recorded {walls[k]:.6g} s after it: the clock was set"
        )


def _fill(
    values: NDArray[np.float64],
    known: NDArray[np.bool_],
    rows: NDArray[np.intp],
    table: MessageTable,
    names: Iterable[str],
    topic: str,
) -> int:
    """Enter the joints of a table in ``values`` (2, N, n) at its rows; return the number of messages known before."""
    repeats = np.zeros(rows.size, dtype=bool)
    for k, name in enumerate(names):
        if name not in table.names:
            continue
        column = table.names.index(name)
        for part, given in enumerate((table.q, table.tau)):
            if given is None:
                continue
            # The last of several messages at one stamp is compared with the others, and with those of other tables.
            value = given[:, column]
            before, had = values[part, rows, k], known[part, rows, k]
            values[part, rows, k], known[part, rows, k] = value, True
            entered = values[part, rows, k]
            clash = (entered != value) & ~(np.isnan(entered) & np.isnan(value))
            clash |= had & (before != value) & ~(np.isnan(before) & np.isnan(value))
            if clash.any():
                raise DataError(
                    f"message {table.number[clash][0]} on {topic} has the stamp of another one and another value of "
                    f"{name}: two nodes send the same joint"
                )
            repeats |= had
    repeats[np.setdiff1d(np.arange(rows.size), np.unique(rows, return_index=True)[1])] = True
    return int(repeats.sum())


def write_joint_states(
    path: Path,
    joints: list[str],
    t_ns: NDArray[np.int64],
    columns: dict[str, NDArray[np.float64]],
) -> None:
    """Write positions ``q1..qn`` and efforts ``tau1..taun``, (N,) each, as joint states at times (N,), ns UTC."""
    q, tau = (
        np.stack([columns[f"{base}{j + 1}"] for j in range(len(joints))], axis=1) if f"{base}1" in columns else None
        for base in ("q", "tau")
    )
    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef(MESSAGE_TYPE, DEFINITION)
        for k, at in enumerate(t_ns.tolist()):
            message = {
                "header": {"stamp": {"sec": at // _NS, "nanosec": at % _NS}, "frame_id": ""},
                "name": joints,
                "position": [] if q is None else q[k].tolist(),
                "velocity": [],
                "effort": [] if tau is None else tau[k].tolist(),
            }
            writer.write_message(TOPIC, schema, message, at, at, k)
        writer.finish()
