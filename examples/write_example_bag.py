"""Write a bag as a laboratory would record it: a simulated arm of two joints whose torques act
30 ms after they are commanded; joint states with noise, on a clock that jitters, in MCAP.

    python examples/write_example_bag.py [folder]
"""

import sys
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from pinn_dyn.data import MultiSine
from pinn_dyn.data.simulation import simulate
from pinn_dyn.systems import RigidChain

SECONDS, RATE, DELAY, SEED = 60, 100, 0.03, 0
STARTED = 1_764_000_000  # s since 1970
ROD = """<link name="{name}"><inertial><origin xyz="0 0 -0.2"/><mass value="{mass}"/>
  <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.002"/></inertial></link>"""
URDF = f"""<robot name="arm"><link name="base"/>
  {ROD.format(name="upper", mass=1.2)}{ROD.format(name="lower", mass=0.7)}
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/></joint></robot>"""


def main(folder: Path) -> None:
    rng = np.random.default_rng(SEED)
    sines = MultiSine(offset=[0, 0], amplitude=[4.0, 1.2], frequency=[0.1, 1.5], harmonics=8)
    torque = sines.draw(1, SECONDS, rng)
    t = np.arange(SECONDS * RATE) / RATE
    stamps = t + rng.uniform(0, 1e-3, len(t))
    arm, rest = RigidChain(URDF, damping=[0.4, 0.2]), np.zeros((1, 2))
    q, v = simulate(arm, rest, rest, lambda s: torque(s - DELAY), stamps, rtol=1e-6, atol=1e-7)
    q = q[0] + 2e-4 * rng.normal(size=q[0].shape)
    v = v[0] + 1e-2 * rng.normal(size=v[0].shape)

    store = get_typestore(Stores.ROS2_HUMBLE)
    state, header, time, array, layout = (
        store.types[f"{package}/msg/{name}"]
        for package, name in (
            ("sensor_msgs", "JointState"),
            ("std_msgs", "Header"),
            ("builtin_interfaces", "Time"),
            ("std_msgs", "Float64MultiArray"),
            ("std_msgs", "MultiArrayLayout"),
        )
    )
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        states, commands = (
            writer.add_connection(topic, kind.__msgtype__, typestore=store)
            for topic, kind in (("/joint_states", state), ("/commands", array))
        )
        for k in range(len(t)):
            # The joints are in no particular order: their names tell.
            at = STARTED + np.array([t[k], stamps[k]])
            stamp = time(sec=int(at[1]), nanosec=int(1e9 * (at[1] % 1)))
            joints = ["elbow", "shoulder"], q[k, ::-1].copy(), v[k, ::-1].copy(), np.zeros(0)
            message = state(header(stamp, ""), *joints)
            command = array(layout([], 0), torque(t[k : k + 1])[0, 0].copy())
            for connection, one, when in ((commands, command, at[0]), (states, message, at[1])):
                raw = store.serialize_cdr(one, connection.msgtype)
                writer.write(connection, int(1e9 * when), raw)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("example_bag"))
