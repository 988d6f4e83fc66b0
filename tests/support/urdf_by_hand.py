"""Kinematics and mass matrix of a URDF, written down link by link: an oracle."""

import xml.etree.ElementTree as ET

import numpy as np

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


def rotation(axis, angle):
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def numbers(element, key):
    text = "0 0 0" if element is None else element.get(key, "0 0 0")
    return np.array([float(x) for x in text.split()])


def placed(R, r, origin):
    """The frame ``origin`` of a URDF, within the frame (R, r)."""
    roll, pitch, yaw = numbers(origin, "rpy")
    turn = rotation((0, 0, 1), yaw) @ rotation((0, 1, 0), pitch) @ rotation((1, 0, 0), roll)
    return R @ turn, r + R @ numbers(origin, "xyz")


def urdf_frames(text, q):
    """(R, r, [(axis, point), ...]) of every link of a URDF that names parents before children.

    Revolute joints take their angles from q in turn, prismatic ones stay at zero.
    """
    joints = ET.fromstring(text).findall("joint")
    frames = {joints[0].find("parent").get("link"): (np.eye(3), np.zeros(3), [])}
    angles = list(q)
    for joint in joints:
        R, r, axes = frames[joint.find("parent").get("link")]
        R, r = placed(R, r, joint.find("origin"))
        if joint.get("type") == "revolute":
            axis = numbers(joint.find("axis"), "xyz")
            axes = [*axes, (R @ axis, r)]
            R = R @ rotation(axis, angles.pop(0))
        frames[joint.find("child").get("link")] = (R, r, axes)
    assert not angles
    return frames


def jacobian_of(point, axes, size):
    linear, angular = np.zeros((2, 3, size))
    for index, (axis, origin) in enumerate(axes):
        linear[:, index], angular[:, index] = np.cross(axis, point - origin), axis
    return linear, angular


def urdf_mass_matrix(text, q):
    """sum m J^T J + Jw^T I Jw over all links of a URDF but its base."""
    links = {link.get("name"): link.find("inertial") for link in ET.fromstring(text).iter("link")}
    mass_matrix = np.zeros((len(q), len(q)))
    for name, (R, r, axes) in urdf_frames(text, q).items():
        if not axes:
            continue
        Rc, centre = placed(R, r, links[name].find("origin"))
        xx, xy, xz, yy, yz, zz = (
            float(links[name].find("inertia").get(f"i{key}"))
            for key in ("xx", "xy", "xz", "yy", "yz", "zz")
        )
        inertia = Rc @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ Rc.T
        linear, angular = jacobian_of(centre, axes, len(q))
        mass = float(links[name].find("mass").get("value"))
        mass_matrix += mass * linear.T @ linear + angular.T @ inertia @ angular
    return mass_matrix
