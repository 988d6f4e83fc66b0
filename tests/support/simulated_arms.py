"""The Panda, and a pendulum as a URDF, for every simulator."""

import numpy as np
import pytest

from pinn_dyn import systems
from tests.support.arm_urdf import changed

PANDA = "franka_panda/panda.urdf"
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")

# Two rods in the vertical x-z plane that turn about y, hanging at q = 0; an unequal inertia, walls,
# friction and a tool frame without <inertial>, none of which may matter.
PENDULUM = changed(
    (
        'lower="-1.5" upper="1.5" velocity="0.5" effort="30"/>',
        'lower="-0.1" upper="0.1" velocity="0.5" effort="30"/><dynamics damping="7" friction="3"/>',
    ),
    ('<axis xyz="1 0 0"/>', '<axis xyz="0 1 0"/><limit velocity="4" effort="10"/>'),
)

SIMULATORS = ["MujocoArm", pytest.param("BulletArm", marks=pytest.mark.panda)]


def simulated_by(name):
    """The class of a simulated arm; skip a test without its simulator."""
    kind = getattr(systems, name)
    pytest.importorskip(kind.simulator, reason=kind.install)
    return kind


def states(arm, count=4):
    rng = np.random.default_rng(0)
    q = rng.uniform(arm.q_low, arm.q_high, (count, arm.num_coordinates))
    return q, *(rng.uniform(-2, 2, (2, *q.shape)))


# Skew axes, turned frames and products of inertia.
SPATIAL = """<robot name="spatial">
  <link name="base"/>
  <link name="one"><inertial><origin xyz="0.1 0.02 -0.3" rpy="0.3 -0.5 1.1"/><mass value="1.5"/>
    <inertia ixx="0.09" ixy="0.01" ixz="-0.015" iyy="0.07" iyz="0.02" izz="0.1"/></inertial></link>
  <link name="two"><inertial><origin xyz="0 0.1 -0.2" rpy="-0.7 0.2 0.4"/><mass value="0.8"/>
    <inertia ixx="0.05" ixy="-0.01" ixz="0.005" iyy="0.04" iyz="0.01" izz="0.06"/></inertial></link>
  <joint name="a" type="revolute"><parent link="base"/><child link="one"/>
    <origin rpy="0.4 0.1 -0.3"/><axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <joint name="b" type="revolute"><parent link="one"/><child link="two"/>
    <origin xyz="0.1 0.2 -0.5" rpy="-1.2 0.5 0.2"/><axis xyz="0.6 0 0.8"/>
    <limit lower="-2" upper="2"/></joint>
</robot>"""
