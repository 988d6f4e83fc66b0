"""What a URDF has to be before Bullet sees it, which crashes or never returns on some."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

import numpy as np

TURNING = ("revolute", "continuous")
"""Types of joints that turn."""
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
"""Attributes of an inertia."""
MOST_BYTES = 20_000_000
MOST_DEPTH = 30
MOST_JOINTS = 100
"""Bullet's messages between client and server have room for 128 degrees of freedom."""
MOST_LETTERS = 200
"""Of a name, for which Bullet has fixed room too."""

_LARGEST = 1000.0  # m or rad, of an origin
_HEAVIEST = 1e6  # kg, and kg m^2: beyond it Bullet's arithmetic ends
_TOLERANCE = 1e-6  # of the largest principal moment
_NUMBER = re.compile(r"\s*[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?\s*")


class _Builder(ET.TreeBuilder):
    """Builds the tree; stops at a document type, whose entities grow without end, and at depth."""

    depth = 0

    def doctype(self, *_: str | None) -> None:
        raise ET.ParseError("it declares a document type, which no URDF needs: remove <!DOCTYPE>")

    def start(self, tag: str, attrs: dict[str, str]) -> ET.Element:
        self.depth += 1
        if self.depth > MOST_DEPTH:
            raise ET.ParseError(f"its elements are more than {MOST_DEPTH} levels deep")
        return super().start(tag, attrs)

    def end(self, tag: str) -> ET.Element:
        self.depth -= 1
        return super().end(tag)


def parse_urdf(path: Path, content: bytes, *, inertias: bool = True) -> ET.Element:
    """The ``<robot>`` element of a URDF, its links and joints a tree, its numbers numbers.

    Without ``inertias`` those of the file are not looked at, nor is that of the root ever, as it
    does not move.

    Raises:
        ValueError: on text that is no URDF; a link or joint without a name, or with one that there
            is twice; links that are no tree with one root; an origin or axis that is not three
            finite numbers, an axis of length zero; a mass that is negative or a mountain's; an
            inertia that no body has, which is one with a negative principal moment or one larger
            than the sum of the other two.
    """
    if len(content) > MOST_BYTES:
        raise ValueError(
            f"{path} has {len(content)} bytes, expected a URDF of at most {MOST_BYTES}"
        )
    try:
        robot = ET.fromstring(content, ET.XMLParser(target=_Builder()))
    except (ET.ParseError, LookupError, ValueError) as error:  # also unknown encodings
        raise ValueError(f"{path} is not valid XML for a URDF: {error}") from error
    joints = robot.findall("joint")
    if robot.tag != "robot" or not joints:
        raise ValueError(
            f"{path} holds <{robot.tag}> with {len(joints)} joints, expected <robot> with at least "
            "one: is it a URDF?"
        )
    if len(joints) > MOST_JOINTS:
        raise ValueError(f"{path} has {len(joints)} joints, expected at most {MOST_JOINTS}")
    for kind in ("link", "joint"):
        _check_names(path, kind, [one.get("name", "") for one in robot.findall(kind)])
    root = _check_tree(path, robot)
    for owner in [*robot.findall("link"), *joints]:
        for origin in owner.iter("origin"):
            for key in ("xyz", "rpy"):
                three_numbers(path, owner, origin, key, _LARGEST)
    for joint in joints:
        _check_joint(path, joint)
    for link in robot.findall("link"):
        _check_inertial(path, link, inertias and link.get("name") != root)
    return robot


def link_of(joint: ET.Element, end: str) -> str:
    """The ``parent`` or ``child`` of a joint that :func:`parse_urdf` has let pass."""
    return joint.find(end).get("link", "")  # type: ignore[union-attr]


def tip_of(path: Path, robot: ET.Element, tip: str | None) -> str:
    """The link at the end of a robot; by default the last of the file with no joint behind it."""
    joints = robot.findall("joint")
    children = [link_of(joint, "child") for joint in joints]
    if tip is None:
        parents = {link_of(joint, "parent") for joint in joints}
        return [name for name in children if name not in parents][-1]
    if tip not in children:
        raise ValueError(
            f"{path}: tip is {tip!r}, expected a link behind a joint: {', '.join(children)}"
        )
    return tip


def number(path: Path, owner: str, element: ET.Element, key: str) -> float:
    """A finite number."""
    text = element.get(key, "")
    value = _float(text)
    if not math.isfinite(value):
        raise ValueError(
            f"{path}: {owner!r} has <{element.tag} {key}={text[:80]!r}>, expected a finite number"
        )
    return value


def _float(text: str) -> float:
    """The number that Python and Bullet both read in a text; else NaN, as of 1_0 and of \u0661."""
    return float(text) if _NUMBER.fullmatch(text) else math.nan


