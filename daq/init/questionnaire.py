"""Questions of ``armident init`` on a terminal; an answer left empty takes the default, or leaves a blank."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from armident.daq.init.geometry import URDF_SUFFIXES, name_from
from armident.daq.init.initialize import InitOptions
from armident.daq.interchange.readers import names_of_formats

Ask = Callable[[str, str], str]
"""Function that shows a question with its default and returns the answer."""

_POSTURES = {
    "floor": (0.0, 0.0, -9.81),
    "ceiling": (0.0, 0.0, 9.81),
    "wall": None,
}
"""Acceleration of gravity in the frame of the base by its mounting; on a wall it depends on the turn of the base."""


def questionnaire(options: InitOptions, ask: Ask, tell: Callable[[str], None]) -> InitOptions:
    """Options completed by answers of ``ask`` (question, default) where they state nothing; ``tell`` shows a line."""
    tell("Enter takes the value in brackets. What you do not know stays a blank that is listed at the end.")
    source = ask("URDF, table of DH parameters, or robot of the library (ur5e, panda, ...); empty: none", "")
    options = replace(options, **_source(source, ask))
    recording = ask(f"Recording of the arm ({names_of_formats()}); empty: none", "")
    changes: dict[str, Any] = {"recording": Path(recording) if recording else None}
    if not recording:
        question = "Effort that the drives report: torque, current or voltage"
        changes["signal"] = _choice(ask, tell, question, "torque", ("torque", "current", "voltage"))
    sensors = _choice(ask, tell, "Torque sensors behind the gears: yes or no", "no", ("no", "yes"))
    changes["link_torques"] = sensors == "yes"
    mount = _choice(ask, tell, "Mounting of the base: floor, ceiling or wall", "floor", tuple(_POSTURES))
    gravity = _POSTURES[mount]
    if gravity is None:
        gravity = _vector(ask, tell, "Gravity in the frame of the base, X,Y,Z in m/s^2", "0,-9.81,0")
    changes["gravity"] = gravity
    changes["cell"] = {**options.cell, **_cell(ask, tell)}
    folder = ask("Folder of the files", name_from(Path(source).stem) if source else "arm")
    return replace(options, out=Path(folder), **changes)


def _source(source: str, ask: Ask) -> dict[str, Any]:
    suffix = Path(source).suffix.lower()
    if not source:
        return {"axes": _number(ask, "Number of joints", "6")}
    if suffix in (".csv", ".txt", ".tsv"):
        return {"dh": Path(source)}
    return {"urdf": Path(source)} if suffix in URDF_SUFFIXES else {"robot": source}


def _number(ask: Ask, question: str, default: str) -> int:
    answer = ask(question, default)
    while not answer.strip().isdecimal() or int(answer) == 0:
        answer = ask(f"{question}, a whole number", default)
    return int(answer)


def _choice(ask: Ask, tell: Callable[[str], None], question: str, default: str, choices: tuple[str, ...]) -> str:
    """First choice that begins with the answer."""
    while True:
        answer = ask(question, default).strip().lower()
        found = [choice for choice in choices if answer and choice.startswith(answer)]
        if found:
            return found[0]
        tell(f"expected one of {', '.join(choices)}")


def _vector(ask: Ask, tell: Callable[[str], None], question: str, default: str) -> tuple[float, float, float]:
    while True:
        try:
            x, y, z = (float(word) for word in ask(question, default).split(","))
        except ValueError:
            tell("expected three numbers, X,Y,Z")
            continue
        return x, y, z


def _cell(ask: Ask, tell: Callable[[str], None]) -> dict[str, Any]:
    """Facts of the cell; nothing if there are no drives on a bus yet."""
    if _choice(ask, tell, "Drives with CANopen: yes or no", "no", ("no", "yes")) == "no":
        return {}
    found: dict[str, Any] = {}
    for key, question in (
        ("channel", "CAN interface, such as can0; empty: not known"),
        ("bitrate", "Bit rate, bit/s, 0 for a virtual bus; empty: not known"),
        ("node_ids", "Node ids of the joints, base to tip: 1,2,...; empty: not known"),
        ("eds", "Electronic data sheet of the drives; empty: not known"),
    ):
        answer = ask(question, "")
        while key in ("bitrate", "node_ids") and answer.replace(",", "").replace(" ", "").strip("0123456789"):
            answer = ask(f"{question} (whole numbers)", "")
        if answer.strip():
            found[key] = answer
    if "bitrate" in found:
        found["bitrate"] = int(found["bitrate"])
    if "node_ids" in found:
        found["node_ids"] = [int(word) for word in found["node_ids"].split(",") if word.strip()]
    return found
