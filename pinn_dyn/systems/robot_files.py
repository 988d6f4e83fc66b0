"""Write robot files with identified constants: URDF and MJCF."""

from __future__ import annotations

import html
import logging
import math
import os
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import scipy
import torch
from torch import Tensor

from pinn_dyn.exports.escaping import xml_comment
from pinn_dyn.systems.inertia import central_parameters
from pinn_dyn.systems.mjcf import exact_text
from pinn_dyn.systems.rigid_chain import RigidChain
from pinn_dyn.systems.urdf import urdf_text
from pinn_dyn.systems.urdf_file import UrdfFile, is_mjcf

_MOMENTS = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
_OF_MOVING_JOINTS = ("axis", "limit", "dynamics", "mimic", "calibration", "safety_controller")

log = logging.getLogger(__name__)


class RobotConstants(NamedTuple):
    """Constants of N coordinates and B bodies in SI units.

    Attributes:
        inertia: pseudo-inertias of the bodies in the frames of their joints, ``(B, 4, 4)``.
        armature, damping, friction: inertias of the rotors, viscous and dry friction, ``(N,)``.
        gain: force per input, zero for a passive joint, ``(N,)``.
        bias: constant force of the drive, and its force per q and per v, ``(N, 3)``.
        limit: largest force of the drive in addition to the constant force, ``(N,)``.
        stiffness, rest: stiffness and rest position of a spring of the joint, ``(N,)``.
        notes: lines of the comment at the top of the file.
    """

    inertia: Tensor
    armature: Tensor
    damping: Tensor
    friction: Tensor
    gain: Tensor
    bias: Tensor
    limit: Tensor
    stiffness: Tensor
    rest: Tensor
    notes: list[str]


def updated_urdf(robot: RigidChain, constants: RobotConstants, folder: Path) -> str:
    """Return the URDF of a robot with new inertias, damping and dry friction.

    The child link of a joint gets the ``<inertial>`` of its body; the links fixed to it get zero.
    Locked joints become fixed joints. Armatures and springs, for which a URDF has no field, are
    listed in a comment. All other elements are copied from the robot's file, or from the text
    stored in the run if the file has changed. Meshes are relative to ``folder``.
    """
    file = _file(robot)
    before = {child: parent for parent, child in file.ends.values()}
    bodies = central_parameters(constants.inertia)
    for name, link in file.links.items():
        body = name
        while body in before and body not in robot.body_names:
            body = before[body]
        is_frame = link.find("inertial") is None and link.find("collision") is None
        if body not in robot.body_names or (body != name and is_frame):
            continue
        mass, *numbers = bodies[robot.body_names.index(body)].tolist()
        if body != name:  # zero, since MuJoCo derives a missing inertia from the shapes
            mass, numbers = 0.0, 9 * [0.0]
            link.append(ET.Comment(f" in the inertia of {xml_comment(body)} "))
        _remove(link, "inertial")
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=exact_text(numbers[:3]), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(mass))
        moments = zip(_MOMENTS, map(repr, numbers[3:]), strict=True)
        ET.SubElement(inertial, "inertia", dict(moments))
    locked = robot.tree.locked
    for name, joint in file.joints.items():
        if file.ends[name][1] in robot.body_names:
            _remove(joint, "dynamics")  # the mimicked joint has that of its followers
        if name in robot.joint_names:
            _remove(joint, "mimic")
            k = robot.joint_names.index(name)
            damping, friction = float(constants.damping[k]), float(constants.friction[k])
            ET.SubElement(joint, "dynamics", damping=repr(damping), friction=repr(friction))
        elif joint.get("type") != "fixed" and file.ends[name][1] not in robot.body_names:
            driver, factor, offset = file.drive(name, (*robot.joint_names, *locked))
            position = offset + factor * locked.get(driver, 0.0)
            if position:
                pose = file.pose(name, position)
                _remove(joint, "origin")
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # at a gimbal lock any angles are right
                    rpy = scipy.spatial.transform.Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
                ET.SubElement(joint, "origin", xyz=exact_text(pose[:3, 3]), rpy=exact_text(rpy))
            _remove(joint, *_OF_MOVING_JOINTS)
            joint.set("type", "fixed")
    for mesh in file.robot.iter("mesh"):
        name = mesh.get("filename", "")
        if not os.path.isabs(name) and (file.path.parent / name).is_file():
            mesh.set("filename", os.path.relpath(file.path.parent / name, folder))
    _remove(file.robot, "note")
    file.robot.set("name", file.robot.get("name") or "robot")  # readers require a name
    return _written(file.robot, constants.notes)


