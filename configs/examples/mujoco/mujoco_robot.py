"""A MuJoCo arm as the program of `armident investigate --robot-command 'python mujoco_robot.py'`."""

import sys
import zlib

import mujoco
import numpy as np

MJCF = """
<mujoco>
  <option timestep="0.0001" integrator="implicitfast" gravity="0 -9.81 0"/>
  <default><joint axis="0 0 1"/></default>
  <worldbody>
    <body euler="0 0 -90">
      <joint name="shoulder" armature="0.3" damping="4"/>
      <inertial pos="0.2 0 0" mass="5" diaginertia="0.02 0.08 0.08"/>
      <body pos="0.4 0 0">
        <joint name="elbow" armature="0.1" damping="1.5" stiffness="6"/>
        <inertial pos="0.15 0 0" mass="2" diaginertia="0.005 0.02 0.02"/>
      </body>
    </body>
  </worldbody>
</mujoco>"""
KP, KD = np.array([4000.0, 1500.0]), np.array([250.0, 80.0])  # position loop of each drive, N m/rad and N m s/rad
DRY = np.array([3.0, 1.5])  # dry friction of each joint, N m; frictionloss of MuJoCo is soft near standstill
COUNT = 2.0 * np.pi / 2**20  # encoder, rad
NOISE = np.array([0.15, 0.05])  # standard deviation of the measured torque, N m


def play(t: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return positions and torques (N, 4) of the arm along references (N, 2), rad."""
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    data.qpos[:] = reference[0]
    mujoco.mj_forward(model, data)
    random = np.random.default_rng(zlib.crc32(reference.tobytes()))  # each motion has noise of its own
    speed, rows = np.gradient(reference, t, axis=0), []
    for wanted, qd in zip(reference, speed, strict=True):
        torque = KP * (wanted - data.qpos) + KD * (qd - data.qvel) + data.qfrc_bias
        rows.append([*np.round(data.qpos / COUNT) * COUNT, *torque + random.normal(0.0, NOISE)])
        for _ in range(round((t[1] - t[0]) / model.opt.timestep)):
            data.qfrc_applied[:] = torque - DRY * np.tanh(data.qvel / 0.001)
            mujoco.mj_step(model, data)
    return np.array(rows)


if __name__ == "__main__":
    table = np.loadtxt(sys.argv[1], delimiter=",", skiprows=1)
    answer = np.column_stack([table[:, 0], play(table[:, 0], table[:, 1:]), table[:, 1:]])
    np.savetxt(sys.argv[2], answer, "%.9g", delimiter=",", header="t,q1,q2,tau1,tau2,qr1,qr2", comments="")
