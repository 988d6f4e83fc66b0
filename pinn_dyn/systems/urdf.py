"""Read the kinematic tree, the inertias and the limits of a robot with a fixed base from a URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pinn_dyn.exports.escaping import xml_comment
from pinn_dyn.systems.urdf_file import TEXT, UrdfFile

_UNREAD = {"visual", "collision", "material", "transmission", "gazebo"}


class Tree(NamedTuple):
    """N coordinates, and the B joints that they move, each with one rigid body.

    A body is a link with all links fixed to it. Joint k moves by ``coupling[k] @ q``: a joint that
    mimics another joint follows the coordinate of that joint.

    Attributes:
        path: the file.
        joints: names of the joints whose positions are the coordinates.
        movable: names of all joints that can be coordinates.
        locked: positions of the locked joints by name.
        bodies: names of the child links of the B joints.
        parents: index of the parent joint of each joint, -1 at the base; parents come first.
        placements: pose of each joint's frame at q = 0 in its parent's frame, ``(B, 4, 4)``.
        axes: unit axis of each joint in its own frame, ``(B, 3)``.
        revolute: true for a joint that turns, false for a joint that slides, ``(B,)``.
        turning: true for a coordinate that turns, false for a coordinate that slides, N.
        coupling: motion of the joints per motion of the coordinates, ``(B, N)``.
        inertia: pseudo-inertia of each body in its joint's frame, ``(B, 4, 4)``; kg, kg m, kg m^2.
        limits: lower and upper position, speed and effort of each coordinate, ``(N, 4)``; zero
            where the URDF has no limit, and positions -pi to pi for a continuous joint.
        tip_body: index of the body that carries the tip, -1 for the base.
        tip_pose: pose of the tip in that body's frame, ``(4, 4)``.
        held: joints that cannot be coordinates, with their types.
        unread: effects of an MJCF that the model leaves out, such as springs.
        problems: masses and inertias of moving links that are physically impossible.
    """

    path: Path
    joints: list[str]
    movable: list[str]
    locked: dict[str, float]
    bodies: list[str]
    parents: list[int]
    placements: Tensor
    axes: Tensor
    revolute: Tensor
    turning: list[bool]
    coupling: Tensor
    inertia: Tensor
    limits: np.ndarray
    tip_body: int
    tip_pose: Tensor
    held: list[str]
    unread: list[str]
    problems: list[str]


def read_urdf(
    urdf: str,
    *,
    joints: Sequence[str] | None = None,
    locked_joints: Sequence[str] | Mapping[str, float] = (),
    tip: str | None = None,
    mass_scale: float = 1.0,
    payload: float = 0.0,
) -> Tree:
    """Read a URDF or an MJCF. The arguments are those of :class:`~pinn_dyn.systems.RigidChain`.

    Raises:
        FileNotFoundError: if the file does not exist.
        ImportError: if the file is an MJCF and MuJoCo is not installed.
        ValueError: if the text is not the URDF of a tree of links, a joint or the tip is unknown,
            or no joint moves.
    """
    file = UrdfFile(urdf)
    joints, movable, locked = _joints(file, joints, locked_joints)
    children = [file.ends[name][1] for name in file.joints]
    if tip is None:
        tip = [name for name in children if not file.after(name)][-1]
    if tip not in children:
        raise ValueError(f"{file.path}: tip is {tip!r}, expected a child link: {children}")
    moving: list[str] = []
    parents: list[int] = []
    placements: list[np.ndarray] = []
    coupling: list[np.ndarray] = []
    inertia: list[np.ndarray] = []
    visited: dict[str, tuple[int, np.ndarray]] = {}

    def visit(link: str, body: int, pose: np.ndarray) -> None:
        """Add a link, at ``pose`` in the frame of the joint ``body``, and its descendants."""
        visited[link] = body, pose
        if body >= 0:
            inertia[body] += mass_scale * pose @ file.pseudo_inertia(link) @ pose.T
            if link == tip:
                inertia[body] += payload * np.outer(pose[:, 3], pose[:, 3])
        for name in file.after(link):
            driver, factor, offset = file.drive(name, (*joints, *locked))
            if driver not in joints:
                offset += factor * locked.get(driver, 0.0)
            placement = pose @ file.pose(name, offset)
            if driver not in joints or factor == 0:
                visit(file.ends[name][1], body, placement)
                continue
            moving.append(name)
            parents.append(body)
            placements.append(placement)
            coupling.append(factor * np.eye(len(joints))[joints.index(driver)])
            inertia.append(np.zeros((4, 4)))
            visit(file.ends[name][1], len(moving) - 1, np.eye(4))

    for root in file.roots:
        visit(root, -1, np.eye(4))
    return Tree(
        path=file.path,
        joints=joints,
        movable=movable,
        locked=locked,
        bodies=[file.ends[name][1] for name in moving],
        parents=parents,
        placements=torch.from_numpy(np.stack(placements)),
        axes=torch.from_numpy(np.stack([file.axes[name] for name in moving])),
        revolute=torch.tensor([file.turns(name) for name in moving]),
        turning=[file.turns(name) for name in joints],
        coupling=torch.from_numpy(np.stack(coupling)),
        inertia=torch.from_numpy(np.stack(inertia)),
        limits=np.array([file.limits(name) for name in joints]),
        tip_body=visited[tip][0],
        tip_pose=torch.from_numpy(visited[tip][1]),
        held=file.held,
        unread=[note.text or "" for note in file.robot.findall("note")],
        problems=file.problems,
    )


def _joints(
    file: UrdfFile,
    joints: Sequence[str] | None,
    locked_joints: Sequence[str] | Mapping[str, float],
) -> tuple[list[str], list[str], dict[str, float]]:
    """Return the joints of the coordinates, all movable joints, and positions of locked joints."""
    locked = dict.fromkeys(locked_joints, 0.0)
    locked |= locked_joints if isinstance(locked_joints, Mapping) else {}
    movable = [name for name in file.order if file.moves(name) and name not in locked]
    if joints is None:
        joints = [name for name in movable if file.drive(name)[0] == name]
    for key, names, allowed in (("locked_joints", locked, file.order), ("joints", joints, movable)):
        if wrong := [name for name in names if name not in allowed or [*names].count(name) > 1]:
            raise ValueError(
                f"{file.path}: {key} has {wrong}, expected different names out of {allowed}"
            )
    if not joints:
        raise ValueError(f"{file.path} has no joint that moves (locked: {list(locked)})")
    return list(joints), movable, locked


def urdf_text(urdf: str) -> str:
    """Return a robot file as a URDF without shapes, after a comment with its path.

    A robot that is given as the text of a URDF is returned unchanged.

    Raises:
        FileNotFoundError, ImportError, ValueError: as :func:`read_urdf`.
    """
    file = UrdfFile(urdf)
    if file.path == Path(TEXT):
        return urdf
    text = ET.tostring(file.robot, encoding="unicode")
    text = ET.canonicalize(text, strip_text=True, exclude_tags=_UNREAD)
    name = str(file.path) if "<" in urdf else urdf
    return f"<!-- {xml_comment(name)} -->{text}"