def new_mjcf(robot: RigidChain, constants: RobotConstants, folder: Path) -> str:
    """Return an MJCF of the bodies, joints and drives of a robot, without shapes.

    An actuator computes gain * ctrl plus the bias, with the input of the model as ctrl, and has a
    hard limit of its force. Equalities couple joints that mimic other joints.
    """
    file, tree = UrdfFile(robot.urdf), robot.tree
    names = {file.ends[name][1]: name for name in file.joints}
    root = ET.Element("mujoco", model="identified")
    ET.SubElement(root, "compiler", angle="radian")
    ET.SubElement(root, "option", gravity=exact_text(robot.gravity))
    elements = [ET.SubElement(root, "worldbody")]
    actuators, equalities = (ET.SubElement(root, tag) for tag in ("actuator", "equality"))
    poses, bodies = tree.placements.numpy(), central_parameters(constants.inertia)
    for k, (pose, body) in enumerate(zip(poses, tree.bodies, strict=True)):
        rotation = scipy.spatial.transform.Rotation.from_matrix(pose[:3, :3])
        w, x, y, z = rotation.as_quat()[[3, 0, 1, 2]]
        frame = {"pos": exact_text(pose[:3, 3]), "quat": exact_text([w, x, y, z])}
        element = ET.SubElement(elements[tree.parents[k] + 1], "body", frame, name=body)
        elements.append(element)
        mass, x, y, z, xx, xy, yy, xz, yz, zz = bodies[k].tolist()
        full = exact_text([xx, yy, zz, xy, xz, yz])
        ET.SubElement(
            element, "inertial", mass=repr(mass), pos=exact_text([x, y, z]), fullinertia=full
        )
        turns = bool(tree.revolute[k])
        settings = {"type": "hinge" if turns else "slide", "axis": exact_text(tree.axes[k])}
        joint, number = names[body], robot.body_joints[k]
        driver = robot.joint_names[number]
        if joint != driver:
            factors = f"0 {float(tree.coupling[k, number])!r} 0 0 0"
            ET.SubElement(equalities, "joint", joint1=joint, joint2=driver, polycoef=factors)
        else:
            settings["armature"] = exact_text(constants.armature[[number]])
            settings["damping"] = exact_text(constants.damping[[number]])
            settings["frictionloss"] = exact_text(constants.friction[[number]])
            if constants.stiffness[number] > 0:
                settings["stiffness"] = exact_text(constants.stiffness[[number]])
                settings["springref"] = exact_text(constants.rest[[number]])
            low, high = robot.limits[number, :2]
            if low < high and not (turns and high - low > 6.28):
                settings |= {"range": exact_text([low, high]), "limited": "true"}
            if gain := float(constants.gain[number]):
                law = {"gainprm": repr(gain), "biasprm": exact_text(constants.bias[number])}
                if (limit := float(constants.limit[number])) < math.inf:
                    ends = constants.bias[number, 0] + limit * torch.tensor([-1.0, 1.0])
                    law |= {"forcerange": exact_text(ends), "forcelimited": "true"}
                ET.SubElement(actuators, "general", law, name=joint, joint=joint, biastype="affine")
        ET.SubElement(element, "joint", settings, name=joint)
    return _written(root, constants.notes)


def _file(robot: RigidChain) -> UrdfFile:
    """Return the robot's file if it is unchanged since the training, or else the stored text."""
    urdf = robot.urdf
    if urdf.startswith("<!-- "):  # text written by urdf_text
        path = html.unescape(urdf[5:].partition(" -->")[0])
        try:
            if not is_mjcf(path) and urdf_text(path) == urdf:
                return UrdfFile(path)
        except (OSError, ValueError):
            pass
        log.warning(
            "%s is missing, changed after the training, or an MJCF: the new file has no shapes",
            path,
        )
    return UrdfFile(urdf)


def _remove(parent: ET.Element, *tags: str) -> None:
    for element in [child for child in parent if child.tag in tags]:
        parent.remove(element)


def _written(root: ET.Element, notes: Iterable[str]) -> str:
    lines = "".join(f"\n    {xml_comment(note)}" for note in notes)
    root.insert(0, ET.Comment(f"{lines}\n  "))
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'
