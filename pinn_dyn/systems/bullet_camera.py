"""Pictures of an arm by Bullet's software renderer, without a display."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pinn_dyn.systems.bullet_client import connect


def photograph(
    urdf: Path, joint_names: Sequence[str], q: np.ndarray, points: np.ndarray, size: tuple[int, int]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Pictures of the arm of a URDF, from where it and some points are in view at all times.

    Joints that are not named are at zero.

    Args:
        urdf: the file, with its visual shapes.
        joint_names: of the joints that q belongs to, N.
        q: configurations, ``(T, N)``, rad.
        points: points in the frame of the base, ``(P, 3)``, m.
        size: width W and height H, pixels.

    Returns:
        T pictures ``(H, W, 3)`` of bytes, and columns and rows of the points, ``(P, 2)``.
    """
    bullet = connect()
    try:
        body = bullet.loadURDF(str(urdf), useFixedBase=True)
        links = list(range(bullet.getNumJoints(body)))
        names = [bullet.getJointInfo(body, link)[1].decode() for link in links]
        joints = [names.index(name) for name in joint_names]

        def pose(row: np.ndarray) -> None:
            for joint, angle in zip(joints, row.tolist(), strict=True):
                bullet.resetJointState(body, joint, angle)

        seen = [np.zeros((1, 3)), points]
        for row in q:
            pose(row)
            states = bullet.getLinkStates(body, links, computeForwardKinematics=True)
            seen.append(np.array([state[4] for state in states]))
        view, projection = camera(bullet, np.concatenate(seen), size)
        pictures = []
        for row in q:
            pose(row)
            width, height, rgba, *_ = bullet.getCameraImage(
                *size,
                view,
                projection,
                shadow=0,
                renderer=bullet.ER_TINY_RENDERER,
                flags=bullet.ER_NO_SEGMENTATION_MASK,
            )
            pictures.append(np.reshape(rgba, (height, width, 4))[..., :3].astype(np.uint8))
    finally:
        bullet.disconnect()
    return pictures, pixels(points, view, projection, size)


def camera(
    bullet: Any, points: np.ndarray, size: tuple[int, int]
) -> tuple[list[float], list[float]]:
    """View and projection that hold all points, and 0.1 m of what surrounds them."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = np.linalg.norm(points - middle, axis=1).max() + 0.1
    view = bullet.computeViewMatrixFromYawPitchRoll(
        middle.tolist(), 3 * radius, yaw=50, pitch=-20, roll=0, upAxisIndex=2
    )
    x, y, z, _ = np.reshape(view, (4, 4), order="F") @ _homogeneous(points)
    aspect = size[0] / size[1]
    slope = max(((abs(x) + 0.1) / aspect / -z).max(), ((abs(y) + 0.1) / -z).max())
    angle = 2 * np.degrees(np.arctan(slope))
    return view, bullet.computeProjectionMatrixFOV(angle, aspect, 2 * radius, 4 * radius)


def pixels(
    points: np.ndarray, view: list[float], projection: list[float], size: tuple[int, int]
) -> np.ndarray:
    """Columns and rows of points ``(P, 3)``, ``(P, 2)``; Bullet's matrices come by columns."""
    look, project = (np.reshape(matrix, (4, 4), order="F") for matrix in (view, projection))
    x, y, _, w = project @ look @ _homogeneous(points)
    x, y = x / w, y / w
    return np.column_stack([(x + 1) / 2 * size[0], (1 - y) / 2 * size[1]])


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.vstack([points.T, np.ones(len(points))])
