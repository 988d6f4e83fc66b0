"""The Panda that ships with PyBullet, and a pendulum as a URDF."""

import numpy as np

PANDA = "franka_panda/panda.urdf"
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")

# Two rods in the vertical x-z plane that turn about y, hanging at q = 0; an unequal inertia, walls,
# friction and a tool frame without <inertial>, none of which may matter.
PENDULUM = """<robot name="pendulum">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 -0.3"/><mass value="1.5"/>
    <inertia ixx="0.09" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.1"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0 0 -0.2"/><mass value="0.8"/>
    <inertia ixx="0.2" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.21"/></inertial></link>
  <link name="tool"/>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-0.1" upper="0.1" velocity="0.5" effort="30"/>
    <dynamics damping="7" friction="3"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 -0.5"/><axis xyz="0 1 0"/><limit velocity="4" effort="10"/></joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/></joint>
</robot>"""


def states(arm, count=4):
    rng = np.random.default_rng(0)
    q = rng.uniform(arm.q_low, arm.q_high, (count, arm.num_coordinates))
    return q, *(rng.uniform(-2, 2, (2, *q.shape)))
