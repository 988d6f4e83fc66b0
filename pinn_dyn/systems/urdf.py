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

from pinn_dyn.spelling import did_you_mean
from pinn_dyn.systems.inertia import pseudo_inertia

_TURNING = ("revolute", "continuous")
_TOLERANCE = 1e-6  # of the largest principal moment of inertia


class Tree(NamedTuple):
    """N moving joints, each with one rigid body: a link and everything fixed to it.

    Attributes:
        path: the file.
        joints, bodies: names of the joints and of the links behind them.
        parents: index of the joint before each joint, -1 at the base; parents come first.
        placements: pose of each joint's frame at q = 0 in its parent's frame, ``(N, 4, 4)``.
        axes: unit axis of each joint in its own frame, ``(N, 3)``.
        turning: true for a joint that turns, false for one that slides.
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
    """Read a URDF: a file, one that ships with PyBullet, or the text itself.

    Args:
        urdf: path or text.
        locked_joints: names of joints that stay at zero.
        tip: link at the end of the arm; None for the last of the file without a joint behind it.
        mass_scale: factor of all masses and inertias.
        payload: point mass at the origin of the tip, kg, which is not scaled.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: on text that is no URDF of a tree of links, an unknown locked joint or tip, a
            joint that is neither revolute, continuous, prismatic nor fixed, a mimic joint, no
            joint that moves, or a mass or inertia that no body has.
    """
    file = _UrdfFile(*_open(urdf))
    for name in locked_joints:
        if name not in file.joints:
            raise ValueError(
                f"{file.path} has no joint {name!r} to lock: its joints are {list(file.joints)}"
            )
    tip = file.tip(tip)
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
        raise ValueError(
            f"{file.path}: the links {', '.join(sorted(unreached))} are parents of each other in "
            "a circle, expected a tree that starts at one root"
        )
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


class _UrdfFile:
    """The links and joints of a URDF by name, and their numbers."""

    def __init__(self, path: Path, content: bytes):
        self.path = path
        try:
            robot = ET.fromstring(content)
        except (ET.ParseError, LookupError, ValueError) as error:  # also unknown encodings
            raise ValueError(f"{path} is not valid XML for a URDF: {error}") from error
        if robot.tag != "robot" or robot.find("joint") is None:
            raise ValueError(f"{path} is <{robot.tag}>, expected the <robot> of a URDF with joints")
        self.links = self._by_name(robot, "link")
        self.joints = self._by_name(robot, "joint")
        children = Counter(_end(joint, "child") for joint in self.joints.values())
        for name, joint in self.joints.items():
            for end in ("parent", "child"):
                if (link := _end(joint, end)) not in self.links:
                    raise ValueError(
                        f"{path}: joint {name!r} has the {end} {link!r}, which is no link: "
                        f"expected one of {', '.join(self.links)}"
                    )
            if children[link] > 1:
                raise ValueError(
                    f"{path}: link {link!r} is the child of {children[link]} joints, expected one: "
                    "a closed loop is not a URDF"
                )
        roots = [name for name in self.links if name not in children]
        if len(roots) != 1:
            raise ValueError(
                f"{path} has {len(roots)} links that no joint moves ({', '.join(roots[:5])}), "
                "expected one root, the base: join the others to it, or remove them"
            )
        self.root = roots[0]

    def tip(self, tip: str | None) -> str:
        """Return the link at the end of the robot."""
        children = [_end(joint, "child") for joint in self.joints.values()]
        if tip is None:
            parents = {_end(joint, "parent") for joint in self.joints.values()}
            return [name for name in children if name not in parents][-1]
        if tip not in children:
            raise ValueError(
                f"{self.path}: tip is {tip!r}, expected a link behind a joint: "
                f"{', '.join(children)}"
            )
        return tip

    def axis(self, name: str) -> np.ndarray:
        """Return the unit axis of a joint that moves."""
        joint = self.joints[name]
        mimic, kind = joint.find("mimic") is not None, joint.get("type")
        if mimic or kind not in (*_TURNING, "prismatic"):
            raise ValueError(
                f"{self.path}: joint {name!r} is {'a mimic joint' if mimic else repr(kind)}, "
                "expected revolute, continuous, prismatic or fixed: add it to locked_joints"
            )
        axis = self._numbers(joint, "axis", "xyz", 3, "1 0 0")
        length = np.linalg.norm(axis)
        if length < _TOLERANCE:
            raise ValueError(
                f"{self.path}: joint {name!r} has the axis {axis.tolist()} of length 0, expected a "
                "direction such as '0 0 1'"
            )
        return axis / length

    def limits(self, name: str) -> list[float]:
        """Return lower and upper position, speed and effort of a joint; zero where there is none.

        A continuous joint turns without end; -pi to pi is the range that is explored.
        """
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
        """Return J of a link in its own frame, ``(4, 4)``; zero for a mere frame."""
        inertial = self.links[link].find("inertial")
        if inertial is None:
            return np.zeros((4, 4))
        missing = None if inertial.find("mass") is not None else "0"
        mass = self._numbers(inertial, "mass", "value", 1, missing)[0]
        missing = None if inertial.find("inertia") is not None else "0"
        keys = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
        values = [self._numbers(inertial, "inertia", key, 1, missing)[0] for key in keys]
        xx, xy, yy, xz, yz, zz = values
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        slack = _TOLERANCE * np.abs(moments).max()
        if mass < 0 or moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack:
            raise ValueError(
                f"{self.path}: link {link!r} has mass {mass:g} kg and the principal moments of "
                f"inertia {', '.join(f'{x:.3g}' for x in moments)} kg m^2, expected none negative "
                "and no moment larger than the sum of the other two"
            )
        pose = self.pose(inertial)
        parameters = torch.tensor([mass, 0.0, 0.0, 0.0, *values], dtype=torch.float64)
        return pose @ pseudo_inertia(parameters).numpy() @ pose.T

    def _by_name(self, robot: ET.Element, kind: str) -> dict[str, ET.Element]:
        elements = robot.findall(kind)
        names = Counter(element.get("name", "") for element in elements)
        for name, count in names.items():
            if count > 1 or not name:
                raise ValueError(
                    f"{self.path} has {count} {kind}s named {name!r}, expected a name for each "
                    f"{kind}, and each name once"
                )
        return dict(zip(names, elements, strict=True))

    def _numbers(
        self, owner: ET.Element, tag: str, key: str, count: int, default: str | None
    ) -> np.ndarray:
        """Return the numbers of an attribute, ``(count,)``, or the default."""
        element = owner.find(tag)
        text = default if element is None else element.get(key, default)
        try:
            values = np.array([float(number) for number in (text or "").split()])
        except ValueError:
            values = np.empty(0)
        if len(values) != count or not np.isfinite(values).all():
            name = owner.get("name") or next(
                name for name, link in self.links.items() if owner in link
            )
            raise ValueError(
                f"{self.path}: {name!r} has <{tag} {key}={(text or '')[:80]!r}>, expected {count} "
                f"finite number{'s' if count > 1 else ''}"
            )
        return values


def _end(joint: ET.Element, end: str) -> str:
    """Return the ``parent`` or ``child`` of a joint, empty if it has none."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


def _open(urdf: str) -> tuple[Path, bytes]:
    if urdf.lstrip().startswith("<"):
        return Path("URDF text"), urdf.encode()
    path = Path(urdf).expanduser()
    folders = [Path()]
    package = importlib.util.find_spec("pybullet_data")
    if package is not None and package.origin:
        folders.append(Path(package.origin).parent)
    for folder in folders:
        if (folder / path).is_file():
            file = (folder / path).resolve()
            return file, file.read_bytes()
    near = [str(file) for file in path.parent.glob("*.urdf")]
    near += [str(file.relative_to(folders[-1])) for file in folders[-1].glob("*/*.urdf")]
    hint = did_you_mean(urdf, near) or ": give the path of a URDF"
    raise FileNotFoundError(f"URDF {urdf!r} not found from {Path.cwd()}{hint}")
