"""A PyBullet client with one arm in it, where nothing acts but gravity and given torques."""

from __future__ import annotations

import functools
import inspect
import os
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from pinn_dyn.systems.urdf import POINT_MASS, Inertia


class World(NamedTuple):
    """A Bullet client of this process that holds one arm."""

    bullet: Any
    body: int
    joints: list[int]  # N, those that move
    names: list[str]  # N
    links: list[int]  # all but the base
    link_names: list[str]
    masses: np.ndarray  # (links,)
    moments: dict[str, float]  # sum of the principal moments, by link

    def put(self, q: np.ndarray, v: np.ndarray) -> None:
        """Set the positions in rad and velocities in rad/s of the joints, ``(N,)`` each."""
        for joint, position, speed in zip(self.joints, q, v, strict=True):
            self.bullet.resetJointState(self.body, joint, float(position), float(speed))

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions in rad and velocities in rad/s of the joints, ``(N,)`` each."""
        states = self.bullet.getJointStates(self.body, self.joints)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])


def open_world(
    text: str, inertia: Inertia, gravity: tuple[float, ...], *, scratch: bool = False
) -> World:
    """The client of this process that holds the arm of a URDF's text, opened on the first call.

    There is a second one, ``scratch``, for forward kinematics: it may be put into any state
    without disturbing a motion in the first.
    """
    # The process is part of the key, as a forked one must not use the clients of its parent.
    return _open_world(os.getpid(), scratch, text, inertia, gravity)


@functools.cache
def _open_world(
    pid: int, scratch: bool, text: str, inertia: Inertia, gravity: tuple[float, ...]
) -> World:
    bullet = connect()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.urdf"
        path.write_text(text, encoding="utf-8")
        flags = bullet.URDF_USE_INERTIA_FROM_FILE if inertia == "file" else 0
        body = bullet.loadURDF(str(path), useFixedBase=True, flags=flags)
    bullet.setGravity(*gravity)
    links = list(range(bullet.getNumJoints(body)))
    infos = [bullet.getJointInfo(body, link) for link in links]
    joints = [
        link for link, info in zip(links, infos, strict=True) if info[2] != bullet.JOINT_FIXED
    ]
    for link in links:
        bullet.changeDynamics(body, link, linearDamping=0, angularDamping=0, jointDamping=0)
    link_names = [info[12].decode() for info in infos]
    if POINT_MASS in link_names:
        # To a link without shape Bullet gives the inertia of a box of its collision margin.
        point = link_names.index(POINT_MASS)
        bullet.changeDynamics(body, point, localInertiaDiagonal=[0, 0, 0])
    # Bullet holds every joint by a velocity motor, as strong as its friction, unless told not to.
    idle = [0.0] * len(joints)
    bullet.setJointMotorControlArray(body, joints, bullet.VELOCITY_CONTROL, forces=idle)
    dynamics = [bullet.getDynamicsInfo(body, link) for link in links]
    return World(
        bullet,
        body,
        joints,
        names=[infos[joint][1].decode() for joint in joints],
        links=links,
        link_names=link_names,
        masses=np.array([values[0] for values in dynamics]),
        moments={name: sum(values[2]) for name, values in zip(link_names, dynamics, strict=True)},
    )


def connect() -> Any:
    """PyBullet with its functions bound to a new client, without a display."""
    # Not the wheel's own BulletClient: when Python ends, it closes what is closed, and says so.
    bullet = import_bullet()
    client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
    bound = {
        name: functools.partial(item, **client) if inspect.isbuiltin(item) else item
        for name, item in vars(bullet).items()
    }
    return SimpleNamespace(**bound)


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
