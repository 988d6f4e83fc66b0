"""Reads a URDF and prepares it for Bullet: locked joints, no limits, no hidden friction."""

from __future__ import annotations

import hashlib
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from pinn_dyn.spelling import did_you_mean
from pinn_dyn.systems.urdf_checks import MOMENTS, TURNING, link_of, number, parse_urdf, tip_of

Inertia = Literal["file", "collision"]
"""Whether inertias are those of the URDF, or those that Bullet computes from collision shapes."""

POINT_MASS = "pinn_dyn_point_mass"
"""Name of the link that is added for a payload."""


class JointLimits(NamedTuple):
    """Limits of a revolute joint: rad, rad, rad/s, Nm; 0 where the URDF gives none."""

    low: float
    high: float
    speed: float
    effort: float


class Urdf(NamedTuple):
    """A URDF that Bullet may load.

    Attributes:
        path: the file it was read from.
        text: the URDF for Bullet, mesh paths absolute.
        digest: SHA-256 of the file and of the meshes that its inertias come from.
        limits: by the name of each joint that moves.
        moments: by the name of each link, the sum of its principal moments of inertia, kg m^2.
        tip: the name of the link at the end of the arm.
    """

    path: Path
    text: str
    digest: str
    limits: dict[str, JointLimits]
    moments: dict[str, float]
    tip: str


def read_urdf(
    path: Path,
    locked_joints: Sequence[str],
    inertia: Inertia,
    *,
    tip: str | None = None,
    mass_scale: float = 1.0,
    payload: float = 0.0,
) -> Urdf:
    """Read a URDF and change what would make Bullet's motion differ from M, G and C.

    Locked joints become fixed at zero, so their links' masses stay; all others become continuous,
    as Bullet's joint limits are walls. Visual shapes go, and collision shapes stay only where
    inertias come from them. All masses and inertias are multiplied by ``mass_scale``; a point mass
    ``payload`` in kg is then fixed to the origin of the link ``tip``, which is by default the last
    of the file's joints that has no other joint behind it.

    Raises:
        ValueError: on text that is no URDF of a body (see :func:`~.urdf_checks.parse_urdf`), an
            unknown locked joint or tip, a joint that moves and is not revolute, no revolute joint,
            or a moving link without mass, inertia or shape.
        FileNotFoundError: if a mesh that is needed is missing.
    """
    content = path.read_bytes()
    robot = parse_urdf(path, content, inertias=inertia == "file")
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    for name in locked_joints:
        if name not in joints:
            raise ValueError(
                f"{path} has no joint {name!r} to lock: its joints are {', '.join(joints)}"
            )
    moving = {
        name: joint
        for name, joint in joints.items()
        if joint.get("type") != "fixed" and name not in locked_joints
    }
    for name, joint in moving.items():
        if joint.get("type") not in TURNING:
            raise ValueError(
                f"{path}: joint {name!r} is of type {joint.get('type')!r}, but an arm has a fixed "
                "base and revolute joints: add it to locked_joints, or use another URDF"
            )
    if not moving:
        raise ValueError(
            f"{path} has no revolute joint that is free (locked: {list(locked_joints)}), expected "
            "at least one"
        )
    limits = {name: _limits(path, name, joint) for name, joint in moving.items()}
    _check_masses(path, robot, set(moving), inertia)
    tip = tip_of(path, robot, tip)
    if mass_scale != 1:
        _scale_masses(path, robot, mass_scale)
    digest = hashlib.sha256(content)
    unused = ("visual", "collision") if inertia == "file" else ("visual",)
    for name, joint in joints.items():
        joint.set("type", "continuous" if name in moving else "fixed")
        _make_unit(joint.find("axis"))
    for link in robot.findall("link"):
        for shape in [part for part in link if part.tag in unused]:
            link.remove(shape)
        for mesh in link.iter("mesh"):
            file = _find_mesh(path, mesh.get("filename", ""))
            digest.update(file.read_bytes())
            mesh.set("filename", str(file))
    if payload:
        _add_point_mass(robot, tip, payload)
    moments = {link.get("name", ""): _moments(path, link) for link in robot.findall("link")}
    text = ET.tostring(robot, encoding="unicode")
    return Urdf(path, text, digest.hexdigest(), limits, moments, tip)


def find_urdf(urdf: str, folder: Path) -> Path:
    """The file ``urdf``, or the one of that name in ``folder``, the robots that ship with Bullet.

    Raises:
        FileNotFoundError: saying where it was looked for, and which names are close.
    """
    given = Path(urdf).expanduser()
    for path in (given, folder / given):
        if path.is_file():
            return path.resolve()
    near = [str(path) for path in given.parent.glob("*.urdf")]
    near += [str(path.relative_to(folder)) for path in folder.rglob("*.urdf")]
    hint = did_you_mean(urdf, near) or ": give the path of a URDF"
    raise FileNotFoundError(
        f"URDF {urdf!r} not found, neither from {Path.cwd()} nor in {folder}{hint}"
    )