def three_numbers(
    path: Path, owner: ET.Element, element: ET.Element, key: str, largest: float
) -> np.ndarray | None:
    """Three finite numbers of at most ``largest``; None if there is no such attribute."""
    text = element.get(key)
    if text is None:
        return None
    values = np.array([_float(word) for word in text.split()])
    if len(values) != 3 or not (np.abs(values) <= largest).all():
        raise ValueError(
            f"{path}: {owner.tag} {owner.get('name')!r} has <{element.tag} {key}={text[:80]!r}>, "
            f"expected three numbers of at most {largest:g}"
        )
    return values


def _check_names(path: Path, kind: str, names: list[str]) -> None:
    for name, count in Counter(names).items():
        if not name.strip():
            raise ValueError(f"{path} has a {kind} without a name, expected <{kind} name='...'>")
        if count > 1:
            raise ValueError(
                f"{path} has {count} {kind}s named {name[:80]!r}, expected each name once"
            )
        if len(name) > MOST_LETTERS:
            raise ValueError(
                f"{path} has a {kind} whose name has {len(name)} letters, expected at most "
                f"{MOST_LETTERS}: {name[:40]!r}..."
            )


def _check_tree(path: Path, robot: ET.Element) -> str:
    """One root, every other link the child of one joint, all of them reached; returns the root."""
    links = [link.get("name", "") for link in robot.findall("link")]
    moved_by: dict[str, str] = {}
    below: dict[str, list[str]] = {}
    for joint in robot.findall("joint"):
        for end in ("parent", "child"):
            found = [one.get("link", "") for one in joint.findall(end)]
            if len(found) != 1 or found[0] not in links:
                raise ValueError(
                    f"{path}: joint {joint.get('name')!r} has the {end} "
                    f"{', '.join(map(repr, found))}, which is no link: expected one of "
                    f"{', '.join(links)}"
                )
        parent, child = link_of(joint, "parent"), link_of(joint, "child")
        if child in moved_by:
            raise ValueError(
                f"{path}: link {child!r} is the child of the joints {moved_by[child]!r} and "
                f"{joint.get('name')!r}, expected one: a closed loop is not a URDF"
            )
        moved_by[child] = joint.get("name", "")
        below.setdefault(parent, []).append(child)
    roots = [name for name in links if name not in moved_by]
    if len(roots) > 1:
        raise ValueError(
            f"{path} has {len(roots)} links that no joint moves ({', '.join(roots[:5])}), expected "
            "one root, the base: join the others to it, or remove them"
        )
    reached = list(roots)
    for name in reached:
        reached += below.get(name, [])
    if lost := [name for name in links if name not in reached]:
        raise ValueError(
            f"{path}: the links {', '.join(lost[:5])} are parents of each other in a circle, "
            "expected a tree that starts at one root"
        )
    return roots[0]


def _check_joint(path: Path, joint: ET.Element) -> None:
    for axis in joint.findall("axis") if joint.get("type") != "fixed" else []:
        values = three_numbers(path, joint, axis, "xyz", _LARGEST)
        if values is not None and np.linalg.norm(values) < _TOLERANCE:
            raise ValueError(
                f"{path}: joint {joint.get('name')!r} has the axis {axis.get('xyz')!r}, of length "
                "0, expected a direction such as '0 0 1'"
            )
    for limit in joint.findall("limit"):
        for key in ("velocity", "effort"):
            if limit.get(key) is not None and number(path, joint.get("name", ""), limit, key) < 0:
                raise ValueError(
                    f"{path}: joint {joint.get('name')!r} has the limit {key} = {limit.get(key)}, "
                    "expected at least 0"
                )


def _check_inertial(path: Path, link: ET.Element, counts: bool) -> None:
    name = link.get("name", "")
    if len(link.findall("inertial")) > 1:
        raise ValueError(f"{path}: link {name!r} has several <inertial>, expected at most one")
    mass = link.find("inertial/mass")
    if mass is not None and not 0 <= (value := number(path, name, mass, "value")) <= _HEAVIEST:
        raise ValueError(
            f"{path}: link {name!r} has mass {value:g} kg, expected from 0 to {_HEAVIEST:g}"
        )
    inertia = link.find("inertial/inertia")
    if inertia is None or not counts:
        return
    xx, xy, xz, yy, yz, zz = (number(path, name, inertia, key) for key in MOMENTS)
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if np.abs(tensor).max() > _HEAVIEST:
        raise ValueError(
            f"{path}: link {name!r} has an inertia of {np.abs(tensor).max():g} kg m^2, expected at "
            f"most {_HEAVIEST:g}"
        )
    moments = np.linalg.eigvalsh(tensor)
    slack = _TOLERANCE * np.abs(moments).max()
    if moments[0] < -slack or moments[2] > moments[0] + moments[1] + slack:
        raise ValueError(
            f"{path}: link {name!r} has the principal moments of inertia "
            f"{', '.join(f'{x:.3g}' for x in moments)} kg m^2, expected none negative and none "
            "larger than the sum of the other two, as of any body"
        )
