"""Texts of robot files with identified constants: URDF and MJCF."""

from __future__ import annotations

import logging
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from pinn_dyn.systems.inertia import central_parameters
from pinn_dyn.systems.rigid_chain import RigidChain
from pinn_dyn.systems.urdf import read_urdf, urdf_text

_MOMENTS = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
_OF_MOVING_JOINTS = ("axis", "limit", "dynamics", "mimic", "calibration", "safety_controller")

log = logging.getLogger(__name__)


class RobotConstants(NamedTuple):
    """Constants of N joints and B bodies in SI units.

    Attributes:
        inertia: pseudo-inertias of the bodies in the frames of their joints, ``(B, 4, 4)``.
        armature, damping, friction: inertias of the rotors, viscous and dry friction, ``(N,)``.
        gain, offset: force per input, zero for a passive joint, and constant force, ``(N,)``.
        notes: lines for a comment at the head of the file.
    """

    inertia: Tensor
    armature: Tensor
    damping: Tensor
    friction: Tensor
    gain: Tensor
    offset: Tensor
    notes: list[str]


def updated_urdf(robot: RigidChain, constants: RobotConstants, folder: Path) -> str:
    """Return the URDF of a robot with other inertias, damping and dry friction.

    The ``<inertial>`` behind a joint is that of the body: the link and everything fixed to it. That
    of the links fixed to it is zero. Joints that the robot locks become fixed joints. A URDF has no
    field for armatures, which are in the comment. The remainder is that of the robot's file, or of
    the stored text if the file has changed. Meshes are relative to ``folder``.
    """
    root, source = _xml(robot)
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    before = {_end(joint, "child"): _end(joint, "parent") for joint in joints.values()}
    bodies = central_parameters(constants.inertia)
    for link in root.findall("link"):
        body = name = link.get("name", "")
        while body in before and body not in robot.body_names:
            body = before[body]
        is_frame = link.find("inertial") is None and link.find("collision") is None
        if body not in robot.body_names or (body != name and is_frame):
            continue
        mass, *numbers = bodies[robot.body_names.index(body)].tolist()
        if body != name:  # zero instead of nothing: MuJoCo would derive it from the shapes
            mass, numbers = 0.0, 9 * [0.0]
            link.append(ET.Comment(f" in the inertia of {body} "))
        _remove(link, ["inertial"])
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=_text(numbers[:3]), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(mass))
        moments = zip(_MOMENTS, map(repr, numbers[3:]), strict=True)
        ET.SubElement(inertial, "inertia", dict(moments))
    angles = robot.locked_joints if isinstance(robot.locked_joints, Mapping) else {}
    for name, joint in joints.items():
        if name in robot.joint_names:
            k = robot.joint_names.index(name)
            _remove(joint, ["dynamics"])
            damping, friction = (repr(float(x[k])) for x in (constants.damping, constants.friction))
            ET.SubElement(joint, "dynamics", damping=damping, friction=friction)
        elif joint.get("type") != "fixed" and _end(joint, "child") not in robot.body_names:
            _fix(joint, angles.get(name, 0.0))
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if source and not os.path.isabs(name) and (source / name).is_file():
            mesh.set("filename", os.path.relpath(source / name, folder))
    return _written(root, constants.notes)


