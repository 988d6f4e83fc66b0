"""Read the links and joints of a robot file."""

from __future__ import annotations

import importlib.util
import itertools
import math
import re
import shlex
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Collection
from pathlib import Path

import numpy as np
import scipy
import torch

from pinn_dyn.systems.inertia import pseudo_inertia
from pinn_dyn.systems.mjcf import mjcf_to_urdf

TEXT = "URDF text"
"""Path of a URDF that was passed as text."""
_DEFINITIONS = ("arg", "include", "macro", "property")  # tags of xacro
_TURNING = ("revolute", "continuous")
_MOVING = (*_TURNING, "prismatic")
_HELD = ("floating", "planar", "spherical")
_TOLERANCE = 1e-6  # error of moments of inertia, relative to the largest principal moment
_ROUNDING = 1e-12  # kg m^2


class UrdfFile:
    """Links and joints of a URDF.

    Attributes:
        path: the file.
        robot: its XML without namespaces.
        links, joints: elements by name.
        ends: names of the parent and child links of each joint.
        axes: unit axes of the joints that move.
        roots: links without a parent.
        order: names of the joints, depth first.
        problems: masses and inertias that are physically impossible, of the links read so far.

    Raises:
        FileNotFoundError: if the file does not exist.
        ValueError: if the file is not a URDF, its links and joints are not a tree, or a number of
            their poses is missing. The message lists all mistakes.
    """

    def __init__(self, urdf: str):
        self.path, self.robot = _read(urdf)
        self.problems: list[str] = []
        mistakes: list[str] = []
        self.links = self._by_name("link", mistakes)
        self.joints = self._by_name("joint", mistakes)
        self.ends = {name: _ends(joint) for name, joint in self.joints.items()}
        linked = set[str]().union(*self.ends.values())
        if "world" in linked:  # of Drake, which need not be defined
            self.links.setdefault("world", ET.Element("link", name="world"))
        if undefined := linked - self.links.keys():
            mistakes.append(f"joints name the links {sorted(undefined)}, which are not defined")
        children = Counter(child for _, child in self.ends.values())
        if shared := [name for name, count in children.items() if count > 1]:
            mistakes.append(f"the links {shared} have several parents, expected a tree")
        self._poses: dict[str, np.ndarray] = {}
        self.axes: dict[str, np.ndarray] = {}
        self._mimics: dict[str, tuple[str, float, float]] = {}
        for name, joint in self.joints.items():
            self._read_joint(name, joint, mistakes)
        self.roots = [name for name in self.links if name not in children]
        self.order: list[str] = []
        if not shared:
            self.order = list(itertools.chain.from_iterable(map(self._descendants, self.roots)))
            reached = {self.ends[name][1] for name in self.order}
            if circle := sorted(children.keys() - reached):
                mistakes.append(f"no joints lead from a base to the links {circle}")
        if mistakes:
            more = f"; and {len(mistakes) - 10} more" if len(mistakes) > 10 else ""
            raise ValueError(f"{self.path}: {'; '.join(mistakes[:10])}{more}")

    def _by_name(self, kind: str, mistakes: list[str]) -> dict[str, ET.Element]:
        elements = self.robot.findall(kind)
        by_name = {element.get("name", ""): element for element in elements}
        counts = Counter(element.get("name", "") for element in elements)
        if double := [name for name, count in counts.items() if count > 1]:
            mistakes.append(f"several {kind}s have the same name: {double}")
        if not elements:
            mistakes.append(f"there is no <{kind}>, expected a <robot> with links and joints")
        return by_name

    def _read_joint(self, name: str, joint: ET.Element, mistakes: list[str]) -> None:
        self._poses[name] = _pose(name, joint, mistakes)
        if (kind := joint.get("type")) not in (*_MOVING, *_HELD, "fixed"):
            expected = ", ".join((*_MOVING, "fixed"))
            mistakes.append(f"joint {name!r} has the type {kind!r}, expected {expected}")
        if not self.moves(name):
            return
        axis = _numbers(name, joint, "axis", "xyz", "1 0 0", mistakes)
        length = np.linalg.norm(axis)
        if length == 0:
            mistakes.append(f"joint {name!r} has the axis 0 0 0, expected a direction")
        self.axes[name] = axis / max(length, 1e-300)
        mimic = joint.find("mimic")
        if mimic is not None and mimic.get("joint") in self.joints:
            factor = _numbers(name, joint, "mimic", "multiplier", "1", mistakes)[0]
            offset = _numbers(name, joint, "mimic", "offset", "0", mistakes)[0]
            self._mimics[name] = (mimic.get("joint", ""), float(factor), float(offset))

    def _descendants(self, link: str) -> list[str]:
        """Return the names of all joints after a link, depth first."""
        names = []
        for name in self.after(link):
            names += [name, *self._descendants(self.ends[name][1])]
        return names

    def after(self, link: str) -> list[str]:
        """Return the names of the joints whose parent is a link."""
        return [name for name, (parent, _) in self.ends.items() if parent == link]

    def moves(self, name: str) -> bool:
        """Return true for a joint with one coordinate."""
        return self.joints[name].get("type") in _MOVING

    def turns(self, name: str) -> bool:
        """Return true for a joint that turns."""
        return self.joints[name].get("type") in _TURNING

    def drive(self, name: str, stops: Collection[str] = ()) -> tuple[str, float, float]:
        """Return the joint that drives a joint, with factor and offset of the motion.

        This is the end of the chain of mimicked joints, or the first joint of it in ``stops``. A
        joint that mimics no joint drives itself.
        """
        factor, offset = 1.0, 0.0
        for _ in self.joints:  # ends even if joints mimic each other in a circle
            if name in stops or name not in self._mimics:
                break
            name, multiplier, shift = self._mimics[name]
            offset += factor * shift
            factor *= multiplier
        return name, factor, offset

    @property
    def held(self) -> list[str]:
        """Names and types of the joints with several coordinates."""
        kinds = {name: self.joints[name].get("type") for name in self.order}
        return [f"{name} ({kind})" for name, kind in kinds.items() if kind in _HELD]

    def pose(self, name: str, position: float = 0.0) -> np.ndarray:
        """Return the pose of the child link of a joint in its parent link, ``(4, 4)``."""
        motion = np.eye(4)
        if position and self.turns(name):
            motion[:3, :3] = scipy.spatial.transform.Rotation.from_rotvec(
                position * self.axes[name]
            ).as_matrix()
        elif position and self.moves(name):
            motion[:3, 3] = position * self.axes[name]
        return self._poses[name] @ motion

    def limits(self, name: str) -> list[float]:
        """Return the limits of a joint: lower, upper, velocity, effort; zero where unreadable."""
        joint = self.joints[name]
        keys = ("lower", "upper", "velocity", "effort")
        low, high, *limits = (float(_numbers(name, joint, "limit", x, "0", [])[0]) for x in keys)
        if joint.get("type") == "continuous":
            low, high = -math.pi, math.pi
        return [low, high, *limits]

    def pseudo_inertia(self, name: str) -> np.ndarray:
        """Return J of a link in its frame, ``(4, 4)``; zero for a link without ``<inertial>``."""
        inertial = self.links[name].find("inertial")
        if inertial is None:
            return np.zeros((4, 4))
        mistakes: list[str] = []
        mass = float(_numbers(name, inertial, "mass", "value", "", mistakes)[0])
        keys = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
        values = [_numbers(name, inertial, "inertia", key, "0", mistakes)[0] for key in keys]
        xx, xy, yy, xz, yz, zz = values
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        slack = _TOLERANCE * np.abs(moments).max() + _ROUNDING
        limit = 100 * mass if mass > 0 else math.inf  # radius of gyration of 10 m
        if mass < 0 or moments[0] < -slack or moments[2] > min(limit, sum(moments[:2])) + slack:
            mistakes.append(
                f"link {name!r} has mass {mass:g} kg and moments {moments.tolist()} kg m^2, "
                "expected no negative number, no moment larger than the sum of the other two, and "
                "no body of 10 m or more (units: kg, m)"
            )
        pose = _pose(name, inertial, mistakes)
        self.problems += mistakes
        parameters = torch.tensor([mass, 0.0, 0.0, 0.0, *values], dtype=torch.float64)
        return pose @ pseudo_inertia(parameters).numpy() @ pose.T


