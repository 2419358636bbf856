"""Exported files in the programs that read them: the torques that each computes along a motion."""

import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from armident.configs import ConfigError
from armident.identify.documents.base import versions
from armident.identify.model_export.code_writer import code_of
from armident.identify.model_export.exported_model import ExportedModel
from armident.identify.model_export.fmu_writer import GEAR_STEP_S, compiled
from armident.identify.model_export.sdf_writer import joint_name
from armident.identify.robot.chain import Floats

PRESCRIBED = 1e6
"""Inertia that makes the motors of a simulated arm follow a motion whatever acts on them, kg m^2 or kg."""

PACED = 1000
"""Calls of the C source that are timed at 1 kHz."""

NEAR = 0.05
"""Miss of an acceleration, relative to itself and 1 rad/s^2 (m/s^2), that the mass matrix of this sample corrects."""

LEROBOT_S = 0.02
"""Period of a loop of LeRobot with a follower arm, s: its recordings have 30 to 60 Hz."""


class NoProgramError(Exception):
    """The program that reads a format is missing; the message is the reason."""


@dataclass(frozen=True, eq=False)
class GivenMotion:
    """Motion of N samples: positions, derivatives (N, n), rad or m; period, s; title; torques that were recorded."""

    q: Floats
    qd: Floats
    qdd: Floats
    dt: float
    title: str
    recorded: Floats | None = None

    @property
    def rows(self) -> "zip[tuple[Floats, Floats, Floats]]":
        """Positions, velocities and accelerations (n,) of one instant after the other."""
        return zip(self.q, self.qd, self.qdd, strict=True)


@dataclass(frozen=True, eq=False)
class ProgramRun:
    """Torques (N, n) that a program computes at every ``every``-th instant, N m or N; ``remark``: further findings.

    ``dry``: its own dry friction in them.
    """

    program: str
    torque: Floats
    remark: str = ""
    every: int = 1
    dry: Floats | float = 0.0


def run_python(model: ExportedModel, files: Sequence[Path], motion: GivenMotion) -> ProgramRun:
    """Call the Python module."""
    return ProgramRun(f"Python {versions()['python']}", module_torque(files[0], motion, "inverse_dynamics"))


def module_torque(file: Path, motion: GivenMotion, function: str = "supplement") -> Floats:
    """Return the torques (N, n) by a function of a Python module."""
    module, torque = _module(file), []
    memory = [0.0] * getattr(module, "MEMORY", 0)
    for row in motion.rows:
        q, qd, qdd = (x.tolist() for x in row)
        memory = module.advance(memory, q, qd, qdd, motion.dt) if memory else memory
        torque.append(getattr(module, function)(q, qd, qdd, *([memory] if memory else ())))
    return np.array(torque)


def run_c(model: ExportedModel, files: Sequence[Path], motion: GivenMotion) -> ProgramRun:
    """Compile the C source and call it, first at 1 kHz."""
    code = code_of(model, "c")
    sources = {f"{code.name}.c": files[0], f"{code.name}.h": files[1]}
    texts = {name: file.read_text(encoding="utf-8") for name, file in sources.items()}
    texts["run.c"] = code.render("run.c.jinja", paced=PACED, dt=motion.dt)
    with tempfile.TemporaryDirectory() as folder:
        try:
            program = compiled(texts, Path(folder), "run", ("-std=c99", "-O2"))
        except ConfigError as error:
            raise NoProgramError(str(error)) from error
        given = np.hstack([motion.q, motion.qd, motion.qdd]).tobytes()
        done = subprocess.run([program], input=given, capture_output=True, check=True)
    rows = np.frombuffer(done.stdout).reshape(-1, model.arm.n + 1)
    middle, late = np.quantile(rows[:PACED, -1], [0.5, 0.999])
    timed = f"a call at 1 kHz takes {middle:.0f} ns (median), and 99.9 % of the calls take less than {late:.0f} ns"
    return ProgramRun("C99", rows[:, :-1], timed)


def run_lerobot(model: ExportedModel, files: Sequence[Path], motion: GivenMotion) -> ProgramRun:
    """Call the module with positions alone, in degrees and at the rate of a loop of LeRobot."""
    module, torque = _module(files[0]), []
    every = max(round(LEROBOT_S / motion.dt), 1)
    feed = module.FeedForward(every * motion.dt)
    units = [1.0 if joint.type == "prismatic" else 180.0 / np.pi for joint in model.joints]
    for q in (motion.q * units)[::every].tolist():
        found = feed({f"{joint.name}.pos": value for joint, value in zip(model.joints, q, strict=True)})
        torque.append([found[f"{joint.name}.torque"] for joint in model.joints])
    remark = f"the module was given positions alone, at {1.0 / (every * motion.dt):.0f} Hz"
    return ProgramRun(f"Python {versions()['python']}", np.array(torque), remark, every)


