"""URDFs: odd ones that are right, wrong ones that are refused by name, and random damage."""

import math
import xml.etree.ElementTree as ET

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pinn_dyn.systems import RigidChain, robot_files
from pinn_dyn.systems.urdf import read_urdf, urdf_text
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
        ("<link", '<x:arg name="n" xmlns:x="http://wiki.ros.org/xacro"/><link'),
        ("<link", '<xacro:property name="m" value="${n}"/><drake:joint drake:k="1"/><link'),
        ('<link name="base"/>', f'<link name="base">{INERTIAL}</inertial></link>'),  # does not move
        ('<link name="base"/>', f'<link name="base"/>{joint("weld", "world", "base")}'),  # Drake's
    ],
)
def test_an_odd_urdf_may_be_right(old, new):
    assert read_urdf(changed((old, new))).joints == ["shoulder", "elbow"]


def test_a_path_of_any_characters_is_found_again_behind_the_text_of_a_run(tmp_path):
    """Two hyphens would end the comment that holds it."""
    file = tmp_path / "a--b -->[é]<robot/>.urdf".replace("/", "_")
    file.write_text(ARM)
    arm = RigidChain(urdf_text(str(file)))
    assert robot_files._file(arm).path == file


def test_the_links_may_come_in_any_order_and_an_axis_may_have_any_length():
    robot = ET.fromstring(changed(('<axis xyz="0 1 0"/>', '<axis xyz="0 3 4"/>')))
    robot[:] = sorted(robot, key=lambda element: element.tag)
    tree = read_urdf(ET.tostring(robot, encoding="unicode"))
    assert tree.axes[0].tolist() == pytest.approx([0, 0.6, 0.8])
    assert tree.limits[0].tolist() == [-1.5, 1.5, 0.5, 30]
    assert tree.limits[1, :2].tolist() == [-math.pi, math.pi]


WRONG = {
    "a web page": (ARM, "<!DOCTYPE html><html><br></html>", "it is a web page"),
    "SDF": (
        ARM,
        '<sdf version="1.9"><model name="x"/></sdf>',
        "is XML with the root <sdf>, expected the URDF",
    ),
    "xacro": ("<link", '<x:arm xmlns:x="http://wiki.ros.org/xacro"/><link', "is a xacro file"),
    "a xacro number": ('value="1.5"', 'value="${m}"', "is a xacro file"),
    "an unknown parent": (ELBOW, ELBOW.replace("upper", "uper"), r"the links \['uper'\]"),
    "a circle": (
        "</robot>",
        f'<link name="a"/><link name="b"/>{joint("x", "a", "b")}{joint("y", "b", "a")}</robot>',
        r"no joints lead from a base to the links \['a', 'b'\]",
    ),
    "two parents": (
        "</robot>",
        joint("x", "base", "lower") + "</robot>",
        r"the links \['lower'\] have several parents",
    ),
    "a type": (
        '"continuous"',
        '"continous"',
        "'elbow' has the type 'continous', expected revolute",
    ),
    "a factor": (
        'continuous">',
        'continuous"><mimic joint="shoulder" multiplier="x"/>',
        "<mimic multiplier='x'> of elbow",
    ),
}


