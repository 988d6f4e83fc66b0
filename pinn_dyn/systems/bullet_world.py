"""A PyBullet client with one arm in it, where nothing acts but gravity and given torques."""

from __future__ import annotations

import functools
import os
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pinn_dyn.systems.urdf import Inertia


class World(NamedTuple):
    """A Bullet client of this process that holds one arm."""

    bullet: Any
    client: int
    body: int
    joints: list[int]  # N, those that move
    names: list[str]  # N
    links: list[int]  # all but the base
    masses: np.ndarray  # (links,)
    moments: dict[str, float]  # sum of the principal moments, by link


def open_world(text: str, inertia: Inertia, gravity: tuple[float, ...]) -> World:
    """The client of this process that holds the arm of a URDF's text, opened on the first call."""
    # The process is part of the key, as a forked one must not use the clients of its parent.
    return _open_world(os.getpid(), text, inertia, gravity)


@functools.cache
def _open_world(pid: int, text: str, inertia: Inertia, gravity: tuple[float, ...]) -> World:
    bullet = import_bullet()
    client = bullet.connect(bullet.DIRECT)
    target = {"physicsClientId": client}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(text, encoding="utf-8")
        flags = bullet.URDF_USE_INERTIA_FROM_FILE if inertia == "file" else 0
        body = bullet.loadURDF(str(path), useFixedBase=True, flags=flags, **target)
    bullet.setGravity(*gravity, **target)
    links = list(range(bullet.getNumJoints(body, **target)))
    infos = [bullet.getJointInfo(body, link, **target) for link in links]
    joints = [
        link for link, info in zip(links, infos, strict=True) if info[2] != bullet.JOINT_FIXED
    ]
    for link in links:
        bullet.changeDynamics(
            body, link, linearDamping=0, angularDamping=0, jointDamping=0, **target
        )
    # Bullet holds every joint by a velocity motor, as strong as its friction, unless told not to.
    idle = [0.0] * len(joints)
    bullet.setJointMotorControlArray(body, joints, bullet.VELOCITY_CONTROL, forces=idle, **target)
    dynamics = [bullet.getDynamicsInfo(body, link, **target) for link in links]
    return World(
        bullet,
        client,
        body,
        joints,
        names=[infos[joint][1].decode() for joint in joints],
        links=links,
        masses=np.array([values[0] for values in dynamics]),
        moments={
            info[12].decode(): sum(values[2]) for info, values in zip(infos, dynamics, strict=True)
        },
    )


def import_bullet() -> Any:
    """PyBullet, which is an optional extra.

    Raises:
        ImportError: saying what to install.
    """
    try:
        import pybullet
    except ImportError as error:
        raise ImportError(
            "BulletArm needs PyBullet, which is not installed: pip install 'pinn_dyn[panda]' (its "
            "wheels exist for Python 3.10 and 3.11)"
        ) from error
    return pybullet
