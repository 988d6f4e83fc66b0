"""Springs between joints and their parents, and elastic joints with motors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from pydantic import PositiveFloat
from torch import Tensor, nn
from torch.nn.functional import pad

from pinn_dyn.models.known_constants import Constants, Named, PositiveConstants, RealConstants
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.structure import Structure

_START = 0.3  # initial k in units of the typical force over the spread of q
_SPREAD = 2.0  # prior standard deviation of the logarithms
_PRELOAD = 3.0  # prior standard deviation of p in typical forces, as springs may carry the weight


class JointSprings(nn.Module):
    """Linear springs at S of N joints, with the potential V and the force dV/dq::

        V = sum over j of k_j (q_j - r_j)^2 / 2,    dV/dq_j = k_j q_j - p_j,    p_j = k_j r_j

    k ``(S,)``, Nm/rad or N/m, is positive. The force p at q = 0, Nm or N, is learned instead of the
    rest angle or position r, because the equation of motion is linear in p.

    Args:
        scales: scales of the data. The value is a typical generalized force, ``(N,)``.
        joints: coordinates with a spring.
    """

    selection: Tensor

    def __init__(self, scales: Scales, joints: Sequence[int]):
        super().__init__()
        index, force = list(joints), scales.value.double()
        named = [scales.joints[k] for k in index]
        units = [joint.stiffness for joint in named]
        start = force / scales.statistics.q_std.double()
        part = Scales(scales.statistics, start, named=tuple(named), prior=True)
        self.stiffness = part.positive("spring stiffness", _START, start[index], _SPREAD, units)
        kinds = {True: "rest angle", False: "rest position"}
        names = [f"{kinds[joint.turns]} of {joint.name}" for joint in named]
        self.preload = RealConstants(_PRELOAD * force[index], names, [x.force for x in named])
        self.register_buffer("selection", torch.eye(scales.size)[index], persistent=False)

    def springs(self) -> Tensor:
        """Return k of all coordinates, ``(N,)``; 0 for a joint without a spring."""
        return self.stiffness() @ self.selection

    def constant_force(self) -> Tensor:
        """Return p of all coordinates, ``(N,)``."""
        return self.preload() @ self.selection

    def rest_positions(self) -> Tensor:
        """Return r of all coordinates, ``(N,)``; 0 for a joint without a spring."""
        return (self.preload() / self.stiffness()) @ self.selection

    def physical_constants(self) -> list[Named]:
        """Return k and r."""
        positions = self.preload() / self.stiffness()
        units = ["rad" if unit == "Nm" else "m" for unit in self.preload.units]
        rest_positions = self.preload.named()._replace(values=positions, units=units)
        return [self.stiffness.named(), rest_positions]


_RATE = 1e-3  # ratio of initial damping to stiffness, s


class ElasticJoints(nn.Module):
    """Structure with N link angles q and S motor angles theta of elastic joints::

        M(q) a + C v + G + F(v) = K (theta - q) + D (theta_dot - v)
        B theta_ddot + F_m(theta_dot) + K (theta - q) + D (theta_dot - v) = tau

    The coordinates are (q, theta), both after the gear and measured. B is the armature and F_m the
    friction of a motor. K and D of each elastic joint are learned. Source:
    Spong (1987), "Modeling and control of elastic joint robots".

    Args:
        chain: the rigid bodies, such as a :class:`~pinn_dyn.systems.RigidChain`.
        joints: names of the elastic joints, in the order of theta. The default is all.
        stiffness: initial K, Nm/rad or N/m.

    Raises:
        ValueError: if the chain does not have one of the joints.
    """

    def __init__(
        self,
        chain: Structure,
        *,
        joints: Sequence[str] | None = None,
        stiffness: PositiveFloat = 1000.0,
    ):
        super().__init__()
        self.chain, self.joints, self.stiffness = chain, joints, stiffness
        names, self.size = chain.joint_names, chain.num_coordinates
        elastic = list(joints or names)
        if unknown := set(elastic) - set(names):
            raise ValueError(f"joints names {', '.join(unknown)}, expected some of {names}")
        links = [names.index(name) for name in elastic]
        self.num_coordinates = self.size + len(elastic)
        self.joint_names = [*names, *(f"{name}_motor" for name in elastic)]
        self.turning = [*chain.turning, *(chain.turning[k] for k in links)]
        self.body_names, self.body_joints = chain.body_names, chain.body_joints
        self.generic_inertia, self.prior_inertia = chain.generic_inertia, chain.prior_inertia
        self.parameters_of = chain.parameters_of
        self.driven = [f"{name}_motor" if name in elastic else name for name in names]
        unit = torch.eye(self.num_coordinates)
        self.stretch = unit[self.size :] - unit[links]

    @property
    def inertia(self) -> Tensor:
        """Pseudo-inertias of the bodies, ``(n, 4, 4)``."""
        return self.chain.inertia

    def motor_forces(self, force: Tensor) -> Tensor:
        """Return the forces of the links at their motors, ``(N + S,)``.

        ``force`` ``(N + S,)`` acts on (q, theta).
        """
        return self.stretch.clamp(min=0).to(force).mT @ (self.stretch.abs().to(force) @ force)

    def mass_matrix(self, q: Tensor, inertia: Tensor) -> Tensor:
        return self._matrix(self.chain.mass_matrix(self._links(q), inertia))

    def potential_energy(self, q: Tensor, inertia: Tensor) -> Tensor:
        return self.chain.potential_energy(self._links(q), inertia)

    def mass_and_bias(self, q: Tensor, v: Tensor, inertia: Tensor) -> tuple[Tensor, Tensor]:
        mass, bias = self.chain.mass_and_bias(self._links(q), self._links(v), inertia)
        return self._matrix(mass), self._vector(bias)

    def rigid_force(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor, gravity: bool
    ) -> Tensor:
        q, v, a = map(self._links, (q, v, a))
        return self._vector(self.chain.rigid_force(q, v, a, inertia, gravity=gravity))

    def regressor(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        return self._vector(self.chain.regressor(*map(self._links, (q, v, a))).mT).mT

    def force_slopes(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor
    ) -> tuple[Tensor, Tensor]:
        q, v, a = map(self._links, (q, v, a))
        by_q, by_v = self.chain.force_slopes(q, v, a, inertia)
        return self._matrix(by_q), self._matrix(by_v)

    def _links(self, x: Tensor) -> Tensor:
        return x[..., : self.size]

    def _vector(self, x: Tensor) -> Tensor:
        return pad(x, (0, self.num_coordinates - self.size))

    def _matrix(self, x: Tensor) -> Tensor:
        return self._vector(self._vector(x).mT).mT


class Springs(nn.Module):
    """Learned K and D of elastic joints, ``(S,)``. A stretch s has the force K s + D ds/dt."""

    stretch: Tensor

    def __init__(self, structure: ElasticJoints):
        super().__init__()
        self.register_buffer("stretch", structure.stretch.clone(), persistent=False)
        joints = [name.removesuffix("_motor") for name in structure.joint_names[structure.size :]]
        turning = structure.turning[structure.size :]
        start = torch.full((len(joints),), float(structure.stiffness)).double()

        def constants(label: str, start: Tensor, units: tuple[str, str]) -> Constants:
            names = [f"{label} of {joint}" for joint in joints]
            return PositiveConstants(start, _SPREAD, names, [units[not x] for x in turning])

        self.stiffness = constants("joint stiffness", start, ("Nm/rad", "N/m"))
        self.damping = constants("joint damping", _RATE * start, ("Nms/rad", "Ns/m"))

    def forces(self, q: Tensor, v: Tensor) -> Tensor:
        """Return the force of each spring, ``(*batch, S)``."""
        stretch = self.stretch.mT
        return self.stiffness() * (q @ stretch) + self.damping() * (v @ stretch)

    def matrices(self) -> tuple[Tensor, Tensor]:
        """Return stiffness and damping of the coordinates (q, theta), ``(N + S, N + S)``."""
        side = self.stretch.mT
        return (side * self.stiffness()) @ side.mT, (side * self.damping()) @ side.mT
