"""Read the kinematic tree, the inertias and the limits of a robot with a fixed base from a URDF."""

from __future__ import annotations

import importlib.util
import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from pinn_dyn.systems.inertia import pseudo_inertia

_TURNING = ("revolute", "continuous")
_UNREAD = {"visual", "collision", "material", "transmission", "gazebo"}
_TOLERANCE = 1e-6  # of the largest principal moment of inertia


class Tree(NamedTuple):
    """N moving joints, each with one rigid body: a link and everything fixed to it.

    Attributes:
        path: the file.
        joints, bodies: names of the joints and of the links behind them.
        parents: index of the joint before each joint, -1 at the base; parents come first.
        placements: pose of each joint's frame at q = 0 in its parent's frame, ``(N, 4, 4)``.
        axes: unit axis of each joint in its own frame, ``(N, 3)``.
        turning: true for a joint that turns, false for a joint that slides.
        inertia: pseudo-inertia of each body in its joint's frame, ``(N, 4, 4)``; kg, kg m, kg m^2.
        limits: lower and upper position, speed and effort of each joint, ``(N, 4)``; zero where
            the URDF has none, a position of -pi to pi for a continuous joint.
        tip_body: index of the body that carries the tip, -1 for the base.
        tip_pose: pose of the tip in that body's frame, ``(4, 4)``.
    """

    path: Path
    joints: list[str]
    bodies: list[str]
    parents: list[int]
    placements: Tensor
    axes: Tensor
    turning: list[bool]
    inertia: Tensor
    limits: np.ndarray
    tip_body: int
    tip_pose: Tensor


def read_urdf(
    urdf: str,
    *,
    locked_joints: Sequence[str] = (),
    tip: str | None = None,
    mass_scale: float = 1.0,
    payload: float = 0.0,
) -> Tree:
    """Read a URDF: a file, a file that ships with PyBullet, or the text itself.

    Args:
        urdf: path or text.
        locked_joints: names of joints that stay at zero.
        tip: link at the end of the arm; None for the last of the file without a joint behind it.
        mass_scale: factor of all masses and inertias.
        payload: point mass at the origin of the tip, kg, which is not scaled.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: on text that is no URDF of a tree of links, an unknown locked joint or tip, no
            joint that moves, another kind of joint, or a mass or inertia that no body has.
    """
    file = _UrdfFile(*_open(urdf))
    if unknown := set(locked_joints) - file.joints.keys():
        names = list(file.joints)
        raise ValueError(f"{file.path} has no joints {sorted(unknown)} to lock, only {names}")
    children = [_end(joint, "child") for joint in file.joints.values()]
    if tip is None:
        inner = {_end(joint, "parent") for joint in file.joints.values()}
        tip = [name for name in children if name not in inner][-1]
    if tip not in children:
        raise ValueError(f"{file.path}: tip is {tip!r}, expected a link behind a joint: {children}")
    joints: list[str] = []
    parents: list[int] = []
    placements: list[np.ndarray] = []
    inertia: list[np.ndarray] = []
    visited: dict[str, tuple[int, np.ndarray]] = {}

    def visit(link: str, body: int, pose: np.ndarray) -> None:
        """Add a link, at ``pose`` in the frame of the joint ``body``, and all links behind it."""
        visited[link] = body, pose
        if body >= 0:
            inertia[body] += mass_scale * pose @ file.pseudo_inertia(link) @ pose.T
            if link == tip:
                inertia[body] += payload * np.outer(pose[:, 3], pose[:, 3])
        for name, joint in file.joints.items():
            if _end(joint, "parent") != link:
                continue
            placement = pose @ file.pose(joint)
            if joint.get("type") == "fixed" or name in locked_joints:
                visit(_end(joint, "child"), body, placement)
                continue
            joints.append(name)
            parents.append(body)
            placements.append(placement)
            inertia.append(np.zeros((4, 4)))
            visit(_end(joint, "child"), len(joints) - 1, np.eye(4))

    visit(file.root, -1, np.eye(4))
    if unreached := file.links.keys() - visited.keys():
        links = sorted(unreached)
        raise ValueError(f"{file.path}: no joints lead from the base {file.root!r} to {links}")
    if not joints:
        raise ValueError(f"{file.path} has no joint that moves (locked: {list(locked_joints)})")
    return Tree(
        path=file.path,
        joints=joints,
        bodies=[_end(file.joints[name], "child") for name in joints],
        parents=parents,
        placements=torch.from_numpy(np.stack(placements)),
        axes=torch.from_numpy(np.stack([file.axis(name) for name in joints])),
        turning=[file.joints[name].get("type") in _TURNING for name in joints],
        inertia=torch.from_numpy(np.stack(inertia)),
        limits=np.array([file.limits(name) for name in joints]),
        tip_body=visited[tip][0],
        tip_pose=torch.from_numpy(visited[tip][1]),
    )


def urdf_text(urdf: str) -> str:
    """Return a URDF as text without shapes, behind a comment with its path; keep a text as it is.

    Raises:
        FileNotFoundError, ValueError: as :func:`read_urdf`.
    """
    if urdf.lstrip().startswith("<"):
        return urdf
    path, content = _open(urdf)
    _UrdfFile(path, content)  # refuses text that is no URDF
    text = ET.canonicalize(content, strip_text=True, exclude_tags=_UNREAD)
    return f"<!-- {urdf.replace('--', '-')} -->{text}"


