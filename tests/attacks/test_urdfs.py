"""URDFs that are no robot, or make Bullet crash or never return: refused before it sees them."""

import time

import pytest

from pinn_dyn.systems.urdf import read_urdf
from tests.support.arm_urdf import ARM, changed

UPPER_LINK = '<link name="upper">'
INERTIA = 'ixx="0.09" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.1"'
SHOULDER = '<parent link="base"/><child link="upper"/>'
ELBOW = '<parent link="upper"/><child link="lower"/>'
LAUGHS = "".join(f'<!ENTITY l{k + 1} "{f"&l{k};" * 10}">' for k in range(20))


def joint(name, parent, child):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="fixed">{ends}</joint>'


def refused(tmp_path, content, message):
    path = tmp_path / "arm.urdf"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    start = time.perf_counter()
    with pytest.raises(ValueError, match=message) as caught:
        read_urdf(path, [], "file")
    assert time.perf_counter() - start < 10
    assert str(path) in str(caught.value)
    assert len(str(caught.value)) < 600


WHOLE = {
    "empty": ("", "is not valid XML"),
    "text": ("hello", "is not valid XML"),
    "cut": (ARM[:600], "is not valid XML"),
    "binary": (bytes(range(256)) * 20, "is not valid XML"),
    "zeros": (b"\0" * 4000, "is not valid XML"),
    "unknown encoding": (b'<?xml version="1.0" encoding="klingon"?><robot/>', "is not valid XML"),
    "multi-byte encoding": (b'<?xml version="1.0" encoding="shift_jis"?><robot/>', "not valid XML"),
    "no utf-8": (ARM.replace("upper", "\xe9").encode("latin-1"), "is not valid XML"),
    "html": ("<html><body/></html>", "holds <html> with 0 joints, expected <robot>"),
    "sdf": ("<sdf><model/></sdf>", "holds <sdf> with 0 joints"),
    "namespace": (ARM.replace("<robot ", "<robot xmlns='x' "), "holds <{x}robot>"),
    "no joint": ('<robot name="x"><link name="a"/></robot>', "with 0 joints"),
    "laughs": (
        f'<!DOCTYPE robot [<!ENTITY l0 "ha">{LAUGHS}]><robot>&l20;</robot>',
        "declares a document type",
    ),
    "quadratic": (
        f'<!DOCTYPE robot [<!ENTITY a "{"a" * 100_000}">]>' + f"<robot>{'&a;' * 10_000}</robot>",
        "declares a document type",
    ),
    "file": (
        '<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="&x;"/>',
        "declares a document type",
    ),
    "network": ('<!DOCTYPE robot SYSTEM "http://localhost:1/robot.dtd"><robot/>', "document type"),
    "utf-16 laughs": (
        '<?xml version="1.0" encoding="utf-16"?><!DOCTYPE robot><robot/>'.encode("utf-16"),
        "declares a document type",
    ),
    "deep": ("<robot>" + "<link>" * 100_000 + "</link>" * 100_000 + "</robot>", "30 levels deep"),
    "deep attributes": ("<robot>" + '<a b="c">' * 50 + "</a>" * 50 + "</robot>", "30 levels deep"),
    "huge": (ARM + " " * 20_000_001, "expected a URDF of at most"),
    "many joints": (
        "<robot>"
        + "".join(f'<link name="l{k}"/>' for k in range(201))
        + "".join(joint(f"j{k}", f"l{k}", f"l{k + 1}") for k in range(200))
        + "</robot>",
        "has 200 joints, expected at most 100",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("content", "message"), WHOLE.values(), ids=WHOLE)
def test_a_file_that_is_no_urdf(tmp_path, content, message):
    refused(tmp_path, content, message)


CHANGES = {
    # names
    "two links of a name": ('name="lower"', 'name="upper"', "has 2 links named 'upper'"),
    "two joints of a name": ('name="elbow"', 'name="shoulder"', "has 2 joints named 'shoulder'"),
    "a link without a name": (UPPER_LINK, "<link>", "has a link without a name"),
    "an empty name": (UPPER_LINK, '<link name=" ">', "has a link without a name"),
    "a joint without a name": ('<joint name="elbow"', "<joint", "has a joint without a name"),
    "a name of a page": ('name="tool"', f'name="{"x" * 5000}"', "whose name has 5000 letters"),
    # the tree
    "its own parent": (ELBOW, '<parent link="lower"/><child link="lower"/>', "in a circle"),
    "a circle apart": (
        "</robot>",
        f'<link name="a"/><link name="b"/>{joint("x", "a", "b")}{joint("y", "b", "a")}</robot>',
        "links a, b are parents of each other in a circle",
    ),
    "a circle of all": ("</robot>", joint("x", "tool", "base") + "</robot>", "in a circle"),
    "two parents": ("</robot>", joint("x", "base", "lower") + "</robot>", "'elbow' and 'x'"),
    "two joints for one": ("</robot>", joint("x", "upper", "lower") + "</robot>", "a closed loop"),
    "two roots": ("</robot>", '<link name="loose"/></robot>', "2 links that no joint moves"),
    "no parent": (SHOULDER, '<child link="upper"/>', "'shoulder' has the parent"),
    "no child": (SHOULDER, '<parent link="base"/>', "'shoulder' has the child"),
    "two children": (SHOULDER, SHOULDER + '<child link="tool"/>', "has the child 'upper', 'tool'"),
    "an unknown parent": (ELBOW, '<parent link="uper"/><child link="lower"/>', "the parent 'uper'"),
    "a parent without link": (ELBOW, '<parent/><child link="lower"/>', "has the parent ''"),
    # axes and origins
    "an axis of zero": ('"0 1 0"', '"0 0 0"', "'shoulder' has the axis '0 0 0', of length 0"),
    "a tiny axis": ('"0 1 0"', '"0 1e-9 0"', "of length 0"),
    "two numbers": ('"0 1 0"', '"0 1"', "<axis xyz='0 1'>, expected three numbers"),
    "four numbers": ('"0 1 0"', '"0 1 0 0"', "expected three numbers"),
    "an axis of words": ('"0 1 0"', '"x y z"', "expected three numbers"),
    "an empty axis": ('"0 1 0"', '""', "expected three numbers"),
    "an axis of NaN": ('"0 1 0"', '"0 nan 0"', "expected three numbers"),
    "an endless axis": ('"0 1 0"', '"0 inf 0"', "expected three numbers"),
    "an origin of commas": ('"0 0 -0.5"', '"0, 0, -0.5"', "'elbow' has <origin xyz='0, 0, -0.5'>"),
    "an origin of two": ('"0 0 -0.5"', '"0 0"', "'elbow' has <origin xyz='0 0'>"),
    "an origin of NaN": ('"0 0 -0.5"', '"0 0 nan"', "expected three numbers"),
    "an origin afar": ('"0 0 -0.5"', '"0 0 1e300"', "three numbers of at most 1000"),
    "an angle of two": ('<origin xyz="0 0 -0.5"', '<origin rpy="0 0"', "<origin rpy='0 0'>"),
    "a centre of one": ('"0 0 -0.3"', '"-0.3"', "link 'upper' has <origin xyz='-0.3'>"),
    # inertias
    "a negative mass": ('value="1.5"', 'value="-1.5"', "link 'upper' has mass -1.5 kg"),
    "a mountain": ('value="1.5"', 'value="1e200"', "'upper' has mass 1e\\+200 kg, expected from 0"),
    "a heavy flywheel": (INERTIA, INERTIA.replace("0.09", "1e9"), "has an inertia of 1e\\+09 kg m"),
    "a mass of NaN": ('value="1.5"', 'value="nan"', "<mass value='nan'>, expected a finite"),
    "an endless mass": ('value="1.5"', 'value="1e400"', "<mass value='1e400'>, expected a finite"),
    "a mass that Bullet reads as 1": ('value="1.5"', 'value="1_0"', "<mass value='1_0'>"),
    "an axis that Bullet reads as 0": ('"0 1 0"', '"\u0661 0 0"', "expected three numbers"),
    "a mass in words": ('value="1.5"', 'value="1.5 kg"', "<mass value='1.5 kg'>"),
    "a mass of nothing": ('<mass value="1.5"/>', "<mass/>", "<mass value=''>"),
    "no mass": ('<mass value="0.8"/>', "", "link 'lower' moves with joint 'elbow' and has no mass"),
    "a missing product": ('iyz="0"', "", "<inertia iyz=''>, expected a finite number"),
    "an inertia of words": ('ixx="0.09"', 'ixx="big"', "<inertia ixx='big'>"),
    "a negative moment": ('ixx="0.09"', 'ixx="-0.09"', "link 'upper' has the principal moments"),
    "no triangle": ('ixx="0.09"', 'ixx="0.2"', "larger than the sum of the other two"),
    "products too large": (INERTIA, INERTIA.replace('ixy="0"', 'ixy="0.5"'), "none negative"),
    "two inertials": (UPPER_LINK, UPPER_LINK + "<inertial/>", "'upper' has several <inertial>"),
    # limits and types
    "limits turned": ('lower="-1.5"', 'lower="2"', "has limits lower = 2.0 and upper = 1.5"),
    "limits of words": ('lower="-1.5"', 'lower="low"', "<limit lower='low'>"),
    "limits of NaN": ('upper="1.5"', 'upper="nan"', "<limit upper='nan'>"),
    "no limits": ('lower="-1.5" upper="1.5"', "", "has limits lower = 0.0 and upper = 0.0"),
    "a negative speed": ('velocity="0.5"', 'velocity="-0.5"', "the limit velocity = -0.5"),
    "a negative effort": ('effort="30"', 'effort="-30"', "the limit effort = -30"),
    "a sliding joint": ('"revolute"', '"prismatic"', "'shoulder' is of type 'prismatic'"),
    "a floating joint": ('"continuous"', '"floating"', "'elbow' is of type 'floating'"),
    "an unknown type": ('"continuous"', '"rubber"', "'elbow' is of type 'rubber'"),
    "no type": (' type="continuous"', "", "'elbow' is of type None"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), CHANGES.values(), ids=CHANGES)
def test_a_robot_that_cannot_be(tmp_path, old, new, message):
    refused(tmp_path, changed((old, new)), message)


def test_an_unchanged_one_is_accepted(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM)
    assert list(read_urdf(tmp_path / "arm.urdf", [], "file").limits) == ["shoulder", "elbow"]
