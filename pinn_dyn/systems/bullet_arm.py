"""A torque-controlled arm in PyBullet, from any URDF with a fixed base and revolute joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import spd_solve
from pinn_dyn.systems.bullet_world import World, import_bullet, open_world
from pinn_dyn.systems.urdf import Inertia, find_urdf, read_urdf


class BulletArm(MechanicalSystem):
    """An arm of N revolute joints with motors and viscous friction, simulated by Bullet::

        M(q) dv/dt + C(q, v) v + G(q) + damping v = u

    q ``(*batch, N)`` rad, in Bullet's order of the joints; v rad/s; u motor torques ``(*batch, N)``
    Nm, so A = I. M comes from Bullet's ``calculateMassMatrix``, G and C(q, v) v from its recursive
    Newton-Euler ``calculateInverseDynamics``, V from the link centres of mass, the base link's
    own left out. Batches are looped over.

    What Bullet would add is switched off: joint motors, linear, angular and joint damping,
    friction, walls at joint limits and contacts. Locked joints stay at zero and their links keep
    their mass.

    M and V have first derivatives for automatic differentiation, the dynamics have none. The
    physics client is opened in each process that asks, and shared by copies of the arm.

    Source: Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 5-7, as implemented by Bullet.

    Args:
        urdf: path of the URDF, or of one that ships with PyBullet (``franka_panda/panda.urdf``).
        locked_joints: names of joints that are held at zero.
        inertia: ``"file"`` for the URDF's inertias, ``"collision"`` for those that Bullet
            computes from mass and collision shapes.
        damping: viscous friction of the joints, Nms/rad, one number or N.
        gravity: gravitational acceleration in the frame of the base, m/s^2, 3 numbers.

    Attributes:
        joint_names: names of the joints, N.
        q_low, q_high: joint limits, ``(N,)``, rad; -pi and pi for a continuous joint.
        v_max: velocity limits, ``(N,)``, rad/s; 0 where the URDF has none.
        u_max: torque limits, ``(N,)``, Nm; 0 where the URDF has none.

    Raises:
        ImportError: without PyBullet.
        FileNotFoundError: if there is no such URDF or mesh.
        ValueError: on a URDF that is no arm (see :func:`read_urdf`), a damping that is negative
            or of another length, or masses that make no positive definite M.
    """

    _damping: Tensor

    def __init__(
        self,
        urdf: str,
        *,
        locked_joints: Sequence[str] = (),
        inertia: Inertia = "file",
        damping: float | Sequence[float] = 0.5,
        gravity: Sequence[float] = (0.0, 0.0, -9.81),
    ):
        if inertia not in ("file", "collision"):
            raise ValueError(f"inertia is {inertia!r}, expected 'file' or 'collision'")
        if len(gravity) != 3 or not np.isfinite(gravity).all():
            raise ValueError(f"gravity is {list(gravity)}, expected 3 finite numbers in m/s^2")
        import_bullet()
        import pybullet_data

        source = find_urdf(urdf, Path(pybullet_data.getDataPath()))
        description = read_urdf(source, locked_joints, inertia)
        size = len(description.limits)
        super().__init__(num_coordinates=size, num_inputs=size)
        self.urdf = description
        self.inertia: Inertia = inertia
        self.gravity = tuple(float(g) for g in gravity)
        self.joint_names = self._world.names
        if inertia == "file":
            for link, found in self._world.moments.items():
                if abs(found - (moment := description.moments[link])) > 1e-6 * abs(moment):
                    raise ValueError(
                        f"{source}: Bullet refuses the inertia of link {link!r}: expected positive "
                        "principal moments, none larger than the sum of the other two"
                    )
        limits = np.array([description.limits[name] for name in self.joint_names])
        self.q_low, self.q_high, self.v_max, self.u_max = limits.T.copy()
        self.register_buffer("_damping", _joint_values(damping, self.joint_names, source))
        middle = 0.5 * (self.q_low + self.q_high)
        smallest = np.linalg.eigvalsh(self._mass(middle))[0]
        if not smallest > 0:
            raise ValueError(
                f"{source}: the mass matrix has the eigenvalue {smallest:g} in the middle of the "
                "joint ranges, expected positive ones: give the moving links mass and inertia"
            )

    def describe(self) -> dict[str, object]:
        """Everything the motion depends on, JSON-serializable; part of the key of a cache."""
        from importlib.metadata import version

        return {
            "urdf": self.urdf.digest,
            "joints": self.joint_names,
            "inertia": self.inertia,
            "damping": self._damping.tolist(),
            "gravity": self.gravity,
            "pybullet": version("pybullet"),
        }

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M(q), ``(*batch, N, N)``, kg m^2."""
        self._check(q=q)
        return _Known.apply(self._masses, self._mass_slopes, q)

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q) = -sum_i m_i g . r_i(q) with centres of mass r_i, ``(*batch,)``, J."""
        self._check(q=q)
        return _Known.apply(
            lambda q: _each(self._energy, q), lambda q: _each(self._bias, q, 0 * q), q
        )

    def damping_matrix(self, q: Tensor) -> Tensor:
        """D = diag(damping), ``(*batch, N, N)``, Nms/rad."""
        return torch.diag(self._damping.to(q)).expand(*q.shape, -1)

    def input_matrix(self, q: Tensor) -> Tensor:
        """A = I: each joint has its motor, ``(*batch, N, N)``."""
        return torch.eye(self.num_inputs, dtype=q.dtype, device=q.device).expand(*q.shape, -1)

    def dynamics(self, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """M ``(N, N)`` and C v + G + D v ``(N,)`` at one state, for a control law in NumPy."""
        return self._mass(q), self._bias(q, v) + self._friction * v

    def simulate(
        self,
        q0: np.ndarray,
        v0: np.ndarray,
        torque: Callable[[int, np.ndarray, np.ndarray], np.ndarray],
        *,
        steps: int,
        step: float,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Let Bullet move the arm, its torques held over each step (semi-implicit Euler)::

            v_k+1 = v_k + step M^-1 (u_k - D v_k - C v_k - G),   q_k+1 = q_k + step v_k+1

        Args:
            q0, v0: initial state, ``(N,)``.
            torque: motor torque u_k = torque(k, q_k, v_k), ``(N,)``, Nm.
            steps: number of steps.
            step: time step, s.

        Returns:
            q, v and u, ``(steps + 1, N)`` each.
        """
        world = self._world
        bullet, target = world.bullet, {"physicsClientId": world.client}
        bullet.setTimeStep(step, **target)
        for joint, position, speed in zip(world.joints, q0, v0, strict=True):
            bullet.resetJointState(world.body, joint, float(position), float(speed), **target)
        q, v, u = (np.empty((steps + 1, self.num_coordinates)) for _ in range(3))
        for k in range(steps + 1):
            states = bullet.getJointStates(world.body, world.joints, **target)
            q[k], v[k] = [state[0] for state in states], [state[1] for state in states]
            u[k] = torque(k, q[k], v[k])
            if k < steps:
                bullet.setJointMotorControlArray(
                    world.body,
                    world.joints,
                    bullet.TORQUE_CONTROL,
                    forces=(u[k] - self._friction * v[k]).tolist(),
                    **target,
                )
                bullet.stepSimulation(**target)
        return q, v, u

    def _potential_force(self, q: Tensor) -> Tensor:
        return _each(self._bias, q, torch.zeros_like(q))

    def _inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        return _each(self._inverse_dynamics, q, v, a) - self._potential_force(q)

    def _acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        return spd_solve(self._masses(q), force - _each(self._bias, q, v))

    def _kinetic_gradient(self, q: Tensor, v: Tensor) -> Tensor:
        return 0.5 * torch.einsum("...ijk,...i,...j->...k", self._mass_slopes(q), v, v)

    def _masses(self, q: Tensor) -> Tensor:
        return _each(self._mass, q)

    def _mass_slopes(self, q: Tensor) -> Tensor:
        """dM_ij/dq_k, ``(*batch, N, N, N)``, exact to rounding."""
        return _each(self._mass_slope, q)

    # Bullet at one configuration, NumPy in and out.

    def _mass(self, q: np.ndarray) -> np.ndarray:
        world = self._world
        return np.array(
            world.bullet.calculateMassMatrix(world.body, q.tolist(), physicsClientId=world.client)
        )

    def _inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """M a + C v + G."""
        world = self._world
        return np.array(
            world.bullet.calculateInverseDynamics(
                world.body, q.tolist(), v.tolist(), a.tolist(), physicsClientId=world.client
            )
        )

    def _bias(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        """C v + G."""
        return self._inverse_dynamics(q, v, np.zeros_like(v))

    def _mass_slope(self, q: np.ndarray) -> np.ndarray:
        """From the Christoffel symbols, which C v gives at v = e_j + e_k, as it is quadratic in v.

        [i, jk] = (c_i(e_j + e_k) - c_i(e_j) - c_i(e_k)) / 2 and dM_ij/dq_k = [i, jk] + [j, ik].
        """
        unit = np.eye(len(q))
        rest = self._bias(q, 0 * q)
        single = np.array([self._bias(q, e) - rest for e in unit])
        symbols = np.empty((len(q),) * 3)
        for j in range(len(q)):
            symbols[:, j, j] = single[j]
            for k in range(j):
                pair = self._bias(q, unit[j] + unit[k]) - rest - single[j] - single[k]
                symbols[:, j, k] = symbols[:, k, j] = 0.5 * pair
        return symbols + symbols.swapaxes(0, 1)

    def _energy(self, q: np.ndarray) -> np.ndarray:
        world, target = self._world, {"physicsClientId": self._world.client}
        for joint, position in zip(world.joints, q, strict=True):
            world.bullet.resetJointState(world.body, joint, float(position), **target)
        states = world.bullet.getLinkStates(
            world.body, world.links, computeForwardKinematics=True, **target
        )
        centres = np.array([state[0] for state in states])
        return -world.masses @ (centres @ np.array(self.gravity))

    @property
    def _friction(self) -> np.ndarray:
        return self._damping.double().cpu().numpy()

    @property
    def _world(self) -> World:
        return open_world(self.urdf.text, self.inertia, self.gravity)


def _joint_values(damping: float | Sequence[float], names: list[str], path: Path) -> Tensor:
    values = np.asarray(damping, dtype=float)
    if values.shape not in ((), (len(names),)):
        raise ValueError(
            f"damping has {values.size} entries, but {path} has {len(names)} free joints "
            f"({', '.join(names)}): give one number, or one for each joint"
        )
    if not (np.isfinite(values).all() and (values >= 0).all()):
        raise ValueError(f"damping is {damping}, expected finite numbers of at least 0 in Nms/rad")
    return torch.tensor(np.broadcast_to(values, len(names)).copy())


_Batched = Callable[[Tensor], Tensor]


def _each(function: Callable[..., np.ndarray], *values: Tensor) -> Tensor:
    """Apply a function of vectors ``(N,)`` to every row of tensors ``(*batch, N)``."""
    if torch.is_grad_enabled() and any(value.requires_grad for value in values):
        raise RuntimeError(
            "BulletArm: the dynamics have no derivatives, only mass_matrix and potential_energy "
            "have: detach the arguments, or use torch.no_grad()"
        )
    batch, size = values[0].shape[:-1], values[0].shape[-1]
    rows = [value.detach().double().cpu().reshape(-1, size).numpy() for value in values]
    results = np.array([function(*row) for row in zip(*rows, strict=True)])
    return torch.from_numpy(results.reshape((*batch, *results.shape[1:]))).to(values[0])


class _Known(torch.autograd.Function):
    """A function of q whose first derivative is known: y ``(*batch, ...)``, dy/dq one axis more."""

    @staticmethod
    def forward(value: _Batched, slope: _Batched, q: Tensor) -> Tensor:
        return value(q)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, ctx.slope, q = inputs
        ctx.save_for_backward(q)
        ctx.save_for_forward(q)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, None, Tensor]:
        (q,) = ctx.saved_tensors
        slope = _Known.apply(ctx.slope, _no_slope, q)
        batch, size = q.shape[:-1], q.shape[-1]
        flat = slope.reshape(*batch, -1, size)
        return None, None, (gradients[0].reshape(*batch, 1, -1) @ flat).squeeze(-2)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        (q,) = ctx.saved_tensors
        slope = _Known.apply(ctx.slope, _no_slope, q)
        ones = (1,) * (slope.ndim - q.ndim)
        return (slope * tangents[2].reshape(*q.shape[:-1], *ones, -1)).sum(-1)


def _no_slope(q: Tensor) -> Tensor:
    raise RuntimeError("BulletArm: M and V have first derivatives only")
