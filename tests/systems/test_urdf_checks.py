"""URDFs that are accepted: what looks odd and is right; those that are not are in tests/attacks."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from pinn_dyn.systems.urdf import read_urdf
from pinn_dyn.systems.urdf_checks import parse_urdf
from tests.support.arm_urdf import ARM, changed


def parsed(*changes, **settings):
    return parse_urdf(Path("arm.urdf"), changed(*changes).encode(), **settings)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<robot ", "<!-- a comment --><robot "),
        ('ixx="0.09" ixy="0" ixz="0" iyy="0.05"', 'ixx="0.1" ixy="0" ixz="0" iyy="0"'),  # a rod
        ('ixx="0.09" ixy="0" ixz="0" iyy="0.05"', 'ixx="0.05" ixy="0" ixz="0" iyy="0.05"'),  # flat
        ('ixx="0.09" ixy="0"', 'ixx="0.09" ixy="-0.01"'),
        ('<axis xyz="0 1 0"/>', '<axis xyz=" 0\n1  0 "/>'),
        ('<axis xyz="0 1 0"/>', ""),
        ('type="fixed">', 'type="fixed"><axis xyz="0 0 0"/>'),  # as in the Panda's
        ('<origin xyz="0 0 -0.3"/>', '<origin rpy="0 0 1e-3"/>'),
    ],
)
def test_what_a_urdf_may_hold(old, new):
    assert len(parsed((old, new)).findall("joint")) == 3


def test_the_links_may_come_in_any_order():
    robot = ET.fromstring(ARM)
    robot[:] = reversed(list(robot))
    assert parse_urdf(Path("arm.urdf"), ET.tostring(robot)).tag == "robot"


def test_an_inertia_that_nobody_uses_may_be_anything():
    bad = ('ixx="0.09"', 'ixx="9"')
    with pytest.raises(ValueError, match="principal moments"):
        parsed(bad)
    parsed(bad, inertias=False)
    inertial = (
        '<inertial><mass value="1"/><inertia ixx="9" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    )
    parsed(('<link name="base"/>', f'<link name="base">{inertial}</inertial></link>'))


def test_an_axis_is_a_direction(tmp_path):
    """Bullet itself takes its length for a factor of the speed."""
    path = tmp_path / "arm.urdf"
    path.write_text(changed(('<axis xyz="0 1 0"/>', '<axis xyz="0 3 4"/>')))
    robot = ET.fromstring(read_urdf(path, [], "file").text)
    axis = robot.find("joint[@name='shoulder']/axis").get("xyz")
    np.testing.assert_allclose([float(x) for x in axis.split()], [0, 0.6, 0.8], rtol=1e-15)
    path.write_text(ARM)
    robot = ET.fromstring(read_urdf(path, [], "file").text)
    assert robot.find("joint[@name='shoulder']/axis").get("xyz") == "0 1 0"