def is_text(urdf: str) -> bool:
    """Return true for the text of a robot file, false for its path."""
    return urdf.lstrip("\ufeff \r\n\t").startswith("<")


def is_mjcf(urdf: str) -> bool:
    """Return true for the path or text of an MJCF, which only MuJoCo can read."""
    try:
        return _content(urdf)[1].tag == "mujoco"
    except (OSError, ValueError):
        return False


def _ends(joint: ET.Element) -> tuple[str, str]:
    parent, child = joint.find("parent"), joint.find("child")
    names = ["" if end is None else end.get("link", "") for end in (parent, child)]
    return names[0], names[1]


def _pose(name: str, element: ET.Element, mistakes: list[str]) -> np.ndarray:
    """Return the pose in the ``<origin>`` of a joint or an ``<inertial>``, ``(4, 4)``."""
    pose = np.eye(4)
    rpy = _numbers(name, element, "origin", "rpy", "0 0 0", mistakes)
    pose[:3, :3] = scipy.spatial.transform.Rotation.from_euler("xyz", rpy).as_matrix()
    pose[:3, 3] = _numbers(name, element, "origin", "xyz", "0 0 0", mistakes)
    return pose


def _numbers(
    name: str, element: ET.Element, tag: str, key: str, default: str, mistakes: list[str]
) -> np.ndarray:
    """Return the numbers of an attribute, or the default if their count is not that of it."""
    usual = np.array((default or "0").split(), dtype=float)
    child = element.find(tag)
    text = default if child is None else child.get(key, default)
    try:
        values = np.array(text.replace(",", " ").split(), dtype=float)
    except ValueError:
        values = np.empty(0)
    if len(values) == len(usual) and np.isfinite(values).all():
        return values
    mistakes.append(f"<{tag} {key}={text!r}> of {name}, expected {len(usual)} finite numbers")
    return usual