@pytest.mark.parametrize(("old", "new", "message"), WRONG.values(), ids=WRONG)
def test_a_robot_that_cannot_be_is_refused_by_name(tmp_path, old, new, message):
    path = tmp_path / "arm.urdf"
    path.write_text(ARM.replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as error:
        read_urdf(str(path))
    assert str(path) in str(error.value)


def test_all_mistakes_are_in_a_line():
    text = changed(('"0 1 0"', '"0 1"'), ('"0 0 -0.5"', '"low"'), ('"continuous"', '"turning"'))
    with pytest.raises(ValueError, match=r"<axis.*'0 1'.*<origin.*'low'.*'turning'") as error:
        read_urdf(text)
    assert "\n" not in str(error.value)


ENCODED = {
    "a byte order mark": ARM.encode("utf-8-sig"),
    "UTF-16 that states UTF-8": f'<?xml version="1.0" encoding="utf-8"?>{ARM}'.encode("utf-16"),
    "Windows-1252": ARM.replace("<link", "<!-- K\xf6rper --><link", 1).encode("cp1252"),
    "a namespace": ARM.replace("<robot", '<robot xmlns="https://drake.mit.edu"', 1).encode(),
    "commas": ARM.replace('"0 0 -0.5"', '"0, 0, -0.5"').encode(),
}


@pytest.mark.parametrize("content", ENCODED.values(), ids=ENCODED)
def test_a_file_is_read_as_editors_and_tools_write_it(tmp_path, content):
    (tmp_path / "arm.urdf").write_bytes(content)
    text = urdf_text(str(tmp_path / "arm.urdf"))
    for tree in (read_urdf(str(tmp_path / "arm.urdf")), read_urdf(text)):
        assert tree.joints == ["shoulder", "elbow"]
        assert tree.placements[1, :3, 3].tolist() == [0, 0, -0.5]


UNUSED = {
    "no triangle": ('ixx="0.09"', 'ixx="0.2"'),
    "a mass in words": ('value="1.5"', 'value="1.5 kg"'),
    "no inertial": (ARM[ARM.index("<inertial>") : ARM.index("</link>")], ""),
    "a limit in words": ('lower="-1.5"', 'lower="low"'),
}


@pytest.mark.parametrize(("old", "new"), UNUSED.values(), ids=UNUSED)
def test_inertias_and_limits_that_a_fit_does_not_use_are_not_checked(old, new):
    chain = RigidChain(changed((old, new)))
    usual = RigidChain(ARM)
    torch.testing.assert_close(chain.generic_inertia(), usual.generic_inertia())


def test_a_fit_starts_from_the_inertias_of_bodies_that_can_exist():
    point = '<inertial><origin xyz="0 0 -0.3"/><mass value="1.5"/></inertial>'
    chain = RigidChain(changed((UNUSED["no inertial"][0], point)))
    assert torch.linalg.eigvalsh(chain.prior_inertia()).min() > 0
    q = torch.tensor([0.3, -0.7]).double()
    mass, prior = chain.mass_matrix(q), chain.mass_matrix(q, chain.prior_inertia())
    torch.testing.assert_close(prior, mass, rtol=0.05, atol=1e-4)
    rounded = RigidChain(changed(('izz="0.1"', 'izz="0.143"')))  # 0.14 of a plate, rounded
    torch.testing.assert_close(rounded.prior_inertia()[0, 3], rounded.inertia[0, 3])
    torch.testing.assert_close(RigidChain(ARM).prior_inertia(), RigidChain(ARM).inertia)


IMPOSSIBLE = {
    **{name: UNUSED[name] for name in ("no triangle", "no inertial")},
    "a negative mass": ('value="1.5"', 'value="-1.5"'),
    "kg mm^2": ('ixx="0.09" ixy="0" ixz="0" iyy="0.05"', 'ixx="9e4" ixy="0" ixz="0" iyy="9e4"'),
}


@pytest.mark.parametrize("change", IMPOSSIBLE.values(), ids=IMPOSSIBLE)
def test_a_fit_starts_from_a_rod_only_for_a_body_that_cannot_exist(change):
    chain, usual = RigidChain(changed(change)), RigidChain(ARM)
    expected = torch.stack([usual.generic_inertia()[0], usual.inertia[1]])
    torch.testing.assert_close(chain.prior_inertia(), expected)


def test_a_robot_with_negative_masses_is_not_simulated():
    with pytest.raises(ValueError, match=r"M has the eigenvalue .*link 'upper' has mass -15 kg"):
        RigidChain(changed(('value="1.5"', 'value="-15"'))).check_domain([], [])


def test_moments_in_kg_mm2_are_a_problem():
    (problem,) = read_urdf(
        changed(('ixx="0.09"', 'ixx="9e4"'), ('iyy="0.05"', 'iyy="9e4"'))
    ).problems
    assert "10 m or more (units: kg, m)" in problem


def test_round_off_of_a_massless_link_is_no_problem():
    inertia = '<inertia ixx="0" ixy="2.4e-35" ixz="0" iyy="0" iyz="0" izz="0"/>'
    frame = f'<link name="tool"><inertial><mass value="0"/>{inertia}</inertial></link>'
    assert not read_urdf(changed(('<link name="tool"/>', frame))).problems


def test_links_without_a_joint_and_joints_of_several_coordinates_are_held():
    loose = changed(("</robot>", '<link name="loose"/></robot>'))
    assert read_urdf(loose).joints == ["shoulder", "elbow"]
    floating = changed(('"revolute"', '"floating"'))
    tree = read_urdf(floating)
    assert (tree.joints, tree.held) == (["elbow"], ["shoulder (floating)"])
    welded = RigidChain(ARM, locked_joints=["shoulder"])
    torch.testing.assert_close(RigidChain(floating).inertia, welded.inertia)


TEXTS = ["", "base", "upper", "0", "-1", "1e300", "nan", "0 0 0", "1,2,3", "fixed", "prismatic"]


@given(
    st.lists(st.tuples(places, places, st.sampled_from(TEXTS)), min_size=1, max_size=4),
    byte_hits(0, 1),
)
def test_a_damaged_robot_is_refused_by_name_or_has_generic_bodies(tmp_path_factory, edits, hits):
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
    else:
        assert torch.linalg.eigvalsh(chain.generic_inertia()).min() > 0
        message = str(path)
    assert str(path) in message
