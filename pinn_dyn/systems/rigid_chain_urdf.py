"""Reads the kinematic tree and the inertias of a rigid robot with a fixed base from a URDF."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from pinn_dyn.systems.inertia import pseudo_inertia
from pinn_dyn.systems.urdf import find_urdf
from pinn_dyn.systems.urdf_checks import TURNING, link_of, number, parse_urdf, tip_of

_SLIDING = ("prismatic",)


class Tree(NamedTuple):
    """N moving joints, each with one rigid body: a link and all that is fixed to it.

    Attributes:
        joints, bodies: names of the joints and of the links behind them.
        parents: of each joint the joint before it, -1 at the base; parents come first.
        placements: pose of each joint's frame at q = 0 in that of its parent, ``(N, 4, 4)``.
        axes: unit axis of each joint in its own frame, ``(N, 3)``.
        turning: whether the joint turns (else it slides).
        inertia: pseudo-inertia of each body in its joint's frame, ``(N, 4, 4)``; kg, kg m, kg m^2.
    """

    joints: list[str]
    bodies: list[str]
    parents: list[int]
    placements: Tensor
    axes: Tensor
    turning: list[bool]
    inertia: Tensor


def read_tree(
    urdf: str, *, locked_joints: Sequence[str] = (), tip: str | None = None, payload: float = 0.0
) -> Tree:
    """Read a URDF: a file, one that ships with PyBullet, or the text itself.

    Locked joints stay at zero. A point mass ``payload`` in kg is fixed to the origin of the link
    ``tip``, by default the last of the file that has no joint behind it.

    Raises:
        ValueError: on text that is no URDF, an unknown locked joint or tip, a joint that is neither
            revolute, continuous, prismatic nor fixed, a mimic joint, no joint that moves, or what
            :func:`~pinn_dyn.systems.urdf_checks.parse_urdf` refuses.
        FileNotFoundError: if there is no such file.
    """
    path, robot = _parse(urdf)
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    links = {link.get("name", ""): link for link in robot.findall("link")}
    for name in locked_joints:
        if name not in joints:
            raise ValueError(f"{path} has no joint {name!r} to lock: its joints are {list(joints)}")
    children: dict[str, list[str]] = {}
    for name, joint in joints.items():
        children.setdefault(link_of(joint, "parent"), []).append(name)
    (root,) = links.keys() - {link_of(joint, "child") for joint in joints.values()}
    tip = tip_of(path, robot, tip)

    found = Tree([], [], [], torch.empty(0), torch.empty(0), [], torch.empty(0))
    placements: list[np.ndarray] = []
    axes: list[np.ndarray] = []
    inertia: list[np.ndarray] = []

    def visit(link: str, body: int, pose: np.ndarray) -> None:
        """Add a link, at ``pose`` in the frame of the joint ``body``, and all behind it."""
        if body >= 0:
            inertia[body] += pose @ _pseudo_inertia(path, links[link]) @ pose.T
            if link == tip:
                inertia[body] += payload * np.outer(pose[:, 3], pose[:, 3])
        for name in children.get(link, []):
            joint = joints[name]
            child = link_of(joint, "child")
            placement = pose @ _pose(joint.find("origin"))
            if joint.get("type") == "fixed" or name in locked_joints:
                visit(child, body, placement)
                continue
            axes.append(_axis(path, name, joint))
            placements.append(placement)
            inertia.append(np.zeros((4, 4)))
            found.joints.append(name)
            found.bodies.append(child)
            found.parents.append(body)
            found.turning.append(joint.get("type") in TURNING)
            visit(child, len(found.joints) - 1, np.eye(4))

    visit(root, -1, np.eye(4))
    if not found.joints:
        raise ValueError(f"{path} has no joint that moves (locked: {list(locked_joints)})")
    return found._replace(
        placements=torch.from_numpy(np.stack(placements)),
        axes=torch.from_numpy(np.stack(axes)),
        inertia=torch.from_numpy(np.stack(inertia)),
    )


def _parse(urdf: str) -> tuple[Path, ET.Element]:
    if urdf.lstrip().startswith("<"):
        path, content = Path("URDF text"), urdf.encode()
    else:
        package = importlib.util.find_spec("pybullet_data")
        shipped = Path(package.origin).parent if package and package.origin else Path()
        path = find_urdf(urdf, shipped)
        content = path.read_bytes()
    return path, parse_urdf(path, content)


def _axis(path: Path, name: str, joint: ET.Element) -> np.ndarray:
    if joint.get("type") not in TURNING + _SLIDING or joint.find("mimic") is not None:
        kind = "a mimic joint" if joint.find("mimic") is not None else repr(joint.get("type"))
        raise ValueError(
            f"{path}: joint {name!r} is {kind}, expected revolute, continuous, prismatic or fixed: "
            "add it to locked_joints"
        )
    axis = _triple(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
    return axis / np.linalg.norm(axis)


def _pose(origin: ET.Element | None) -> np.ndarray:
    pose = np.eye(4)
    rpy = _triple(origin, "rpy", (0.0, 0.0, 0.0))
    pose[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    pose[:3, 3] = _triple(origin, "xyz", (0.0, 0.0, 0.0))
    return pose


def _triple(element: ET.Element | None, key: str, default: tuple[float, ...]) -> np.ndarray:
    text = None if element is None else element.get(key)
    return np.array(default if text is None else [float(word) for word in text.split()])


def _pseudo_inertia(path: Path, link: ET.Element) -> np.ndarray:
    """J of a link in its own frame, ``(4, 4)``; zero for a mere frame."""
    inertial, name = link.find("inertial"), link.get("name", "")
    if inertial is None:
        return np.zeros((4, 4))
    mass, moments = inertial.find("mass"), inertial.find("inertia")
    keys = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
    values = [0.0 if mass is None else number(path, name, mass, "value"), 0.0, 0.0, 0.0]
    values += [0.0 if moments is None else number(path, name, moments, key) for key in keys]
    pose = _pose(inertial.find("origin"))
    own = pseudo_inertia(torch.tensor(values, dtype=torch.float64)).numpy()
    return pose @ own @ pose.T
