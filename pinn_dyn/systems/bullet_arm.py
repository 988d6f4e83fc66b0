"""A torque-controlled arm in PyBullet, from any URDF or MJCF with a fixed base."""

from __future__ import annotations

import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from pinn_dyn.systems.simulated_arm import SimulatedArm


class _World:
    """A PyBullet client with one arm, on which only gravity and the applied torques act."""

    def __init__(self, text: str, gravity: tuple[float, ...]):
        import pybullet as bullet

        self._bullet = bullet
        # Avoid BulletClient of the wheel, which closes closed clients at exit and prints a message.
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
        undamped = {"linearDamping": 0, "angularDamping": 0, "jointDamping": 0}
        inertias = ET.fromstring(text).findall("link[@name!='base']//inertia")
        for joint, inertia in zip(self._joints, inertias, strict=True):
            # Set the moments explicitly, since the URDF reader of PyBullet drops unphysical ones.
            moments = [float(inertia.get(key, 0.0)) for key in ("ixx", "iyy", "izz")]
            bullet.changeDynamics(body, joint, localInertiaDiagonal=moments, **undamped, **client)
        # Switch off the velocity motors by which PyBullet holds all joints.
        bullet.setJointMotorControlArray(
            body, self._joints, bullet.VELOCITY_CONTROL, forces=[0.0] * len(names), **client
        )
        self.velocity = np.zeros(len(names))

    def put(self, q: np.ndarray, v: np.ndarray) -> None:
        self._bullet.resetJointStatesMultiDof(
            self._body, self._joints, q[:, None].tolist(), v[:, None].tolist(), **self._client
        )
        self.velocity = np.array(v, dtype=float)

    def step(self, force: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        bullet, client = self._bullet, self._client
        bullet.setTimeStep(step, **client)
        bullet.setJointMotorControlArray(
            self._body, self._joints, bullet.TORQUE_CONTROL, forces=force.tolist(), **client
        )
        bullet.stepSimulation(**client)
        states = bullet.getJointStates(self._body, self._joints, **client)
        self.velocity = np.array([state[1] for state in states])
        return np.array([state[0] for state in states]), self.velocity


class BulletArm(SimulatedArm):
    """A :class:`~pinn_dyn.systems.simulated_arm.SimulatedArm` that PyBullet moves."""

    simulator = "pybullet"
    install = "pip install 'pinn_dyn[panda]' (Python 3.10, 3.11), or use pinn_dyn.systems.MujocoArm"
    world = _World
