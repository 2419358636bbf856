"""Diagnoses by the hundred: ``python -m armident.identify.diagnosis.batch`` answers one request a line.

Requests are ``{do: diagnose, recording, robot, leave_out, baseline}``, answered by the document of the diagnosis, and
``{do: identify, recording, robot, out}``, which writes ``identification.json``.
"""

import json
import time
from pathlib import Path

from armident.configs import ConfigError, RobotConfig, load_robot
from armident.configs.exchange import Document, serve
from armident.daq.recording import read_recording
from armident.identify.document import IdentificationDocument, load_document, reference, to_json, write_atomically
from armident.identify.identification.from_recording import experiments_from_recording


def reduced(robot: RobotConfig, leave_out: str | None, joints: list[str]) -> RobotConfig:
    """The robot without what its model is to lack.

    Raises
    ------
    ConfigError
        If there is no such part.
    """
    if leave_out is None:
        return robot
    if leave_out == "couplings":
        return robot.model_copy(update={"couplings": ()})
    if leave_out == "rotor_inertia":
        changed = tuple(
            joint.model_copy(update={"rotor_inertia": False}) if joint.name in joints else joint
            for joint in robot.joints
        )
        known = {
            name: value
            for name, value in robot.initial_parameters.items()
            if not any(name == f"ia{k}" and joint.name in joints for k, joint in enumerate(robot.joints, 1))
        }
        return robot.model_copy(update={"joints": changed, "initial_parameters": known})
    raise ConfigError(f"leave_out: expected rotor_inertia or couplings, found {leave_out!r}")


def answer(request: Document) -> Document:
    """Diagnose or identify one recording.

    Raises
    ------
    ConfigError, DataError
        If the request is unknown, or the recording cannot support it.
    """
    begin = time.perf_counter()
    robot = reduced(load_robot(request["robot"]), request.get("leave_out"), request.get("joints", []))
    recording = read_recording(Path(request["recording"]))
    if request["do"] == "identify":
        from armident.identify.identification.api import identify_recording

        document = identify_recording(recording, robot).document
        write_atomically(Path(request["out"]), to_json(document))
        return {"identification": request["out"], "seconds": time.perf_counter() - begin}
    if request["do"] != "diagnose":
        raise ConfigError(f"do: expected diagnose or identify, found {request['do']!r}")
    from armident.identify.diagnosis.diagnose import diagnose

    baseline = request.get("baseline")
    numbers = None if baseline is None else load_document(Path(baseline), IdentificationDocument)
    experiments, notes = experiments_from_recording(recording, robot)
    found = diagnose(experiments, [], robot, [reference(recording)], numbers, notes)
    return {"document": json.loads(to_json(found.document)), "seconds": time.perf_counter() - begin}


if __name__ == "__main__":
    serve(answer)