class _UrdfFile:
    """The links and joints of a URDF by name, and their numbers."""

    def __init__(self, path: Path, content: bytes):
        self.path = path
        try:
            robot = ET.fromstring(content)
        except (ET.ParseError, LookupError, ValueError) as error:  # also unknown encodings
            raise ValueError(f"{path} is not valid XML for a URDF: {error}") from error
        self.links, self.joints = (self._by_name(robot, kind) for kind in ("link", "joint"))
        children = Counter(_end(joint, "child") for joint in self.joints.values())
        roots = [name for name in self.links if name not in children]
        shared = [name for name, count in children.items() if count > 1]
        if len(roots) != 1 or not children or shared:
            raise ValueError(
                f"{path}: expected a <robot> with joints and one base link; links without a parent "
                f"are {roots[:5]}, links of several parents {shared}"
            )
        self.root = roots[0]

    def axis(self, name: str) -> np.ndarray:
        """Return the unit axis of a joint that moves."""
        joint = self.joints[name]
        mimic, kind = joint.find("mimic") is not None, joint.get("type")
        if mimic or kind not in (*_TURNING, "prismatic"):
            kind = "a mimic joint" if mimic else repr(kind)
            expected = "revolute, continuous, prismatic or fixed: add it to locked_joints"
            raise ValueError(f"{self.path}: joint {name!r} is {kind}, expected {expected}")
        axis = self._numbers(joint, "axis", "xyz", 3, "1 0 0")
        return axis / np.linalg.norm(axis)

    def limits(self, name: str) -> list[float]:
        """Return lower and upper position, speed and effort of a joint; see :class:`Tree`."""
        joint = self.joints[name]
        keys = ("lower", "upper", "velocity", "effort")
        low, high, *limits = (self._numbers(joint, "limit", key, 1, "0")[0] for key in keys)
        if joint.get("type") == "continuous":
            low, high = -math.pi, math.pi
        return [low, high, *limits]

    def pose(self, owner: ET.Element) -> np.ndarray:
        """Return the ``<origin>`` of a joint or an ``<inertial>``, ``(4, 4)``."""
        pose = np.eye(4)
        rpy = self._numbers(owner, "origin", "rpy", 3, "0 0 0")
        pose[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        pose[:3, 3] = self._numbers(owner, "origin", "xyz", 3, "0 0 0")
        return pose

    def pseudo_inertia(self, link: str) -> np.ndarray:
        """Return J of a link in its frame, ``(4, 4)``; zero for a mere frame."""
        inertial = self.links[link].find("inertial")
        if inertial is None:
            return np.zeros((4, 4))
        mass = self._numbers(inertial, "mass", "value", 1)[0]
        keys = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
        values = [self._numbers(inertial, "inertia", key, 1)[0] for key in keys]
        xx, xy, yy, xz, yz, zz = values
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        slack = _TOLERANCE * np.abs(moments).max()
        if mass < 0 or moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack:
            raise ValueError(
                f"{self.path}: link {link!r} has mass {mass:g} kg and moments {moments.tolist()} "
                "kg m^2, expected none negative and no moment larger than the sum of the other two"
            )
        pose = self.pose(inertial)
        parameters = torch.tensor([mass, 0.0, 0.0, 0.0, *values], dtype=torch.float64)
        return pose @ pseudo_inertia(parameters).numpy() @ pose.T

    def _by_name(self, robot: ET.Element, kind: str) -> dict[str, ET.Element]:
        elements = robot.findall(kind)
        by_name = {element.get("name", ""): element for element in elements}
        if len(by_name) != len(elements):
            raise ValueError(f"{self.path} has several {kind}s of the same name")
        return by_name

    def _numbers(
        self, owner: ET.Element, tag: str, key: str, count: int, default: str = ""
    ) -> np.ndarray:
        """Return the numbers of an attribute, ``(count,)``, or the default."""
        element = owner.find(tag)
        text = default if element is None else element.get(key, default)
        try:
            values = np.array(text.split(), dtype=float)
        except ValueError:
            values = np.empty(0)
        if len(values) != count or not np.isfinite(values).all():
            raise ValueError(
                f"{self.path}: <{tag} {key}={text!r}> of {owner.get('name', 'an <inertial>')}, "
                f"expected {count} finite numbers"
            )
        return values


def _end(joint: ET.Element, end: str) -> str:
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _open(urdf: str) -> tuple[Path, bytes]:
    if urdf.lstrip().startswith("<"):
        return Path("URDF text"), urdf.encode()
    path = Path(urdf).expanduser()
    package = importlib.util.find_spec("pybullet_data")
    shipped = Path(package.origin).parent if package is not None and package.origin else Path()
    for file in (path, shipped / path):
        if file.is_file():
            return file.resolve(), file.read_bytes()
    raise FileNotFoundError(f"URDF {urdf!r} not found from {Path.cwd()}")
