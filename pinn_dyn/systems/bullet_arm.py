"""A torque-controlled arm in PyBullet, from any URDF with a fixed base."""

from __future__ import annotations

import functools
import os
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from pinn_dyn.systems.simulated_arm import SimulatedArm


class BulletArm(SimulatedArm):
    """An arm of N joints with motors and viscous friction, moved by PyBullet::

        M(q) dv/dt + C(q, v) v + G(q) + damping v = u

    q ``(*batch, N)`` rad, v rad/s, u motor torques ``(*batch, N)`` Nm. Arguments, attributes and
    errors: :class:`~pinn_dyn.systems.simulated_arm.SimulatedArm`.

    Arms of the same URDF and gravity share a state: set the state of each before its steps.

    Raises:
        ImportError: without PyBullet.
    """

    def import_simulator(self) -> None:
        _import_bullet()

    def set_state(self, q: np.ndarray, v: np.ndarray) -> None:
        self._world.put(q, v)

    def step(self, torque: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Move the arm by one step of semi-implicit Euler::

        v_k+1 = v_k + step M^-1 (u_k - D v_k - C v_k - G),   q_k+1 = q_k + step v_k+1
        """
        world = self._world
        return world.step(torque - self.friction * world.velocity, step)

    def describe(self) -> dict[str, object]:
        return {**super().describe(), "pybullet": version("pybullet")}

    @property
    def _world(self) -> _World:
        # The process is part of the key: a forked process must not use its parent's client.
        return _open_world(os.getpid(), self.text, self.gravity)


class _World:
    """A PyBullet client that holds one arm, where only gravity and given torques act."""

    def __init__(self, text: str, gravity: tuple[float, ...]):
        bullet = self._bullet = _import_bullet()
        # Not the wheel's own BulletClient: it closes closed clients when Python ends, and prints.
        client = self._client = {"physicsClientId": bullet.connect(bullet.DIRECT)}
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(text, encoding="utf-8")
            flags = bullet.URDF_USE_INERTIA_FROM_FILE
            body = self._body = bullet.loadURDF(str(path), useFixedBase=True, flags=flags, **client)
        bullet.setGravity(*gravity, **client)
        # Joints and links have the same indices; the URDF names the links by their joints' order.
        indices = range(bullet.getNumJoints(body, **client))
        names = [bullet.getJointInfo(body, k, **client)[12].decode() for k in indices]
        self._joints = [names.index(f"body{k}") for k in indices]
        for joint in self._joints:
            bullet.changeDynamics(
                body, joint, linearDamping=0, angularDamping=0, jointDamping=0, **client
            )
        # PyBullet holds every joint by a velocity motor unless the motor has no force.
        bullet.setJointMotorControlArray(
            body, self._joints, bullet.VELOCITY_CONTROL, forces=[0.0] * len(names), **client
        )
        self.velocity = np.zeros(len(names))

    def put(self, q: np.ndarray, v: np.ndarray) -> None:
        """Set the positions and velocities of the joints, ``(N,)`` each."""
        self._bullet.resetJointStatesMultiDof(
            self._body, self._joints, q[:, None].tolist(), v[:, None].tolist(), **self._client
        )
        self.velocity = np.array(v, dtype=float)

    def step(self, force: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Apply the forces ``(N,)`` over one step; return positions and velocities after it."""
        bullet, client = self._bullet, self._client
        bullet.setTimeStep(step, **client)
        bullet.setJointMotorControlArray(
            self._body, self._joints, bullet.TORQUE_CONTROL, forces=force.tolist(), **client
        )
        bullet.stepSimulation(**client)
        states = bullet.getJointStates(self._body, self._joints, **client)
        self.velocity = np.array([state[1] for state in states])
        return np.array([state[0] for state in states]), self.velocity


def _import_bullet() -> Any:
    try:
        import pybullet
    except ImportError as error:
        raise ImportError(
            "BulletArm needs PyBullet: pip install 'pinn_dyn[panda]' (Python 3.10 or 3.11)"
        ) from error
    return pybullet


@functools.cache
def _open_world(pid: int, text: str, gravity: tuple[float, ...]) -> _World:
    return _World(text, gravity)
