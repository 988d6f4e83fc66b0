"""Rigid bodies with known kinematics and learned constants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, Protocol, runtime_checkable

import torch
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from pinn_dyn.mechanics import RK4, Integrator
from pinn_dyn.models.friction import NoFriction
from pinn_dyn.models.known_constants import Constants, Named, PhysicalBodies, RealConstants
from pinn_dyn.models.known_slopes import KnownSamples, KnownSlopes
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.models.scales import Joint, Scales
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.models.structured import FrictionHead

INERTIAL = ("mass", "m cx", "m cy", "m cz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Names of the ten inertial parameters of a body."""


@runtime_checkable
class Structure(Protocol):
    """Rigid bodies with known kinematics. All terms are linear in their pseudo-inertias.

    ``turning`` is true for each revolute joint. ``inertia`` are the pseudo-inertias ``(n, 4, 4)``.
    """

    num_coordinates: int
    joint_names: list[str]
    turning: list[bool]
    body_names: list[str]
    inertia: Tensor

    def generic_inertia(self) -> Tensor: ...
    def parameters_of(self, inertia: Tensor) -> Tensor: ...
    def mass_matrix(self, q: Tensor, inertia: Tensor) -> Tensor: ...
    def potential_energy(self, q: Tensor, inertia: Tensor) -> Tensor: ...
    def mass_and_bias(self, q: Tensor, v: Tensor, inertia: Tensor) -> tuple[Tensor, Tensor]: ...
    def rigid_force(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor, gravity: bool
    ) -> Tensor: ...
    def regressor(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor: ...
    def force_slopes(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor
    ) -> tuple[Tensor, Tensor]: ...


class KnownMechanics(LearnedConstants):
    """Rigid bodies with known kinematics and drives, and learned constants::

        (M(q) + diag(r)) a + C(q, v) v + G(q) - o + D v + F(v) = diag(k) u

    M, C and G are those of the ``structure`` with learned pseudo-inertias. r is the armature
    (inertia of the rotors at the joint), o a constant torque, D = diag(d) viscous friction and F
    dry friction. k are the drive gains from the input to the torque, such as in Nm/A. Bodies have a
    positive density, and r, d, k > 0 for all values of the parameters, which are standard normal a
    priori (:mod:`.known_constants`). Scales come from the data: with the typical torque f = k u, d
    ~ f/v, F ~ f, o ~ f, r ~ f/a.

    Args:
        statistics: scales of the data.
        structure: the kinematics, such as a :class:`~pinn_dyn.systems.RigidChain`.
        start: ``"generic"`` starts from rods along the links, ``"prior"`` from the bodies of the
            description, which are the ground truth for a simulated robot.
        spread: prior standard deviation of the bodies, see :class:`PhysicalBodies`: 0.3 for a data
            sheet, 3 for generic bodies (with 1 their intervals are too narrow).
        friction: builder of the dry friction.
        drive_gain: initial k, one number or N. It is learned if ``gain_spread`` is positive.
        gain_spread: prior standard deviation of log k; 0 if the input is a torque.
        integrator: the integration method; Rosenbrock if friction dominates inertia.

    Raises:
        ValueError: if the structure has no rigid bodies or other joints than the data, or a body is
            not physical.
    """

    def __init__(
        self,
        statistics: Statistics,
        structure: Structure,
        start: Literal["generic", "prior"] = "generic",
        spread: PositiveFloat = 3.0,
        friction: FrictionHead = NoFriction,
        drive_gain: PositiveFloat | Sequence[PositiveFloat] = 1.0,
        gain_spread: NonNegativeFloat = 0.0,
        integrator: Integrator | None = None,
    ):
        if not isinstance(structure, Structure):
            raise ValueError(
                f"structure is a {type(structure).__name__}, expected rigid bodies such as a "
                "RigidChain: use model=known_system for the constants of other systems"
            )
        size = structure.num_coordinates
        if (statistics.num_coordinates, statistics.num_inputs) != (size, size):
            raise ValueError(
                f"the data have {statistics.num_coordinates} coordinates and "
                f"{statistics.num_inputs} inputs, expected the {size} joints "
                f"{', '.join(structure.joint_names)}: lock some (structure.locked_joints)"
            )
        super().__init__(size, size)
        self.structure = structure
        self.integrator = integrator or RK4()
        # Rods for the links of an arm. The last body has no link, so a single rod has no size.
        self._largest_ratio = 5.0 if start == "prior" else 100.0 if size > 1 else math.inf
        gain = torch.as_tensor(drive_gain, dtype=torch.float64).expand(size)
        force = gain * statistics.u_rms.double()
        acceleration = statistics.acceleration.double()
        joints = tuple(map(Joint, structure.joint_names, structure.turning))
        bodies = structure.generic_inertia() if start == "generic" else structure.inertia
        self.bodies = PhysicalBodies(bodies, spread, structure.body_names)
        scales = Scales(statistics, force, named=joints, prior=True)
        inertia, damping = force / acceleration, force / statistics.v_std.double()
        units = [joint.inertia for joint in joints]
        self.armature = scales.positive("armature", 0.03, inertia, 1.5, units)
        units = [joint.damping for joint in joints]
        self.viscous = scales.positive("viscous friction", 0.1, damping, 1.5, units)
        self.offset = RealConstants(
            0.3 * force,
            [f"{'torque' if joint.turns else 'force'} offset of {joint.name}" for joint in joints],
            [joint.force for joint in joints],
        )
        self.friction = friction(scales)
        self.gain: Constants | None = None
        if gain_spread > 0:
            units = [f"{joint.force}/u" for joint in joints]
            self.gain = scales.positive("drive gain", 1.0, gain, gain_spread, units)
        self.register_buffer("fixed_gain", gain.clone())
        self.fixed_gain: Tensor
        self.float()

    def drive_gain(self) -> Tensor:
        """Return k, ``(N,)``."""
        return self.fixed_gain if self.gain is None else self.gain()

    def physical_constants(self) -> list[Named]:
        """Return bodies, drives, friction and gains in SI units."""
        table = self.body_parameters()
        constants = []
        for column, label in enumerate(INERTIAL):
            unit = "kg" if column == 0 else "kg m" if column < 4 else "kg m^2"
            names = [f"{label} of {body}" for body in self.structure.body_names]
            lower = 0.0 if label in ("mass", "Ixx", "Iyy", "Izz") else -float("inf")
            constants.append(Named(names, [unit] * len(names), table[:, column], lower))
        drives = [part.named() for part in (self.armature, self.viscous, self.offset)]
        gains = [] if self.gain is None else [self.gain.named()]
        return [*constants, *drives, *self.friction.physical_constants(), *gains]

    def body_parameters(self) -> Tensor:
        """Return the inertial parameters pi ``(n, 10)``, with M a + C v + G = Y(q, v, a) pi."""
        return self.structure.parameters_of(self.bodies())

    def drive_force(self, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """Return r a + D v + F(v) - o - k u, ``(*batch, N)``, all terms except Y pi."""
        resistance = self.armature() * a + self.viscous() * v + self.friction(v)
        return resistance - self.offset() - self.drive_gain() * u

    def force_ratio(self, q: Tensor, v: Tensor, a: Tensor) -> tuple[Tensor, float]:
        """Return the ratio of root mean square forces of bodies and armatures, per input."""
        fitted = self.structure.rigid_force(q, v, a, self.bodies(), gravity=True)
        initial = self.structure.rigid_force(q, v, a, self.bodies.start(), gravity=True)
        ratio = (fitted + self.armature() * a).norm(dim=0) / initial.norm(dim=0)
        return ratio * self.fixed_gain / self.drive_gain(), self._largest_ratio

    def slopes(self) -> KnownSlopes:
        return KnownSlopes(self)

    def samples(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> KnownSamples:
        return KnownSamples(self, q, v, a, u)

    def mass_matrix(self, q: Tensor) -> Tensor:
        self._check(q=q)
        return self.structure.mass_matrix(q, self.bodies()) + torch.diag(self.armature())

    def potential_energy(self, q: Tensor) -> Tensor:
        self._check(q=q)
        return self.structure.potential_energy(q, self.bodies()) - (self.offset() * q).sum(-1)

    def damping_matrix(self, q: Tensor) -> Tensor:
        return torch.diag_embed(self.viscous().expand_as(q))

    def input_matrix(self, q: Tensor) -> Tensor:
        return torch.diag_embed(self.drive_gain().expand_as(q))

    def _input_force(self, q: Tensor, u: Tensor) -> Tensor:
        return self.drive_gain() * u

    def _inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        force = self.structure.rigid_force(q, v, a, self.bodies(), gravity=False)
        return force + self.armature() * a

    def _potential_force(self, q: Tensor) -> Tensor:
        zero = torch.zeros_like(q)
        gravity = self.structure.rigid_force(q, zero, zero, self.bodies(), gravity=True)
        return gravity - self.offset()

    def _mass_and_bias(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        mass, bias = self.structure.mass_and_bias(q, v, self.bodies())
        return mass + torch.diag(self.armature()), bias - self.offset()

    def _friction_force(self, v: Tensor) -> Tensor:
        return self.friction(v)

    def _friction_slope(self, v: Tensor) -> Tensor:
        return self.friction.slope(v)
