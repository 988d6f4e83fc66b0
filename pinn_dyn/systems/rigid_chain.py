"""A rigid robot with a fixed base, from a URDF or MJCF, in batched and differentiable torch."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat
from torch import Tensor

from pinn_dyn.mechanics import MechanicalSystem
from pinn_dyn.mechanics.arrays import matvec
from pinn_dyn.systems.inertia import inertial_parameters, joined, pseudo_inertia, rod
from pinn_dyn.systems.segment_frames import cross_matrix
from pinn_dyn.systems.urdf import read_urdf

_ROUNDED = 0.1  # largest negative variance of a mass that counts as rounding, per largest variance
_LARGEST = 10.0  # largest plausible radius of gyration of a body, m


class Kinematics(NamedTuple):
    """Poses T of the B bodies in the world, and twists xi of the B joints, ``(*batch, B, 4, 4)``.

    A joint that moves at unit speed gives the point x = (x, y, z, 1) the velocity xi x.
    """

    poses: Tensor
    twists: Tensor


class RigidChain(MechanicalSystem):
    """A chain or tree of B rigid bodies on revolute, continuous and prismatic joints::

        M(q) a + C(q, v) v + G(q) + D v = u

    Let T_k be the pose of body k, J_k its pseudo-inertia (:mod:`pinn_dyn.systems.inertia`) in the
    world frame, xi_j the twist of joint j as a 4 x 4 matrix, and <A, B> = sum_il A_il B_il. The
    relation j <= k means that joint j moves body k. With composite bodies Jc_j = sum over k >= j
    of J_k (composite-rigid-body algorithm)::

        M_jk  = <xi_j, xi_k Jc_k>                           for j <= k, symmetric
        Xi_k  = sum over j <= k of xi_j v_j                 velocity of body k
        Xi'_k = sum over j <= k of xi_j a_j + (Xi_j xi_j - xi_j Xi_j) v_j
        tau_j = <xi_j, sum over k >= j of (Xi'_k + Xi_k^2 - Gamma) J_k>

    where Gamma holds gravity in its last column: the recursive Newton-Euler algorithm. The forces
    are linear in J and in the ten inertial parameters of each body (:meth:`regressor`). A model
    that learns the bodies passes its own ``inertia`` to the methods.

    The N coordinates q move the joints by S q, with S ``(B, N)``. S is the identity, unless
    ``joints`` changes the order or joints mimic others. Then M is S^T M S with the M above, and tau
    is S^T tau.

    Sources: Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 5 and 6; Legnani et al. 1996, "A
    homogeneous matrix approach to 3D kinematics and dynamics".

    Args:
        urdf: path of a URDF or MJCF, one that ships with pinn_dyn (``franka_panda/panda.urdf``) or
            PyBullet, or the text of the file.
        joints: names of the joints that move, in the order of the coordinates; all other joints are
            held at zero. None for all joints that mimic no joint, in the order of the file.
        locked_joints: names of joints that are held at zero, or positions by name, rad or m.
        damping: viscous friction of the joints, Nms/rad or Ns/m, one number or N.
        gravity: gravitational acceleration in the frame of the base, m/s^2, 3 numbers.
        tip: link that carries the payload; None for the last link of the file without child joints.
        mass_scale: factor of all masses and inertias.
        payload: point mass at the origin of the tip frame, kg, not scaled by ``mass_scale``.

    Attributes:
        joint_names: N names of the coordinates.
        body_names: B names; a body is a link with all links fixed to it.
        body_joints: index of the coordinate that moves the joint of each body, B.
        turning: true for a coordinate that turns, false for one that slides, N.
        tree: contents of the file, see :class:`~pinn_dyn.systems.urdf.Tree`.
        limits: position, speed and effort of the coordinates, ``(N, 4)``.
        inertia: pseudo-inertias of the file, ``(B, 4, 4)``, in the frames of the joints.

    Raises:
        FileNotFoundError, ImportError, ValueError: as :func:`~pinn_dyn.systems.urdf.read_urdf`.
    """

    z_is_down = False

    def __init__(
        self,
        urdf: str,
        *,
        joints: Sequence[str] | None = None,
        locked_joints: Sequence[str] | Mapping[str, float] = (),
        damping: NonNegativeFloat | Sequence[NonNegativeFloat] = 0.0,
        gravity: Annotated[Sequence[float], Field(min_length=3, max_length=3)] = (0.0, 0.0, -9.81),
        tip: str | None = None,
        mass_scale: PositiveFloat = 1.0,
        payload: NonNegativeFloat = 0.0,
    ):
        tree = read_urdf(
            urdf,
            joints=joints,
            locked_joints=locked_joints,
            tip=tip,
            mass_scale=mass_scale,
            payload=payload,
        )
        bodies, size = tree.coupling.shape
        super().__init__(num_coordinates=size, num_inputs=size)
        # Keep the arguments, which a run stores as the description of the robot.
        self.urdf, self.joints, self.locked_joints = urdf, joints, locked_joints
        self.damping, self.gravity = damping, gravity
        self.tip, self.mass_scale, self.payload = tip, mass_scale, payload
        double = torch.float64
        self.tree, self.joint_names, self.body_names = tree, tree.joints, tree.bodies
        self.body_joints = tree.coupling.abs().argmax(1).tolist()
        self._coupled = not torch.equal(tree.coupling, torch.eye(size, dtype=double))
        self.turning = tree.turning
        self.parents = tuple(tree.parents)
        self.limits = tree.limits
        # Joint models (Featherstone 2008, sec. 4.4): the pose of a joint is F0 + s F1 + c F2, with
        # s = sin q and c = 1 - cos q for a turning joint (Rodrigues' formula), and s = q and c = 0
        # for a sliding joint.
        turning = tree.revolute
        axes = torch.where(turning[:, None], tree.axes, 0)
        screws = torch.cat([axes, tree.axes - axes], dim=-1)
        twists = (screws @ _screw_basis().flatten(1)).unflatten(-1, (4, 4))
        start = torch.eye(4, dtype=double).expand(bodies, 4, 4)
        placements = tree.placements @ torch.stack([start, twists, twists @ twists])
        # Connectivity: moved[j, k] = 1 if joint j moves body k (Featherstone 2008, sec. 4.1).
        moved = torch.eye(bodies, dtype=double)
        for k, parent in enumerate(tree.parents):
            if parent >= 0:
                moved[:, k] += moved[:, parent]
        buffers = {
            "inertia": tree.inertia,
            "_gravity": torch.tensor(list(gravity), dtype=double),
            "_damping": torch.as_tensor(damping, dtype=double).expand(size).clone(),
            "_placements": placements,
            "_axes": tree.axes,
            "_turning": turning.to(double)[:, None],
            "_moved": moved,
            "_coupling": tree.coupling,
            "_screws": _screw_basis(),
            "_basis": pseudo_inertia(torch.eye(10, dtype=double)),
            "_tip_pose": tree.tip_pose,
        }
        for name, value in buffers.items():
            constant = name in ("inertia", "_gravity", "_damping")
            self.register_buffer(name, value, persistent=constant)
        self._exact = {name: value.clone() for name, value in buffers.items()}
        self._tip_body = tree.tip_body

    def with_joints(self, joints: Sequence[str]) -> RigidChain:
        """Return the same robot with other coordinates; see ``joints``."""
        return self._with("joints", list(joints))

    def with_gravity(self, gravity: Sequence[float]) -> RigidChain:
        """Return the same robot with another gravitational acceleration, m/s^2, 3 numbers."""
        return self._with("gravity", list(gravity))

    def _with(self, name: str, value: Any) -> RigidChain:
        names = inspect.signature(type(self)).parameters
        arguments = {key: getattr(self, key) for key in names}
        return type(self)(**arguments | {name: value})

    def check_domain(self, q_low: np.ndarray, q_high: np.ndarray) -> None:
        """Check that the mass matrix of the file's bodies is positive definite at q = 0.

        Raises:
            ValueError: if M is singular or indefinite.
        """
        mass = self.mass_matrix(torch.zeros(self.num_coordinates, dtype=torch.float64))
        smallest = float(torch.linalg.eigvalsh(mass)[0])
        if not smallest > 0:
            reasons = "; ".join(["", *self.tree.problems])
            raise ValueError(
                f"{self.tree.path}: M has the eigenvalue {smallest:g} at q = 0, expected positive "
                f"ones: correct the masses and inertias{reasons}"
            )

    def _apply(self, fn: Callable[..., Tensor], recurse: bool = True) -> RigidChain:
        """Convert the buffers. Conversion back to double precision restores exact values."""
        super()._apply(fn, recurse)
        for name, value in self._exact.items():
            buffer = getattr(self, name)
            if buffer.dtype == value.dtype and torch.equal(buffer.cpu(), value.float().double()):
                setattr(self, name, value.to(buffer.device, copy=True))
        return self

    def kinematics(self, q: Tensor) -> Kinematics:
        """Return poses and twists at q ``(*batch, N)``."""
        # Joint models (Featherstone 2008, sec. 4.4).
        q = self._of_joints(q)
        turning = self._turning.squeeze(-1)
        first = turning * torch.sin(q) + (1 - turning) * q
        second = turning * (1 - torch.cos(q))
        start, along, across = self._placements
        local = start + first[..., None, None] * along + second[..., None, None] * across
        # Forward pass: poses of the bodies, from the base to the tips.
        poses: list[Tensor] = []
        for parent, step in zip(self.parents, local.unbind(-3), strict=True):
            poses.append(step if parent < 0 else poses[parent] @ step)
        stacked = torch.stack(poses, dim=-3)
        # Twists of the joints at unit speed, in the world frame.
        axis = matvec(stacked[..., :3, :3], self._axes)
        moment = torch.linalg.cross(stacked[..., :3, 3], axis)
        turn = self._turning
        screws = torch.cat([turn * axis, turn * moment + (1 - turn) * axis], dim=-1)
        return Kinematics(stacked, (screws @ self._screws.flatten(1)).unflatten(-1, (4, 4)))

    def mass_and_bias(
        self, q: Tensor, v: Tensor, inertia: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return M and C v + G. ``inertia`` ``(B, 4, 4)`` defaults to the bodies of the file."""
        at = self.kinematics(q)
        bodies = self._in_world(at, inertia)
        bias = self._force(at, self._accelerations(at, v, None, self._gravity), bodies)
        return self._mass(at, bodies), bias

    def rigid_force(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor | None = None, gravity: bool = True
    ) -> Tensor:
        """Return M a + C v + G, ``(*batch, N)``; without G if ``gravity`` is false."""
        at = self.kinematics(q)
        pull = self._gravity if gravity else torch.zeros_like(self._gravity)
        return self._force(at, self._accelerations(at, v, a, pull), self._in_world(at, inertia))

    def regressor(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return Y ``(*batch, N, 10 B)`` with M a + C v + G = Y pi.

        pi ``(10 B,)`` holds ten parameters of each body, body by body, in the order of Pinocchio:
        m in kg, m c in kg m, and Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the frame's origin in kg m^2.

        Source: Atkeson, An and Hollerbach 1986, "Estimation of inertial parameters of manipulator
        loads and links".
        """
        # Accelerations of the bodies, in the frames of their joints.
        at = self.kinematics(q)
        moving = self._accelerations(at, v, a, self._gravity) @ at.poses
        # Torque at joint j per entry of the pseudo-inertia of body k, zero unless j moves k.
        per_joint = at.twists.unsqueeze(-3) @ at.poses.unsqueeze(-4)  # (*batch, j, k, 4, 4)
        per_body = moving.unsqueeze(-4).mT @ per_joint * self._moved[..., None, None]
        # Torque per inertial parameter.
        rows = (per_body.flatten(-2) @ self._basis.flatten(1).T).flatten(-2)
        return self._coupling.mT @ rows if self._coupled else rows

    def force_slopes(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return dtau/dq and dtau/dv of tau = M a + C v + G at fixed a, ``(*batch, N, N)`` each.

        In the frame of the bodies that joint i moves, a change of q_i only turns the parent bodies
        and gravity. Let p be the parent body of joint i, m the joint of i and j that is farther
        from the base (the derivatives are zero if i and j lie on different branches), H_m = sum
        over k >= m of Xi_k J_k, F_m the force on the bodies k >= m, and [A, B] = A B - B A. Then::

            d_i = [Xi_p, xi_i],    E_i = [Xi'_p, xi_i] - [d_i, Xi_p] + xi_i Gamma
            dtau_j/dq_i = <xi_j, 2 d_i H_m + E_i Jc_m>  (+ <xi_j, xi_i F_i + F_i xi_i^T> if i > j)
            dtau_j/dv_i = 2 <xi_j, xi_i H_m + d_i Jc_m>

        Carpentier and Mansard 2018, "Analytical derivatives of rigid body dynamics algorithms",
        give the same derivatives by spatial vectors.
        """
        at = self.kinematics(q)
        twists, bodies = at.twists, self._in_world(at, inertia)
        v, a = self._of_joints(v), self._of_joints(a)
        # Velocities and accelerations of the bodies, and their changes with q_i.
        joint_velocity = twists * v[..., None, None]
        velocity = self._tree_sum(self._moved.mT, joint_velocity)
        before = velocity - joint_velocity
        turned = _bracket(before, twists)
        joint_change = turned * v[..., None, None] + twists * a[..., None, None]
        change = self._tree_sum(self._moved.mT, joint_change)
        gravity = torch.nn.functional.pad(self._gravity.unsqueeze(-1), (3, 0, 0, 1))
        shifted = _bracket(change - joint_change, twists) - _bracket(turned, before)
        shifted = shifted + twists @ gravity
        accelerations = change + velocity @ velocity - gravity
        # Sums over the bodies that each joint moves.
        momentum = self._tree_sum(self._moved, velocity @ bodies)
        force = self._tree_sum(self._moved, accelerations @ bodies)
        composite = self._tree_sum(self._moved, bodies)
        by_momentum, by_composite = twists @ momentum.mT, twists @ composite
        turning = 2 * turned @ momentum + shifted @ composite
        # Derivative of tau_j (row j) by joint i (column i): i > j (later), i <= j (former).
        to_later = _pairs(twists, turning + twists @ force + force @ twists.mT)
        to_former = 2 * _pairs(by_momentum, turned) + _pairs(by_composite, shifted)
        slowing = _pairs(twists, twists @ momentum + turned @ composite)
        driving = _pairs(by_momentum, twists) + _pairs(by_composite, turned)
        former, later = self._moved.mT, self._moved.triu(1)
        by_q = former * to_former + later * to_later
        by_v = 2 * (former * driving + later * slowing)
        return self._of_coordinates(by_q), self._of_coordinates(by_v)

    def parameters_of(self, inertia: Tensor | None = None) -> Tensor:
        """Return the ten inertial parameters of each body, ``(B, 10)``, see :meth:`regressor`."""
        return inertial_parameters(self.inertia if inertia is None else inertia)

    def _ends(self) -> list[Tensor | None]:
        """Return the position of the farthest child joint of each body, in its joint frame, m."""
        starts = self._placements[0, :, :3, 3].double()
        children: list[list[Tensor]] = [[] for _ in self.parents]
        for start, parent in zip(starts, self.parents, strict=True):
            if parent >= 0:
                children[parent].append(start)
        return [max(points, key=torch.linalg.norm, default=None) for points in children]

    def _usual_length(self) -> float:
        """Return the mean distance between joints, m; 0.1 m for a single joint."""
        norms = [float(end.norm()) for end in self._ends() if end is not None]
        lengths = [length for length in norms if length > 0.02]
        return sum(lengths) / len(lengths) if lengths else 0.1

    def generic_inertia(self, density: float = 1000.0) -> Tensor:
        """Return pseudo-inertias ``(B, 4, 4)`` of rods, one per body, from the kinematics alone.

        A rod ends at the farthest child joint. If this joint is nearer than half the mean distance
        between joints, the rod has the mean distance as its length and lies along the joint axis.
        Its radius is a sixth of the mean distance. The last rod after a turning joint is inclined
        by 45 degrees to the axis and hangs down at q = 0. A rod on the axis would have no torque
        by gravity and inertia.
        """
        usual = self._usual_length()
        origin = torch.zeros(self.num_coordinates).to(self._axes)
        downs = self.kinematics(origin).poses[:, :3, :3].mT @ self._gravity
        bodies = []
        columns = self._ends(), self._axes.double(), downs.double(), self._turning
        for end, axis, down, turns in zip(*columns, strict=True):
            if end is None and turns:
                directions = torch.cat([down[None] / 9.81, torch.eye(3).to(down)])
                across = directions - (directions @ axis)[:, None] * axis
                side = next(x for x in across if x.norm() > 0.1)
                end = usual * (axis + side / side.norm()) / 2**0.5
            if end is None or end.norm() < usual / 2:
                end = usual * axis
            bodies.append(rod(torch.zeros_like(end), end, radius=usual / 6, density=density))
        return torch.stack(bodies)

    def prior_inertia(self) -> Tensor:
        """Return pseudo-inertias ``(B, 4, 4)`` of positive density, close to those of the file.

        The radius of gyration along each axis is at least l / 300, with the mean distance l between
        joints: 1 mm for links of 0.3 m. This replaces point masses, thin rods and plates by bodies
        with a volume. :meth:`generic_inertia` replaces bodies that cannot exist: without a positive
        mass, with moments that violate the triangle inequality by more than rounding, or with a
        radius of gyration of 10 m or more.
        """
        masses = self.inertia[:, 3, 3]
        mass = torch.where(masses > 0, masses, 1.0)[:, None, None]
        centre = self.inertia[:, :3, 3:] / mass
        sizes, axes = torch.linalg.eigh(self.inertia[:, :3, :3] / mass - centre @ centre.mT)
        smallest, largest = sizes[:, 0], sizes[:, -1]
        floor = (self._usual_length() / 300) ** 2
        rounding = floor + _ROUNDED * largest
        possible = (masses > 0) & (smallest > -rounding) & (largest < _LARGEST**2)
        sizes = sizes.clamp_min(floor)
        second = axes * sizes.unsqueeze(-2) @ axes.mT + centre @ centre.mT
        inertia = joined(second, centre.squeeze(-1), torch.ones_like(masses))
        return torch.where(possible[:, None, None], mass * inertia, self.generic_inertia())

    def tip_position(self, q: Tensor) -> Tensor:
        """Return the origin of the tip frame in the base frame, ``(*batch, 3)``, m."""
        self._check(q=q)
        origin = self._tip_pose[:, 3]
        if self._tip_body < 0:
            return origin[:3].expand(*q.shape[:-1], 3)
        return self.kinematics(q).poses[..., self._tip_body, :3, :] @ origin

    def tip_jacobian(self, q: Tensor) -> Tensor:
        """Return J, ``(*batch, 6, N)``: J v is the velocity and angular velocity of the tip frame.

        Both are in the base frame. The velocity is that of the origin of the tip frame.
        """
        point = torch.nn.functional.pad(self.tip_position(q), (0, 1), value=1.0)
        reached = self._moved[:, self._tip_body] if self._tip_body >= 0 else 0 * self._moved[:, 0]
        twists = self.kinematics(q).twists * reached[:, None, None]
        linear = matvec(twists, point.unsqueeze(-2))[..., :3]
        angular = twists[..., [2, 0, 1], [1, 2, 0]]
        jacobian = torch.cat([linear, angular], dim=-1).mT
        return jacobian @ self._coupling if self._coupled else jacobian

    def lines(self, q: Tensor) -> Tensor:
        """Return a line from each joint to the next, and to the tip, ``(*batch, B + 1, 2, 3)``."""
        origins = self.kinematics(q).poses[..., :3, 3]
        base = torch.zeros_like(origins[..., :1, :])
        points = torch.cat([base, origins, self.tip_position(q).unsqueeze(-2)], dim=-2)
        starts = [parent + 1 for parent in (*self.parents, self._tip_body)]
        return torch.stack([points[..., starts, :], points[..., 1:, :]], dim=-2)

    def mass_matrix(self, q: Tensor, inertia: Tensor | None = None) -> Tensor:
        """Return M(q), ``(*batch, N, N)``. ``inertia`` defaults to the bodies of the file."""
        self._check(q=q)
        at = self.kinematics(q)
        return self._mass(at, self._in_world(at, inertia))

    def potential_energy(self, q: Tensor, inertia: Tensor | None = None) -> Tensor:
        """Return V = -sum over k of g^T h_k, ``(*batch,)``, J, with h_k = m_k c_k in the world."""
        self._check(q=q)
        bodies = self._in_world(self.kinematics(q), inertia)
        return -matvec(bodies[..., :3, 3], self._gravity).sum(-1)

    def damping_matrix(self, q: Tensor) -> Tensor:
        """Return the constant matrix D, ``(*batch, N, N)``."""
        return torch.diag_embed(self._damping.expand_as(q))

    def input_matrix(self, q: Tensor) -> Tensor:
        """Return A = I, ``(*batch, N, N)``: u holds the torques and forces at the joints."""
        return torch.eye(q.shape[-1]).to(q).expand(*q.shape, q.shape[-1])

    def _potential_force(self, q: Tensor) -> Tensor:
        return self.rigid_force(q, torch.zeros_like(q), torch.zeros_like(q))

    def inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        return self.rigid_force(q, v, a, gravity=False)

    def _in_world(self, at: Kinematics, inertia: Tensor | None) -> Tensor:
        return at.poses @ (self.inertia if inertia is None else inertia) @ at.poses.mT

    def _tree_sum(self, matrix: Tensor, values: Tensor) -> Tensor:
        return (matrix @ values.flatten(-2)).unflatten(-1, (4, 4))

    def _mass(self, at: Kinematics, bodies: Tensor) -> Tensor:
        # Composite-rigid-body algorithm (Featherstone 2008, sec. 6.2, table 6.2). Backward pass:
        # composite body of each joint.
        composite = self._tree_sum(self._moved, bodies)
        # Momentum of each composite body at unit speed of its joint, seen by the joints before it.
        momenta = (at.twists @ composite).flatten(-2)
        upper = at.twists.flatten(-2) @ momenta.mT * self._moved
        return self._of_coordinates(upper + upper.triu(1).mT)

    def _accelerations(self, at: Kinematics, v: Tensor, a: Tensor | None, pull: Tensor) -> Tensor:
        """Return Xi' + Xi^2 - Gamma of every body, ``(*batch, B, 4, 4)``.

        This is the forward pass of the recursive Newton-Euler algorithm (Featherstone 2008, sec.
        5.3, table 5.1), with gravity as an acceleration of the base.
        """
        # Velocities of the bodies: sums over the joints that move them.
        joint_velocity = at.twists * self._of_joints(v)[..., None, None]
        velocity = self._tree_sum(self._moved.mT, joint_velocity)
        # Accelerations of the bodies.
        change = _bracket(velocity, joint_velocity)
        if a is not None:
            change = change + at.twists * self._of_joints(a)[..., None, None]
        gravity = torch.nn.functional.pad(pull.unsqueeze(-1), (3, 0, 0, 1))
        return self._tree_sum(self._moved.mT, change) + velocity @ velocity - gravity

    def _force(self, at: Kinematics, accelerations: Tensor, bodies: Tensor) -> Tensor:
        # Backward pass of the recursive Newton-Euler algorithm (Featherstone 2008, table 5.1):
        # force on all bodies that a joint moves, projected onto the twist of the joint.
        forces = self._tree_sum(self._moved, accelerations @ bodies)
        tau = (at.twists * forces).sum((-2, -1))
        return tau @ self._coupling if self._coupled else tau

    def _of_joints(self, x: Tensor) -> Tensor:
        """Return S x, ``(*batch, B)``, for coordinates x ``(*batch, N)``."""
        return matvec(self._coupling, x) if self._coupled else x

    def _of_coordinates(self, matrix: Tensor) -> Tensor:
        """Return S^T X S, ``(*batch, N, N)``, for a matrix X of the joints ``(*batch, B, B)``."""
        return self._coupling.mT @ matrix @ self._coupling if self._coupled else matrix


def _bracket(first: Tensor, second: Tensor) -> Tensor:
    return first @ second - second @ first


def _pairs(first: Tensor, second: Tensor) -> Tensor:
    """Return <A_j, B_i> in row j and column i, ``(*batch, B, B)``."""
    return first.flatten(-2) @ second.flatten(-2).mT


def _screw_basis() -> Tensor:
    """Return the 4 x 4 matrices of six unit twists: turns about and slides along x, y and z."""
    basis = torch.zeros(6, 4, 4, dtype=torch.float64)
    basis[:3, :3, :3] = cross_matrix(torch.eye(3))
    basis[3:, :3, 3] = torch.eye(3)
    return basis
