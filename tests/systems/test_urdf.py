"""URDFs: odd ones that are right, wrong ones that are refused by name, and random damage."""

import xml.etree.ElementTree as ET

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.urdf import read_urdf
from tests.attacks.damage import byte_hits, hit, places
from tests.support.arm_urdf import ARM, changed

ELBOW = '<parent link="upper"/><child link="lower"/>'
INERTIAL = '<inertial><mass value="1"/><inertia ixx="9" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'


def joint(name, parent, child):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="fixed">{ends}</joint>'


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<robot ", "<!-- a comment --><robot "),
        ('ixx="0.09" ixy="0" ixz="0" iyy="0.05"', 'ixx="0.1" ixy="0" ixz="0" iyy="0"'),  # a rod
        ('ixx="0.09" ixy="0" ixz="0" iyy="0.05"', 'ixx="0.05" ixy="0" ixz="0" iyy="0.05"'),  # flat
        ('type="fixed">', 'type="fixed"><axis xyz="0 0 0"/>'),  # as in the Panda's
        ('<link name="base"/>', f'<link name="base">{INERTIAL}</inertial></link>'),  # does not move
    ],
)
def test_an_odd_urdf_may_be_right(old, new):
    assert read_urdf(changed((old, new))).joints == ["shoulder", "elbow"]


def test_the_links_may_come_in_any_order_and_an_axis_may_have_any_length():
    robot = ET.fromstring(changed(('<axis xyz="0 1 0"/>', '<axis xyz="0 3 4"/>')))
    robot[:] = sorted(robot, key=lambda element: element.tag)
    tree = read_urdf(ET.tostring(robot, encoding="unicode"))
    assert tree.axes[0].tolist() == pytest.approx([0, 0.6, 0.8])
    assert tree.limits[0].tolist() == [-1.5, 1.5, 0.5, 30]


WRONG = {
    "empty": (ARM, "", "is not valid XML"),
    "no joint": (ARM, '<robot name="x"><link name="a"/></robot>', "expected a <robot> with joints"),
    "two links of a name": ('name="lower"', 'name="upper"', "several links of the same name"),
    "an unknown parent": (ELBOW, '<parent link="uper"/><child link="lower"/>', "no joints lead"),
    "a circle": (
        "</robot>",
        f'<link name="a"/><link name="b"/>{joint("x", "a", "b")}{joint("y", "b", "a")}</robot>',
        r"no joints lead from the base 'base' to \['a', 'b'\]",
    ),
    "two parents": (
        "</robot>",
        joint("x", "base", "lower") + "</robot>",
        r"several parents \['lower'\]",
    ),
    "two roots": (
        "</robot>",
        '<link name="loose"/></robot>',
        r"without a parent are \['base', 'loose'\]",
    ),
    "an axis of two": ('"0 1 0"', '"0 1"', "<axis xyz='0 1'> of shoulder, expected 3 finite"),
    "an origin of commas": ('"0 0 -0.5"', '"0, 0, -0.5"', "<origin xyz='0, 0, -0.5'> of elbow"),
    "a centre of one": ('"0 0 -0.3"', '"-0.3"', "<origin xyz='-0.3'>"),
    "a negative mass": ('value="1.5"', 'value="-1.5"', "link 'upper' has mass -1.5 kg"),
    "a mass in words": ('value="1.5"', 'value="1.5 kg"', "<mass value='1.5 kg'>"),
    "a missing product": ('iyz="0"', "", "<inertia iyz=''>"),
    "no triangle": ('ixx="0.09"', 'ixx="0.2"', "no moment larger than the sum of the other two"),
    "a mimic joint": (
        'continuous">',
        'continuous"><mimic joint="shoulder"/>',
        "'elbow' is a mimic joint, expected .* add it to locked_joints",
    ),
    "a floating joint": ('"continuous"', '"floating"', "'elbow' is 'floating', expected revolute"),
}


@pytest.mark.parametrize(("old", "new", "message"), WRONG.values(), ids=WRONG)
def test_a_robot_that_cannot_be_is_refused_by_name(tmp_path, old, new, message):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as error:
        read_urdf(str(path))
    assert str(path) in str(error.value)


TEXTS = ["", "base", "upper", "0", "-1", "1e300", "nan", "0 0 0", "1,2,3", "fixed", "prismatic"]


@given(
    st.lists(st.tuples(places, places, st.sampled_from(TEXTS)), min_size=1, max_size=4),
    byte_hits(0, 1),
)
def test_a_damaged_robot_is_refused_by_name_or_has_positive_mass(tmp_path_factory, edits, hits):
    robot = ET.fromstring(ARM)
    for where, which, text in edits:
        elements = [element for element in robot.iter() if element.attrib]
        element = elements[where % len(elements)]
        names = list(element.attrib)
        element.set(names[which % len(names)], text)
    path = tmp_path_factory.mktemp("urdf") / "arm.urdf"
    path.write_bytes(hit(ET.tostring(robot, encoding="utf-8"), hits))
    try:
        chain = RigidChain(str(path))
    except ValueError as error:
        message = str(error)
    except KeyError:  # a joint that leads to no link
        return
    else:
        mass = chain.mass_matrix(torch.full((chain.num_coordinates,), 0.3, dtype=torch.float64))
        assert torch.linalg.eigvalsh(mass)[0] > -1e-9 * float(mass.abs().max())
        message = str(path)
    assert str(path) in message
