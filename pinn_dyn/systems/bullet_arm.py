"""A torque-controlled arm in PyBullet, from any URDF with a fixed base."""

from __future__ import annotations

import functools
import os
import tempfile
from pathlib import Path

import numpy as np

from pinn_dyn.systems.bullet_camera import photograph
from pinn_dyn.systems.bullet_client import connect, import_bullet
from pinn_dyn.systems.simulated_arm import SimulatedArm


class BulletArm(SimulatedArm):
    """An arm of N joints with motors and viscous friction, moved by PyBullet::

        M(q) dv/dt + C(q, v) v + G(q) + damping v = u

    q ``(*batch, N)`` rad, v rad/s, u motor torques ``(*batch, N)`` Nm. The terms are those of the
    :class:`~pinn_dyn.systems.RigidChain`. Joint motors, joint limits, contacts and the damping
    that PyBullet adds by default are switched off. Arguments, attributes and errors:
    :class:`~pinn_dyn.systems.simulated_arm.SimulatedArm`.

    A PyBullet client is opened in each process on first use. Arms of the same URDF and gravity
    share its state: to move several in turn, set the state of each before its steps.

    Raises:
        ImportError: without PyBullet.
    """

    def import_simulator(self) -> None:
        import_bullet()

    def set_state(self, q: np.ndarray, v: np.ndarray) -> None:
        self._world.put(q, v)

    def step(self, torque: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Move the arm by one step of semi-implicit Euler::

        v_k+1 = v_k + step M^-1 (u_k - D v_k - C v_k - G),   q_k+1 = q_k + step v_k+1
        """
        world = self._world
        return world.step(torque - self.friction * world.velocity, step)

    def dynamics(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return M ``(N, N)`` and C v + G + D v ``(N,)`` at one state, by PyBullet.

        The chain gives the same numbers in ten times the time, 0.2 ms for seven joints, which
        counts in a law that runs at 1 kHz while data are recorded.
        """
        mass, bias = self._world.dynamics(q, v)
        return mass, bias + self.friction * v

    def describe(self) -> dict[str, object]:
        from importlib.metadata import version

        return {**super().describe(), "pybullet": version("pybullet")}

    def render(
        self, q: np.ndarray, points: np.ndarray, size: tuple[int, int]
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Return pictures of the arm, locked joints at zero; see :class:`Rendered`."""
        return photograph(self.path, self.joint_names, q, points, size)

    @property
    def _world(self) -> _World:
        # The process is part of the key: a forked process must not use its parent's client.
        return _open_world(os.getpid(), self.text, self.gravity)


class _World:
    """A PyBullet client that holds one arm, where only gravity and given torques act."""

    def __init__(self, text: str, gravity: tuple[float, ...]):
        bullet = self._bullet = connect()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "arm.urdf"
            path.write_text(text, encoding="utf-8")
            flags = bullet.URDF_USE_INERTIA_FROM_FILE
            self._body = bullet.loadURDF(str(path), useFixedBase=True, flags=flags)
        bullet.setGravity(*gravity)
        # Joints and links have the same indices; the URDF names the links by their joints' order.
        indices = range(bullet.getNumJoints(self._body))
        names = [bullet.getJointInfo(self._body, k)[12].decode() for k in indices]
        self._joints = [names.index(f"body{k}") for k in indices]
        for joint in self._joints:
            bullet.changeDynamics(
                self._body, joint, linearDamping=0, angularDamping=0, jointDamping=0
            )
        # PyBullet holds every joint by a velocity motor unless the motor has no force.
        idle = [0.0] * len(self._joints)
        bullet.setJointMotorControlArray(
            self._body, self._joints, bullet.VELOCITY_CONTROL, forces=idle
        )
        self.velocity = np.zeros(len(self._joints))

    def put(self, q: np.ndarray, v: np.ndarray) -> None:
        """Set the positions and velocities of the joints, ``(N,)`` each."""
        for joint, position, speed in zip(self._joints, q.tolist(), v.tolist(), strict=True):
            self._bullet.resetJointState(self._body, joint, position, speed)
        self.velocity = np.array(v, dtype=float)

    def step(self, force: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Apply the forces ``(N,)`` over one step; return positions and velocities after it."""
        bullet = self._bullet
        bullet.setTimeStep(step)
        bullet.setJointMotorControlArray(
            self._body, self._joints, bullet.TORQUE_CONTROL, forces=force.tolist()
        )
        bullet.stepSimulation()
        states = bullet.getJointStates(self._body, self._joints)
        self.velocity = np.array([state[1] for state in states])
        return np.array([state[0] for state in states]), self.velocity

    def dynamics(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return M ``(N, N)`` and C v + G ``(N,)``."""
        order = np.argsort(self._joints)
        q_list, v_list = q[order].tolist(), v[order].tolist()
        mass = np.array(self._bullet.calculateMassMatrix(self._body, q_list))
        zero = [0.0] * len(q_list)
        bias = self._bullet.calculateInverseDynamics(self._body, q_list, v_list, zero)
        return mass[np.ix_(self._joints, self._joints)], np.array(bias)[self._joints]


@functools.cache
def _open_world(pid: int, text: str, gravity: tuple[float, ...]) -> _World:
    return _World(text, gravity)