def _limits(path: Path, name: str, joint: ET.Element) -> JointLimits:
    """A continuous joint may turn without end; what is then explored is one turn."""
    limit = joint.find("limit")
    values = {} if limit is None else {key: number(path, name, limit, key) for key in limit.attrib}
    low, high = values.get("lower", 0.0), values.get("upper", 0.0)
    if joint.get("type") == "continuous":
        low, high = -math.pi, math.pi
    elif not low < high:
        raise ValueError(
            f"{path}: joint {name!r} has limits lower = {low} and upper = {high}, expected lower < "
            "upper: set them, lock the joint, or make it continuous"
        )
    return JointLimits(low, high, values.get("velocity", 0.0), values.get("effort", 0.0))


def _check_masses(path: Path, robot: ET.Element, moving: set[str], inertia: Inertia) -> None:
    """Every body that moves, a link with all that is fixed to it, needs a mass and an inertia."""
    links = {link.get("name", ""): link for link in robot.findall("link")}
    starts: dict[str, str] = {}
    rigid: dict[str, list[str]] = {}
    for joint in robot.findall("joint"):
        name, child = joint.get("name", ""), link_of(joint, "child")
        if name in moving:
            starts[name] = child
        else:
            rigid.setdefault(link_of(joint, "parent"), []).append(child)
    for joint_name, start in starts.items():
        body, mass = [start], 0.0
        for name in body:
            body += rigid.get(name, [])
            mass += (own := _mass(path, links[name]))
            shape = "inertial/inertia" if inertia == "file" else "collision"
            if own > 0 and links[name].find(shape) is None:
                raise ValueError(
                    f"{path}: link {name!r} moves and has no <{shape.split('/')[-1]}>, which "
                    f"inertia = {inertia!r} needs: add it, or use the other inertia"
                )
        if mass == 0:
            raise ValueError(
                f"{path}: link {start!r} moves with joint {joint_name!r} and has no mass: expected "
                "<inertial> with a positive mass, in it or in a link fixed to it"
            )
    for link in links.values():
        # Bullet takes 1 kg for a link without <inertial>, and refuses half of one; a mere frame
        # weighs nothing.
        inertial = link.find("inertial")
        if inertial is None:
            inertial = ET.SubElement(link, "inertial")
        if inertial.find("mass") is None:
            ET.SubElement(inertial, "mass", value="0")
        if inertial.find("inertia") is None:
            ET.SubElement(inertial, "inertia", dict.fromkeys(MOMENTS, "0"))


def _make_unit(axis: ET.Element | None) -> None:
    """Bullet turns by the direction of an axis, and multiplies speeds by its length."""
    if axis is not None and axis.get("xyz") is not None:
        values = np.array(axis.get("xyz", "").split(), dtype=float)
        length = np.linalg.norm(values)
        if length > 0 and abs(length - 1) > 1e-12:  # a fixed joint may state 0 0 0
            axis.set("xyz", " ".join(repr(float(x)) for x in values / length))


def _scale_masses(path: Path, robot: ET.Element, factor: float) -> None:
    for link in robot.findall("link"):
        for tag in ("mass", "inertia"):
            for element in link.findall(f"inertial/{tag}"):
                for key in element.attrib:
                    value = number(path, link.get("name", ""), element, key)
                    element.set(key, repr(factor * value))


def _add_point_mass(robot: ET.Element, link: str, mass: float) -> None:
    inertial = ET.SubElement(ET.SubElement(robot, "link", name=POINT_MASS), "inertial")
    ET.SubElement(inertial, "mass", value=repr(mass))
    ET.SubElement(inertial, "inertia", dict.fromkeys(MOMENTS, "0"))
    joint = ET.SubElement(robot, "joint", name=POINT_MASS, type="fixed")
    ET.SubElement(joint, "parent", link=link)
    ET.SubElement(joint, "child", link=POINT_MASS)


def _mass(path: Path, link: ET.Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else number(path, link.get("name", ""), mass, "value")


def _moments(path: Path, link: ET.Element) -> float:
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return 0.0
    return sum(number(path, link.get("name", ""), inertia, key) for key in ("ixx", "iyy", "izz"))


def _find_mesh(path: Path, filename: str) -> Path:
    """A mesh path is relative to the URDF or, as package://, to one of the folders above it."""
    relative = filename.removeprefix("package://").removeprefix("file://")
    for folder in path.parents:
        if (folder / relative).is_file():
            return folder / relative
    raise FileNotFoundError(
        f"{path}: mesh {filename!r} not found in {path.parent} or above: put it there, or use "
        "inertia = 'file', which needs no mesh"
    )