def _module(file: Path) -> ModuleType:
    """Execute a Python file as a module."""
    module = ModuleType(file.stem)
    exec(compile(file.read_text(encoding="utf-8"), str(file), "exec"), vars(module))
    return module


def run_fmu(model: ExportedModel, files: Sequence[Path], motion: GivenMotion, torque: Floats) -> ProgramRun:
    """Let the unit follow a motion: find the torques of its accelerations, near ``torque`` (N, n)."""
    fmpy, fmi2 = _package("fmpy"), _package("fmpy.fmi2", "fmpy")
    n, needed, content = model.arm.n, np.zeros_like(torque), code_of(model, "fmu").content
    # Impacts in a gear are shorter than a sample: their mean torque counts.
    parts = int(np.ceil(motion.dt / GEAR_STEP_S)) if content["gears"] else 1
    step = motion.dt / parts
    description = fmpy.read_model_description(str(files[0]))
    with tempfile.TemporaryDirectory() as folder:
        unit = fmi2.FMU2Slave(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(files[0]), unzipdir=folder),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="arm",
        )
        unit.instantiate()
        unit.setupExperiment(startTime=0.0)
        unit.enterInitializationMode()
        unit.exitInitializationMode()
        # Torques, positions, velocities and accelerations; lists of FMPy would take more time than the unit.
        references, numbers = (fmi2.fmi2ValueReference * (4 * n))(*range(4 * n)), (fmi2.fmi2Real * (4 * n))()
        values = np.frombuffer(numbers)

        def give(state: Floats, tau: Floats) -> None:
            values[:n], values[n : 3 * n] = tau, state
            unit.fmi2SetReal(unit.component, references, 3 * n, numbers)

        def acceleration(state: Floats, tau: Floats) -> Floats:
            give(state, tau)
            unit.fmi2GetReal(unit.component, references, 4 * n, numbers)
            return values[3 * n :].copy()

        def driving(state: Floats, tau: Floats, wanted: Floats) -> Floats:
            """Return the torques of an acceleration, near ``tau``; ``inverse``: of their mass matrix."""
            found = acceleration(state, tau)
            if not inverse.any() or np.abs(found - wanted).max() > NEAR * (1.0 + np.abs(wanted).max()):
                columns = [acceleration(state, tau + of_joint) - found for of_joint in np.eye(n)]
                inverse[:] = np.linalg.inv(np.transpose(columns))
            result: Floats = tau + inverse @ (wanted - found)
            return result

        inverse = np.zeros((n, n))
        for k, (q, qd, qdd) in enumerate(motion.rows):
            here, change = np.concatenate([q, qd]), np.concatenate([qd, qdd])
            tau, inverse[:] = torque[k], 0.0
            for s in step * (np.arange(parts) + 0.5 * (1 - parts)):
                tau = driving(here + s * change, tau, qdd)
                needed[k] += tau / parts
                if content["memory"] or content["gears"]:  # nothing else is carried from one instant to the next
                    # At the end of the step, where states advance, the acceleration is the given one.
                    later = driving(here + (s + step) * change, tau, qdd)
                    give(here + s * change, later)
                    unit.doStep(currentCommunicationPoint=k * motion.dt + s, communicationStepSize=step)
        unit.terminate()
        unit.freeInstance()
    return ProgramRun(f"FMPy {version('fmpy')}", needed)


