"""A torque-controlled arm in PyBullet, from any URDF with a fixed base and revolute joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import spd_solve
from pinn_dyn.systems.bullet_camera import photograph
from pinn_dyn.systems.bullet_world import World, import_bullet, open_world
from pinn_dyn.systems.known_slope import KnownSlope
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
        tip: name of the link whose frame is the tip, any but the base; None for the last of the
            file's joints with no joint behind it (of the Panda: ``panda_grasptarget``).
        mass_scale: factor of the masses and inertias of all links.
        payload: point mass at the origin of the tip's frame, kg, which is not scaled; it adds
            m J^T J to M and -m J^T gravity to G, with J the tip's Jacobian.

    Attributes:
        joint_names: names of the joints, N.
        q_low, q_high: joint limits, ``(N,)``, rad; -pi and pi for a continuous joint.
        v_max: velocity limits, ``(N,)``, rad/s; 0 where the URDF has none.
        u_max: torque limits, ``(N,)``, Nm; 0 where the URDF has none.

    Raises:
        ImportError: without PyBullet.
        FileNotFoundError: if there is no such URDF or mesh.
        ValueError: on a URDF that is no arm (see :func:`read_urdf`), a damping that is negative
            or of another length, an unknown tip, a mass_scale or payload that is none, or masses
            that make no positive definite M.
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
        tip: str | None = None,
        mass_scale: float = 1.0,
        payload: float = 0.0,
    ):
        if inertia not in ("file", "collision"):
            raise ValueError(f"inertia is {inertia!r}, expected 'file' or 'collision'")
        if len(gravity) != 3 or not np.isfinite(gravity).all():
            raise ValueError(f"gravity is {list(gravity)}, expected 3 finite numbers in m/s^2")
        if not 0 < mass_scale < np.inf:
            raise ValueError(f"mass_scale is {mass_scale}, expected a positive finite number")
        if not 0 <= payload < np.inf:
            raise ValueError(f"payload is {payload}, expected a finite number of at least 0 in kg")
        bullet = import_bullet()
        import pybullet_data

        source = find_urdf(urdf, Path(pybullet_data.getDataPath()))
        description = read_urdf(
            source,
            locked_joints,
            inertia,
            tip=tip,
            mass_scale=float(mass_scale),
            payload=float(payload),
        )
        size = len(description.limits)
        super().__init__(num_coordinates=size, num_inputs=size)
        self.urdf = description
        self.inertia: Inertia = inertia
        self.gravity = tuple(float(g) for g in gravity)
        self.mass_scale, self.payload = float(mass_scale), float(payload)
        try:
            self.joint_names = self._world.names
        except bullet.error as error:
            raise ValueError(f"{source}: Bullet does not load this URDF: {error}") from error
        if inertia == "file":
            for link, found in self._world.moments.items():
                if abs(found - (moment := description.moments[link])) > 1e-6 * abs(moment):
                    raise ValueError(
                        f"{source}: Bullet refuses the inertia of link {link!r}: expected positive "
                        "principal moments, none larger than the sum of the other two"
                    )
        limits = np.array([description.limits[name] for name in self.joint_names])
        self.q_low, self.q_high, self.v_max, self.u_max = limits.T.copy()
        self.angles = tuple(range(size))
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

        # Only where they change the motion, so that data made before they existed stay valid.
        changes: dict[str, object] = {}
        if self.mass_scale != 1:
            changes["mass_scale"] = self.mass_scale
        if self.payload:
            changes |= {"payload": self.payload, "tip": self.urdf.tip}
        return {
            "urdf": self.urdf.digest,
            "joints": self.joint_names,
            "inertia": self.inertia,
            "damping": self._damping.tolist(),
            "gravity": self.gravity,
            "pybullet": version("pybullet"),
            **changes,
        }

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M(q), ``(*batch, N, N)``, kg m^2."""
        self._check(q=q)
        return KnownSlope.apply(self._masses, self._mass_slopes, q)

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q) = -sum_i m_i g . r_i(q) with centres of mass r_i, ``(*batch,)``, J."""
        self._check(q=q)
        return KnownSlope.apply(
            lambda q: _each(self._energy, q), lambda q: _each(self._bias, q, 0 * q), q
        )

    def damping_matrix(self, q: Tensor) -> Tensor:
        """D = diag(damping), ``(*batch, N, N)``, Nms/rad."""
        return torch.diag(self._damping.to(q)).expand(*q.shape, -1)

    def input_matrix(self, q: Tensor) -> Tensor:
        """A = I: each joint has its motor, ``(*batch, N, N)``."""
        return torch.eye(self.num_inputs, dtype=q.dtype, device=q.device).expand(*q.shape, -1)

    def tip_position(self, q: Tensor) -> Tensor:
        """Origin of the tip's frame in the frame of the base, ``(*batch, 3)``, m."""
        self._check(q=q)
        return KnownSlope.apply(
            lambda q: _each(self._tip_point, q), lambda q: self.tip_jacobian(q)[..., :3, :], q
        )

    def tip_jacobian(self, q: Tensor) -> Tensor:
        """J with (velocity of the tip's origin in m/s, angular velocity in rad/s) = J v.

        ``(*batch, 6, N)``, in the frame of the base; the linear rows come first.
        """
        self._check(q=q)
        return _each(self._tip_slope, q)

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
        self.set_state(q0, v0)
        self._world.bullet.setTimeStep(step)
        q, v, u = (np.empty((steps + 1, self.num_coordinates)) for _ in range(3))
        q[0], v[0] = q0, v0
        for k in range(steps + 1):
            u[k] = torque(k, q[k], v[k])
            if k < steps:
                q[k + 1], v[k + 1] = self._move(v[k], u[k])
        return q, v, u

    def set_state(self, q: np.ndarray, v: np.ndarray) -> None:
        """Put the arm in Bullet into a state, ``(N,)`` each, from which :meth:`step` moves it.

        Arms of the same URDF, inertia and gravity share one state in a process: to move several
        in turn, set the state of each before its steps.
        """
        self._world.put(q, v)

    def step(self, torque: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
        """One step of :meth:`simulate` from the present state: q and v after it, ``(N,)`` each.

        Args:
            torque: motor torque, ``(N,)``, Nm, held over the step.
            step: time step, s.
        """
        self._world.bullet.setTimeStep(step)
        return self._move(self._world.state()[1], torque)

    def render(
        self, q: np.ndarray, points: np.ndarray, size: tuple[int, int]
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """Pictures of the arm, locked joints at zero; see :class:`Rendered`."""
        return photograph(self.urdf.path, self.joint_names, q, points, size)

    def _move(self, v: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """One step from the present state, whose velocity is v."""
        world = self._world
        world.bullet.setJointMotorControlArray(
            world.body,
            world.joints,
            world.bullet.TORQUE_CONTROL,
            forces=(torque - self._friction * v).tolist(),
        )
        world.bullet.stepSimulation()
        return world.state()

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
        return np.array(world.bullet.calculateMassMatrix(world.body, q.tolist()))

    def _inverse_dynamics(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        """M a + C v + G."""
        world, at = self._world, (q.tolist(), v.tolist(), a.tolist())
        return np.array(world.bullet.calculateInverseDynamics(world.body, *at))

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
        world = self._scratch
        world.put(q, 0 * q)
        states = world.bullet.getLinkStates(world.body, world.links, computeForwardKinematics=True)
        centres = np.array([state[0] for state in states])
        return -world.masses @ (centres @ np.array(self.gravity))

    def _tip_point(self, q: np.ndarray) -> np.ndarray:
        world = self._scratch
        world.put(q, 0 * q)
        link = world.link_names.index(self.urdf.tip)
        # Of the link's own frame Bullet gives float32 only, of its centre of mass float64.
        centre, turn, offset, own_turn = world.bullet.getLinkState(
            world.body, link, computeForwardKinematics=True
        )[:4]
        frame = Rotation.from_quat(turn) * Rotation.from_quat(own_turn).inv()
        return np.array(centre) - frame.apply(offset)

    def _tip_slope(self, q: np.ndarray) -> np.ndarray:
        world, zero = self._world, [0.0] * len(q)
        # Bullet counts the point (0, 0, 0) from the link's frame, whatever its manual says.
        link = world.link_names.index(self.urdf.tip)
        linear, angular = world.bullet.calculateJacobian(
            world.body, link, [0.0, 0.0, 0.0], q.tolist(), zero, zero
        )
        return np.array([*linear, *angular])

    @property
    def _friction(self) -> np.ndarray:
        return self._damping.double().cpu().numpy()

    @property
    def _world(self) -> World:
        return open_world(self.urdf.text, self.inertia, self.gravity)

    @property
    def _scratch(self) -> World:
        return open_world(self.urdf.text, self.inertia, self.gravity, scratch=True)


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
