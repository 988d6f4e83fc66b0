"""An arm moved by a physics simulator, with the equation of motion of a rigid chain."""

from __future__ import annotations

import functools
import hashlib
import importlib
import math
import os
from collections.abc import Sequence
from importlib.metadata import version
from typing import Annotated, ClassVar, Protocol
from xml.sax.saxutils import quoteattr

import numpy as np
import scipy
import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat

from pinn_dyn.systems.mjcf import exact_text
from pinn_dyn.systems.rigid_chain import RigidChain


class World(Protocol):
    """A simulation of one arm, on which only gravity and the applied forces act.

    The simulation has no joint motors, damping, friction, joint limits or contacts.

    Args:
        text: the URDF of the arm.
        gravity: gravitational acceleration, m/s^2.

    Attributes:
        velocity: velocities of the joints, ``(N,)``.
    """

    velocity: np.ndarray

    def __init__(self, text: str, gravity: tuple[float, ...]): ...

    def put(self, q: np.ndarray, v: np.ndarray) -> None:
        """Set the positions and velocities of the joints, ``(N,)`` each."""

    def step(self, force: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Apply the forces ``(N,)`` over one step; return positions and velocities after it."""


class SimulatedArm(RigidChain):
    """An arm with joint limits, motors and viscous friction that a simulator moves in time steps::

        M(q) dv/dt + C(q, v) v + G(q) + damping v = u

    q ``(*batch, N)`` rad or m, v rad/s or m/s, u torques or forces ``(*batch, N)``, Nm or N.

    A subclass defines the ``simulator`` (a Python package), the command to ``install`` it, and the
    class of its :class:`World`. Arms with the same URDF and gravity share a world. Call
    :meth:`set_state` before the steps of each arm.

    Args:
        urdf, locked_joints, gravity, tip, mass_scale, payload: arguments of :class:`RigidChain`.
        damping: viscous friction of the joints, Nms/rad or Ns/m, one number or N.
        v_max, u_max: limits of speed (rad/s or m/s) and torque or force, one number or N; None for
            the limits of the file. An MJCF has no limits of speed.

    Attributes:
        text: the URDF that the simulator loads.
        gravity: gravitational acceleration, m/s^2, 3 numbers.
        q_low, q_high: joint limits, ``(N,)``, rad or m; -pi and pi for a continuous joint.
        v_max: speed limits, ``(N,)``, rad/s or m/s; 0 where the file has none.
        u_max: torque or force limits, ``(N,)``, Nm or N; 0 where the file has none.
        angles: indices of the joints that turn.

    Raises:
        ImportError: if the simulator is not installed.
        ValueError: as :class:`RigidChain`, or if a joint has no limits or a body has no mass.
    """

    simulator: ClassVar[str]
    install: ClassVar[str]
    world: ClassVar[type[World]]

    def __init__(
        self,
        urdf: str,
        *,
        locked_joints: Sequence[str] = (),
        damping: NonNegativeFloat | Sequence[NonNegativeFloat] = 0.5,
        gravity: Annotated[Sequence[float], Field(min_length=3, max_length=3)] = (0.0, 0.0, -9.81),
        tip: str | None = None,
        mass_scale: PositiveFloat = 1.0,
        payload: NonNegativeFloat = 0.0,
        v_max: NonNegativeFloat | Sequence[NonNegativeFloat] | None = None,
        u_max: NonNegativeFloat | Sequence[NonNegativeFloat] | None = None,
    ):
        try:
            importlib.import_module(self.simulator)
        except ImportError as error:
            text = f"{type(self).__name__} needs {self.simulator}: {self.install}"
            raise ImportError(text) from error
        super().__init__(
            urdf,
            locked_joints=locked_joints,
            damping=damping,
            gravity=gravity,
            tip=tip,
            mass_scale=mass_scale,
            payload=payload,
        )
        if self._coupled:
            mimics = [name for name in self.tree.movable if name not in self.joint_names]
            text = f"the simulation has no mimic joints: add {mimics} to locked_joints"
            raise ValueError(f"{self.tree.path}: {text}")
        self.check_domain(np.zeros(0), np.zeros(0))
        self.limits = self.limits.copy()
        for column, values in ((2, v_max), (3, u_max)):
            if values is not None:
                self.limits[:, column] = values
        self.q_low, self.q_high, self.v_max, self.u_max = self.limits.T
        for joint, low, high in zip(self.joint_names, self.q_low, self.q_high, strict=True):
            if not low < high:
                raise ValueError(
                    f"joint {joint!r} has the limits {low} to {high}, expected lower < upper: set "
                    "them in the URDF, lock the joint, or make it continuous"
                )
        for body, mass in zip(self.body_names, self.inertia[:, 3, 3].tolist(), strict=True):
            if not mass > 0:
                raise ValueError(
                    f"link {body!r} moves with a mass of {mass} kg, expected a positive mass"
                )
        self.gravity = tuple(float(g) for g in gravity)
        self.text = self.to_urdf()
        self.angles = tuple(k for k, turns in enumerate(self.turning) if turns)

    def set_state(self, q: np.ndarray, v: np.ndarray) -> None:
        """Set the state q, v, ``(N,)`` each, at which the next :meth:`step` starts."""
        self._world.put(q, v)

    def step(self, torque: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """Return q and v, ``(N,)`` each, after ``step`` s under the torque u ``(N,)``, Nm::

        v_k+1 = v_k + step M^-1 (u_k - D v_k - C v_k - G),   q_k+1 = q_k + step v_k+1
        """
        world = self._world
        return world.step(torque - self.friction * world.velocity, step)

    @property
    def _world(self) -> World:
        # The cache key includes the process, since a fork must not use the client of its parent.
        return _open_world(os.getpid(), type(self).world, self.text, self.gravity)

    def motor_torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """Return M a + C v + G + D v, ``(*batch, N)``, Nm."""
        with torch.inference_mode():
            force = self.rigid_force(torch.from_numpy(q), torch.from_numpy(v), torch.from_numpy(a))
        return force.numpy() + self.friction * v

    @property
    def friction(self) -> np.ndarray:
        """Viscous friction of the joints, ``(N,)``, Nms/rad or Ns/m."""
        return self._damping.double().cpu().numpy()

    def describe(self) -> dict[str, object]:
        """Return all values that determine the motion, JSON-serializable."""
        return {
            "urdf": hashlib.sha256(self.text.encode()).hexdigest(),
            "limits": self.limits.tolist(),
            "damping": self.friction.tolist(),
            "gravity": self.gravity,
            self.simulator: version(self.simulator),
        }

    def to_urdf(self) -> str:
        """Return a URDF with one link per body and without shapes, limits and friction.

        Inertias are written in their principal axes, since PyBullet diagonalizes only to 6 digits.
        """
        poses = self.kinematics(torch.zeros(self.num_coordinates, dtype=torch.float64)).poses
        weightless = '<mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'
        parts = [f'<link name="base"><inertial>{weightless}</inertial></link>']
        for k, (name, parent) in enumerate(zip(self.joint_names, self.parents, strict=True)):
            rotation, position = poses[k, :3, :3].numpy(), poses[k, :3, 3].numpy()
            origin = position - (poses[parent, :3, 3].numpy() if parent >= 0 else 0.0)
            axis = rotation @ self._axes[k].numpy()
            kind = "continuous" if self.turning[k] else "prismatic"
            parts.append(
                f'<joint name={quoteattr(name)} type="{kind}"><parent link="{_link(parent)}"/>'
                f'<child link="{_link(k)}"/><origin xyz="{exact_text(origin)}"/>'
                f'<axis xyz="{exact_text(axis)}"/>'
                # PyBullet needs limits of a sliding joint; lower > upper means no limits.
                '<limit lower="1" upper="-1" effort="0" velocity="0"/></joint>'
            )
            mass, centre, moments, turn = _principal_inertia(self.inertia[k].numpy(), rotation)
            ixx, iyy, izz = (repr(float(moment)) for moment in moments)
            parts.append(
                f'<link name="{_link(k)}"><inertial><mass value="{mass!r}"/>'
                f'<origin xyz="{exact_text(centre)}" rpy="{exact_text(turn.as_euler("xyz"))}"/>'
                f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/>'
                "</inertial></link>"
            )
        return f'<robot name="arm">{"".join(parts)}</robot>'


def _principal_inertia(
    pseudo: np.ndarray, rotation: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, scipy.spatial.transform.Rotation]:
    """Return mass, center, principal moments and principal axes of a body in a rotated frame."""
    mass = float(pseudo[3, 3])
    centre = pseudo[:3, 3] / mass
    second = pseudo[:3, :3] - mass * np.outer(centre, centre)
    inertia = np.trace(second) * np.eye(3) - second
    moments, axes = np.linalg.eigh(rotation @ inertia @ rotation.T)
    # Roll-pitch-yaw angles are inexact at a pitch of 90 degrees: keep the pitch below 36 degrees.
    first = int(np.abs(axes[2]).argmin())
    moments, axes = np.roll(moments, -first), np.roll(axes, -first, axis=1)
    axes[:, 2] *= math.copysign(1.0, np.linalg.det(axes))
    return (
        mass,
        rotation @ centre,
        np.maximum(moments, 0.0),
        scipy.spatial.transform.Rotation.from_matrix(axes),
    )


def _link(body: int) -> str:
    return "base" if body < 0 else f"body{body}"


@functools.cache
def _open_world(pid: int, world: type[World], text: str, gravity: tuple[float, ...]) -> World:
    return world(text, gravity)