def new_mjcf(robot: RigidChain, constants: RobotConstants, folder: Path) -> str:
    """Return an MJCF of the bodies, joints and drives of a robot, without shapes.

    An actuator computes gain * ctrl + offset, so that ctrl is the input of the model.
    """
    root = ET.Element("mujoco", model="identified")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", gravity=_text(robot.gravity))
    elements = [ET.SubElement(root, "worldbody")]
    actuators = ET.SubElement(root, "actuator")
    zero = torch.zeros(robot.num_coordinates, dtype=torch.float64)
    poses, twists = (x.detach().double().numpy() for x in robot.kinematics(zero))
    bodies = central_parameters(constants.inertia)
    for k, (joint, body) in enumerate(zip(robot.joint_names, robot.body_names, strict=True)):
        parent, turns = robot.parents[k], robot.turning[k]
        pose = poses[k] if parent < 0 else np.linalg.solve(poses[parent], poses[k])
        quaternion = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
        place = {"pos": _text(pose[:3, 3]), "quat": _text(quaternion)}
        element = ET.SubElement(elements[parent + 1], "body", place, name=body)
        elements.append(element)
        mass, x, y, z, xx, xy, yy, xz, yz, zz = bodies[k].tolist()
        full = _text([xx, yy, zz, xy, xz, yz])
        ET.SubElement(element, "inertial", mass=repr(mass), pos=_text([x, y, z]), fullinertia=full)
        turn = twists[k][:3, :3]
        axis = [turn[2, 1], turn[0, 2], turn[1, 0]] if turns else twists[k][:3, 3]
        settings = {
            "type": "hinge" if turns else "slide",
            "axis": _text(poses[k][:3, :3].T @ axis),
            "armature": _text(constants.armature[k : k + 1]),
            "damping": _text(constants.damping[k : k + 1]),
            "frictionloss": _text(constants.friction[k : k + 1]),
        }
        low, high = robot.limits[k, :2]
        if low < high and not (turns and high - low > 6.28):
            settings |= {"range": _text([low, high]), "limited": "true"}
        ET.SubElement(element, "joint", settings, name=joint)
        if gain := float(constants.gain[k]):
            law = {"gainprm": repr(gain), "biasprm": _text(constants.offset[k : k + 1])}
            ET.SubElement(actuators, "general", law, name=joint, joint=joint, biastype="affine")
    return _written(root, constants.notes)


def _xml(robot: RigidChain) -> tuple[ET.Element, Path | None]:
    """Return the URDF of the robot's file and its folder, or the text that the robot stores."""
    urdf = robot.urdf
    if urdf.startswith("<!-- "):  # a text of urdf_text
        path = urdf[5:].partition(" -->")[0]
        try:
            is_same = urdf_text(path) == urdf
        except (OSError, ValueError):
            is_same = False
        if is_same:
            urdf = path
        else:
            log.warning("%s is missing or has changed: the export has no shapes", path)
    file = read_urdf(urdf, locked_joints=robot.locked_joints).path
    content = file.read_bytes() if file.is_file() else urdf.encode()
    root = ET.XML(content, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True)))
    for element in root.iter():
        if isinstance(element.tag, str):  # no comment
            element.tag = element.tag.rpartition("}")[2]
    if root.tag != "robot":
        root = ET.XML(urdf_text(urdf))
    return root, file.parent if file.is_file() else None


def _fix(joint: ET.Element, angle: float) -> None:
    """Make a joint a fixed joint at an angle (rad) or a distance (m)."""

    def vector(tag: str, key: str, default: str) -> np.ndarray:
        element = joint.find(tag)
        return np.array((default if element is None else element.get(key, default)).split(), float)

    if angle:
        axis = vector("axis", "xyz", "1 0 0")
        axis = angle * axis / np.linalg.norm(axis)
        turn = Rotation.from_euler("xyz", vector("origin", "rpy", "0 0 0"))
        place = vector("origin", "xyz", "0 0 0")
        if joint.get("type") == "prismatic":
            place = place + turn.apply(axis)
        else:
            turn = turn * Rotation.from_rotvec(axis)
        _remove(joint, ["origin"])
        ET.SubElement(joint, "origin", xyz=_text(place), rpy=_text(turn.as_euler("xyz")))
    _remove(joint, _OF_MOVING_JOINTS)
    joint.set("type", "fixed")


def _end(joint: ET.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _remove(parent: ET.Element, tags: Iterable[str]) -> None:
    for tag in tags:
        for element in parent.findall(tag):
            parent.remove(element)


def _text(values: Iterable[float] | Tensor) -> str:
    return " ".join(repr(float(value)) for value in values)


def _written(root: ET.Element, notes: Iterable[str]) -> str:
    lines = "".join(f"\n    {note.replace('--', '-')}" for note in notes)
    root.insert(0, ET.Comment(f"{lines}\n  "))
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'