def _read(urdf: str) -> tuple[Path, ET.Element]:
    """Return the path and the ``<robot>`` of a URDF or MJCF."""
    path, root = _content(urdf)
    if root.tag == "mujoco":
        root = ET.fromstring(mjcf_to_urdf(urdf if is_text(urdf) else path))
        path = Path("MJCF text") if is_text(urdf) else path
    if root.find("{*}link") is not None:  # remaining definitions of xacro add no links
        for child in [x for x in root if "xacro" in x.tag and x.tag.endswith(_DEFINITIONS)]:
            root.remove(child)
    if any("xacro" in x.tag or "${" in "".join(x.attrib.values()) for x in root.iter()):
        raise ValueError(
            f"{path} is a xacro file, expected a URDF: convert it by "
            f"xacro {shlex.quote(str(path))} > robot.urdf"
        )
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    robot = root if root.tag == "robot" else root.find(".//robot")
    if robot is None:
        kind = f"XML with the root <{root.tag}>"
        raise ValueError(f"{path} is {kind}, expected the URDF or the MJCF of the robot")
    return path, robot


def _content(urdf: str) -> tuple[Path, ET.Element]:
    """Return the path and the root of an XML file or text."""
    path, content = (Path(TEXT), urdf.encode()) if is_text(urdf) else _open(urdf)
    try:
        return path, _parse(content)
    except (ET.ParseError, LookupError, ValueError) as error:  # LookupError: unknown encoding
        page = ": it is a web page" if b"<html" in content[:2000].lower() else ""
        raise ValueError(f"{path} is not valid XML for a URDF: {error}{page}") from error


def _open(urdf: str) -> tuple[Path, bytes]:
    path = Path(urdf).expanduser()
    folders = [Path(), Path(__file__).parent / "robots"]
    package = importlib.util.find_spec("pybullet_data")
    if package is not None and package.origin:
        folders.append(Path(package.origin).parent)
    for file in (folder / path for folder in folders):
        if file.is_file():
            return file.resolve(), file.read_bytes()
    raise FileNotFoundError(f"URDF {urdf!r} not found from {Path.cwd()}")


def _parse(content: bytes) -> ET.Element:
    """Parse XML, also if its declared encoding is wrong or its prefixes are undeclared."""
    try:
        return ET.fromstring(content)
    except (ET.ParseError, LookupError, ValueError):
        encoding = "utf-16" if b"\0" in content[:4] else "utf-8-sig"
        try:
            text = content.decode(encoding)
        except UnicodeDecodeError:
            text = content.decode("cp1252", "replace")
        prefixes = r"""(</?[\w.-]+|\s[\w.-]+(?=:[\w.-]+\s*=\s*["'])):"""
        return ET.fromstring(re.sub(prefixes, r"\1_", text.strip("\ufeff \r\n\t")))