def run_mjcf(model: ExportedModel, files: Sequence[Path], motion: GivenMotion) -> ProgramRun:
    """Let MuJoCo compute the inputs of the actuators; what turns behind a gear moves freely."""
    mujoco = _package("mujoco")
    try:
        arm, moved = (mujoco.MjModel.from_xml_path(str(files[0])) for _ in range(2))
    except ValueError as error:  # of an older version
        raise NoProgramError(f"MuJoCo {mujoco.__version__} cannot read it: {str(error).splitlines()[0]}") from error
    arm.opt.timestep = moved.opt.timestep = motion.dt
    dofs = [arm.joint(joint.name).dofadr[0] for joint in model.joints]
    moved.dof_armature[dofs] = PRESCRIBED
    data, free, torque = mujoco.MjData(arm), mujoco.MjData(moved), np.zeros_like(motion.q)
    for k, (q, qd, qdd) in enumerate(motion.rows):
        free.qpos[dofs], free.qvel[dofs] = q, qd
        free.qfrc_applied[dofs] = PRESCRIBED * qdd
        mujoco.mj_forward(moved, free)
        data.qpos[:], data.qvel[:], data.act[:] = free.qpos, free.qvel, free.act
        mujoco.mj_forward(arm, data)
        passive = data.qfrc_actuator.copy()
        data.qacc[:] = free.qacc
        data.qacc[dofs] = qdd
        mujoco.mj_inverse(arm, data)
        torque[k] = (data.qfrc_inverse - passive)[dofs]
        mujoco.mj_step(moved, free)
    return ProgramRun(f"MuJoCo {mujoco.__version__}", torque)


def run_urdf(model: ExportedModel, files: Sequence[Path], motion: GivenMotion) -> ProgramRun:
    """Let Pinocchio compute the torques, gravity set."""
    pin = _package("pinocchio", "pin")
    arm = pin.buildModelFromUrdf(str(files[0]))
    arm.gravity.linear = model.frames.gravity
    return _pinocchio(pin, arm, motion)


def run_pinocchio(model: ExportedModel, files: Sequence[Path], motion: GivenMotion) -> ProgramRun:
    """Let Pinocchio compute the torques of its archive."""
    pin = _package("pinocchio", "pin")
    arm = pin.Model()
    arm.loadFromXML(str(files[0]), "model")
    return _pinocchio(pin, arm, motion)


def _pinocchio(pin: Any, arm: Any, motion: GivenMotion) -> ProgramRun:
    """Return the torques by the recursive algorithm, with friction and damping of the file as simulators add them."""
    data, neutral = arm.createData(), pin.neutral(arm)
    rows = [pin.rnea(arm, data, pin.integrate(arm, neutral, q), qd, qdd) for q, qd, qdd in motion.rows]
    dry = arm.friction * np.sign(motion.qd)
    return ProgramRun(f"Pinocchio {pin.__version__}", np.array(rows) + arm.damping * motion.qd + dry, dry=dry)


def run_sdf(model: ExportedModel, files: Sequence[Path], motion: GivenMotion) -> ProgramRun:
    """Let Drake compute the torques, gravity set; what turns behind a gear moves freely."""
    parsing, plants, tree = (_package(f"pydrake.multibody.{part}", "drake") for part in ("parsing", "plant", "tree"))
    analysis = _package("pydrake.systems.analysis", "drake")
    plant = plants.MultibodyPlant(time_step=0.0)
    parsing.Parser(plant).AddModels(str(files[0]))
    plant.mutable_gravity_field().set_gravity_vector(model.frames.gravity)
    plant.Finalize()
    context, free, rows = plant.CreateDefaultContext(), plant.CreateDefaultContext(), []
    order = [plant.GetJointByName(joint_name(model, k)).velocity_start() for k in range(model.arm.n)]
    q, qd, qdd, force = np.zeros((4, plant.num_velocities()))
    behind = np.delete(np.arange(q.size), order)
    for k in plant.GetJointActuatorIndices():
        plant.get_joint_actuator(k).SetRotorInertia(free, PRESCRIBED)
    simulator = analysis.Simulator(plant, free)
    for row in motion.rows:
        q[order], qd[order], qdd[order] = row
        if behind.size:
            force[order] = PRESCRIBED * row[2]
            plant.get_applied_generalized_force_input_port().FixValue(free, force)
            plant.SetPositionsAndVelocities(free, np.concatenate([q, qd]))
            qdd[behind] = plant.EvalTimeDerivatives(free).CopyToVector()[q.size :][behind]
        plant.SetPositions(context, q)
        plant.SetVelocities(context, qd)
        forces = tree.MultibodyForces(plant)
        plant.CalcForceElementsContribution(context, forces)
        rows.append(plant.CalcInverseDynamics(context, qdd, forces)[order])
        if behind.size:
            simulator.AdvanceTo(free.get_time() + motion.dt)
            q[behind], qd[behind] = plant.GetPositions(free)[behind], plant.GetVelocities(free)[behind]
    return ProgramRun(f"Drake {version('drake')}", np.array(rows))


def _package(module: str, package: str = "") -> Any:
    """Import a module; `NoProgramError` names its package where it is not installed."""
    try:
        return import_module(module)
    except ImportError as error:
        raise NoProgramError(f"{package or module} is not installed") from error
