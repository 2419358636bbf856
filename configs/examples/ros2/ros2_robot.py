"""A ROS 2 arm (FollowJointTrajectory, /joint_states) as the program of `armident investigate --robot-command`."""

import sys

import numpy as np

JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
ACTION = "/joint_trajectory_controller/follow_joint_trajectory"
APPROACH_S = 10.0  # time to the first row, s


def answer(t, states):
    """Return times, positions and efforts (N, 1 + 2 n) at times t (N,), s from the first state."""
    stamps = np.array([s.header.stamp.sec + 1e-9 * s.header.stamp.nanosec for s in states])
    order = [[list(s.name).index(joint) for joint in JOINTS] for s in states]
    if any(len(s.effort) < len(s.name) for s in states):
        sys.exit("/joint_states has no efforts: add an effort state interface to the controller")
    values = [[*np.take(s.position, k), *np.take(s.effort, k)] for s, k in zip(states, order, strict=True)]
    return np.column_stack([t, *(np.interp(t, stamps - stamps[0], column) for column in np.transpose(values))])


def play(table):
    """Move the arm along the rows of a table (N, 1 + n) and return the joint states of the motion; exit if refused."""
    import rclpy
    from control_msgs.action import FollowJointTrajectory
    from rclpy.action import ActionClient
    from rclpy.duration import Duration
    from sensor_msgs.msg import JointState
    from trajectory_msgs.msg import JointTrajectoryPoint

    rclpy.init()
    node, states = rclpy.create_node("armident"), []
    client = ActionClient(node, FollowJointTrajectory, ACTION)
    if not client.wait_for_server(timeout_sec=5.0):
        sys.exit(f"no controller answers at {ACTION}")
    node.create_subscription(JointState, "/joint_states", states.append, 100)
    for rows in ([[APPROACH_S, *table[0, 1:]]], table):
        goal = FollowJointTrajectory.Goal()
        goal.trajectory.joint_names = list(JOINTS)
        goal.trajectory.points = [
            JointTrajectoryPoint(positions=list(q), time_from_start=Duration(seconds=t).to_msg()) for t, *q in rows
        ]
        states.clear()
        sent = client.send_goal_async(goal)
        rclpy.spin_until_future_complete(node, sent)
        if not sent.result().accepted:
            sys.exit("the controller rejected the trajectory")
        done = sent.result().get_result_async()
        rclpy.spin_until_future_complete(node, done)
        if done.result().result.error_code != FollowJointTrajectory.Result.SUCCESSFUL:
            sys.exit(f"the controller stopped: {done.result().result.error_string}")
    return states


if __name__ == "__main__":
    table = np.loadtxt(sys.argv[1], delimiter=",", skiprows=1)
    names = ["t", *(f"{kind}{j + 1}" for kind in ("q", "tau") for j in range(len(JOINTS)))]
    np.savetxt(sys.argv[2], answer(table[:, 0], play(table)), "%.9g", ",", header=",".join(names), comments="")
