"""Rigid bodies with known kinematics and learned constants."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

import torch
from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from pinn_dyn.mechanics import Integrator
from pinn_dyn.mechanics.integrators import with_friction
from pinn_dyn.models.drive_limits import DriveLimits
from pinn_dyn.models.drives import Drives, TorqueDrives
from pinn_dyn.models.friction import HasFriction, NoFriction
from pinn_dyn.models.known_constants import Constants, Named, PhysicalBodies, RealConstants
from pinn_dyn.models.known_slopes import KnownSamples, KnownSlopes
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.models.scales import Joint, Scales
from pinn_dyn.models.springs import ElasticJoints, JointSprings, Springs
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.models.structure import Structure
from pinn_dyn.models.structured import FrictionHead

INERTIAL = ("mass", "m cx", "m cy", "m cz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
"""Names of the ten inertial parameters of a body."""
_UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
_GENERIC_SPREAD = 3.0


class KnownMechanics(HasFriction, LearnedConstants):
    """Rigid bodies with known kinematics and drives, and learned constants::

        (M(q) + diag(r)) a + C(q, v) v + G(q) + k_s (q - q_0) - o + D v + F(v) = A u

    M, C and G are the terms of the ``structure`` with learned pseudo-inertias. r is the armature
    (inertia of the rotors at the joint), o a constant torque, D = diag(d) viscous friction and F
    dry friction. k_s and q_0 are the stiffness and the rest position of ``springs``; joints with a
    spring have no o. A ``(N, M)`` is diag(k) without the columns of passive joints. Passive joints
    have friction, but no armature and no constant torque. k are the drive gains from the input to
    the torque, for example in Nm/A. For all values of the parameters, bodies have a positive
    density, and r, d, k > 0. The prior of the parameters is standard normal
    (:mod:`.known_constants`). Scales come from the data: with the typical torque f = k u, d ~ f/v,
    F ~ f, o ~ f, r ~ f/a. At a passive joint, f is the rigid force of the initial bodies at typical
    states.

    Other drives (``input``) may add springs and damping. With :class:`~.servo.Servo`, the inputs
    are targets, and k is the stiffness. With :class:`ElasticJoints`, the coordinates are link and
    motor angles, and the inputs drive the motors. :class:`DriveLimits` limit k u, and
    :class:`~.friction.LoadDependent` friction loses a part of it.

    Args:
        statistics: scales of the data.
        structure: the kinematics, such as a :class:`~pinn_dyn.systems.RigidChain`.
        start: ``"prior"`` starts from the bodies of the robot description, which are the ground
            truth for a simulated robot. A body that cannot exist is replaced by a generic body.
            ``"generic"`` starts from rods along the links.
        spread: prior standard deviation of the bodies, see :class:`PhysicalBodies`: 0.3 for a data
            sheet, 3 for generic bodies (with 1 their intervals are too narrow). A mapping has the
            names of bodies as keys, and ``default`` for all other bodies. Generic bodies that
            replace impossible bodies have at least 3.
        friction: builder of the dry friction.
        drive_gain: initial k, one number or M. It is learned if ``gain_spread`` is positive.
        gain_spread: prior standard deviation of log k; 0 if the input is a torque.
        integrator: the integration method; Rosenbrock if friction dominates inertia.
        driven_joints: names of the joints that the inputs drive, in the order of the inputs. The
            default is all joints, the motors of elastic joints, or none if the data have no inputs.
        input: builder of other drives, such as servos, whose inputs are targets. Their k is
            ``input.stiffness``.
        springs: names of the joints with a linear spring to their parent (:class:`JointSprings`).
        limits: builder of the limits of the drives, if k u is a command that may exceed them.

    Raises:
        ValueError: if the structure has no rigid bodies, its joints do not match the data or the
            springs, ``spread`` names unknown bodies, or ``input`` is combined with limits or
            losses.
    """

    offset_joints: Tensor
    typical_force: Tensor

    def __init__(
        self,
        statistics: Statistics,
        structure: Structure,
        start: Literal["generic", "prior"] = "prior",
        spread: PositiveFloat | Mapping[str, PositiveFloat] = _GENERIC_SPREAD,
        friction: FrictionHead = NoFriction,
        drive_gain: PositiveFloat | Sequence[PositiveFloat] = 1.0,
        gain_spread: NonNegativeFloat = 0.0,
        integrator: Integrator | None = None,
        driven_joints: Sequence[str] | None = None,
        input: Callable[..., Drives] | None = None,
        springs: Sequence[str] = (),
        limits: Callable[..., DriveLimits] | None = None,
    ):
        if not isinstance(structure, Structure):
            raise ValueError(
                f"structure is a {type(structure).__name__}, expected rigid bodies such as a "
                "RigidChain: use model=known_system for the constants of other systems"
            )
        structure = copy.deepcopy(structure)  # the model converts the numbers of its copy
        names = structure.joint_names
        driven = _driven_joints(statistics, structure, driven_joints, input is not None)
        if unknown := set(springs) - set(names):
            expected = ", ".join(names)
            raise ValueError(f"springs names {', '.join(unknown)}, expected some of {expected}")
        super().__init__(len(names), statistics.num_inputs)
        self.structure = structure
        self.driven = [names.index(name) for name in driven]
        generic = structure.generic_inertia()
        bodies = structure.prior_inertia() if start == "prior" else generic
        spreads = _spreads(spread, structure.body_names)
        if start == "prior":
            guessed = (bodies == generic).flatten(1).all(1)
            spreads = torch.where(guessed, spreads.clamp(min=_GENERIC_SPREAD), spreads)
        self.bodies = PhysicalBodies(bodies, spreads, structure.body_names)
        # Generic rods model the links of an arm. A single body has no link, so its rod has no size.
        largest = 100.0 if len(driven) > 1 else math.inf
        self._largest_ratio = 5.0 if spreads.median() <= 1 else largest
        gain = torch.as_tensor(drive_gain, dtype=torch.float64).expand(len(driven))
        driven_force = None if input else gain * statistics.u_rms.double()
        force = self._typical_forces(statistics, bodies, driven_force)
        joints = tuple(map(Joint, names, structure.turning))
        scales = Scales(statistics, force, named=joints, prior=True)
        torque_drives = partial(TorqueDrives, gain=gain, gain_spread=gain_spread, limits=limits)
        self.drives = (input or torque_drives)(scales, joints=self.driven)
        force = self.drives.typical_force(force)
        scales = replace(scales, value=force)
        offsets = self._set_resistance(statistics, scales, springs)
        self.friction = friction(scales)
        if input and (limits or self.friction.by_load):
            raise ValueError("servos have their own model.input.limit: leave out model.limits")
        self.input_affine = self.drives.affine and not self.friction.by_load
        self.sticking = self.friction.sticking
        self.integrator = with_friction(integrator, self.sticking)
        self.elastic = structure.springs() if isinstance(structure, ElasticJoints) else None
        unit = torch.eye(self.num_coordinates)
        self.register_buffer("offset_joints", unit[offsets], persistent=False)
        self.register_buffer("typical_force", force, persistent=False)
        self.float()

    def _set_resistance(
        self, statistics: Statistics, scales: Scales, springs: Sequence[str]
    ) -> list[int]:
        """Set armatures, friction, offsets and springs; return the joints with an offset."""
        joints, force = scales.joints, scales.value.double()
        inertia = force / statistics.acceleration.double()
        damping = force / statistics.v_std.double()
        motors = scales.restricted(self.driven)
        self.armature = motors.positive("armature", 0.03, inertia[self.driven], 1.5, "inertia")
        self.viscous = scales.positive("viscous friction", 0.1, damping, 1.5, "damping")
        names = self.structure.joint_names
        offsets = [k for k in self.driven if names[k] not in springs]
        kinds = ["torque" if joints[k].turns else "force" for k in offsets]
        self.offset = RealConstants(
            0.3 * force[offsets],
            [f"{kind} offset of {names[k]}" for kind, k in zip(kinds, offsets, strict=True)],
            [joints[k].unit("force") for k in offsets],
        )
        index = [names.index(name) for name in springs]
        self.springs = JointSprings(scales, index) if springs else None
        return offsets

    def _typical_forces(
        self, statistics: Statistics, bodies: Tensor, driven: Tensor | None
    ) -> Tensor:
        """Return f ``(N,)``. ``driven`` ``(M,)`` holds the forces of driven joints, if known."""
        force = torch.zeros(self.num_coordinates).double()
        if driven is None or len(driven) < len(force):
            noise = torch.randn(3, 500, len(force), generator=torch.Generator().manual_seed(0))
            spreads = torch.stack([statistics.q_std, statistics.v_std, statistics.acceleration])
            q, v, a = (noise * spreads[:, None]).to(self.structure.inertia)
            q = q + statistics.q_mean.to(q)
            rigid = self.structure.rigid_force(q, v, a, bodies.to(q), gravity=True)
            force = rigid.double().square().mean(0).sqrt()
        if isinstance(self.structure, ElasticJoints):
            force = force + self.structure.motor_forces(force)
        if driven is not None:
            force[self.driven] = driven
        return force

    def drive_gain(self) -> Tensor:
        """Return k, ``(N,)``; 1 for passive joints."""
        driven = self.drives.selection
        return self.drives.strength() @ driven + (1 - driven.sum(0))

    def constant_force(self) -> Tensor:
        """Return o, or k_s q_0 of joints with a spring, ``(N,)``; 0 for other passive joints."""
        offset = self.offset() @ self.offset_joints
        return offset if self.springs is None else offset + self.springs.constant_force()

    def rotor_inertia(self) -> Tensor:
        """Return r, ``(N,)``; 0 for passive joints."""
        return self.armature() @ self.drives.selection

    def all_springs(self) -> list[Springs]:
        """Return the springs of joints, and those of elastic joints."""
        return [part for part in (self.springs, self.elastic) if part is not None]

    def physical_constants(self) -> list[Named]:
        """Return bodies, drives, friction and gains in SI units."""
        columns = self.body_parameters().unbind(-1)
        constants = []
        for label, unit, values in zip(INERTIAL, _UNITS, columns, strict=True):
            names = [f"{label} of {body}" for body in self.structure.body_names]
            lower = 0.0 if label in ("mass", "Ixx", "Iyy", "Izz") else -float("inf")
            constants.append(Named(names, [unit] * len(names), values, lower))
        drives = [part.named() for part in (self.armature, self.viscous, self.offset)]
        if self.elastic is not None:
            drives += self.elastic.physical_constants()
        drives += self.friction.physical_constants()
        drives += self.drives.physical_constants()
        if self.springs is not None:
            drives += self.springs.physical_constants()
        return constants + drives

    def body_parameters(self) -> Tensor:
        """Return the inertial parameters pi ``(n, 10)``, with M a + C v + G = Y(q, v, a) pi."""
        return self.structure.parameters_of(self.bodies())

    @property
    def gain(self) -> Constants | None:
        """Learned drive gains, or None."""
        return self.drives.gain

    def motor_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the force of the drives after transmission losses, ``(*batch, N)``."""
        return self.friction.transmitted(v, self.drives.motor_force(q, v, u))

    @property
    def identified_by_forces(self) -> bool:
        return self.drives.identified_by_forces

    def largest_input(self) -> Tensor | None:
        return self.drives.largest_input()

    def absent_parameters(self) -> Tensor | None:
        absent = self.friction.absent()
        values = [torch.full_like(x, absent.get(x, torch.nan)) for x in self.parameters()]
        return parameters_to_vector(values) if absent else None

    def saturated(self, v: Tensor, u: Tensor) -> Tensor:
        return self.drives.saturated(v, u)

    def drive_force(
        self, q: Tensor, v: Tensor, a: Tensor, u: Tensor, share: Tensor | None = None
    ) -> Tensor:
        """Return r a + D v + F - o - motor force, ``(*batch, N)``.

        Without ``share``, F is the smooth law. With the share of forward motion, F is the sliding
        friction. The terms Y pi and the forces of springs are not included.
        """
        friction = self.friction(v) if share is None else self.friction.sliding(v, share)
        resistance = self.rotor_inertia() * a + self.viscous() * v + friction
        return resistance - self.offset() @ self.offset_joints - self.motor_force(q, v, u)

    def force_ratio(self, q: Tensor, v: Tensor, a: Tensor) -> tuple[Tensor, float]:
        """Return the ratio of fitted to initial forces per input, and its largest likely value.

        The forces are those of bodies and armatures at the driven joints. At a passive joint, the
        forces of the correct bodies cancel.
        """
        fitted = self.structure.rigid_force(q, v, a, self.bodies(), gravity=True)
        initial = self.structure.rigid_force(q, v, a, self.bodies.start(), gravity=True)
        ratio = (fitted + self.rotor_inertia() * a).norm(dim=0) / initial.norm(dim=0)
        ratio = torch.where(initial.norm(dim=0) > 0, ratio, 1.0)  # a motor has no body
        gain_ratio = self.drives.strength() / self.drives.initial_strength
        return ratio[self.driven] / gain_ratio, self._largest_ratio

    def slopes(self) -> KnownSlopes:
        return KnownSlopes(self)

    def samples(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> KnownSamples:
        return KnownSamples(self, q, v, a, u)

    def mass_matrix(self, q: Tensor) -> Tensor:
        self._check(q=q)
        return self.structure.mass_matrix(q, self.bodies()) + torch.diag(self.rotor_inertia())

    def potential_energy(self, q: Tensor) -> Tensor:
        self._check(q=q)
        energy = self.structure.potential_energy(q, self.bodies())
        return energy + ((0.5 * self.spring_force(q) - self.constant_force()) * q).sum(-1)

    def damping_matrix(self, q: Tensor) -> Tensor:
        rates, drives = self.viscous(), self.drives.damping_rates()
        matrix = torch.diag(rates if drives is None else rates + drives)
        for springs in self.all_springs():
            matrix = matrix + springs.matrices()[1]
        return matrix.expand(*q.shape, -1)

    def input_matrix(self, q: Tensor) -> Tensor:
        return self.drives(q)

    def typical_input(self, q: Tensor) -> Tensor:
        return self.drives.typical_input(q)

    def input_force(self, q: Tensor, u: Tensor) -> Tensor:
        return self.drives.force(q, u)

    def applied_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return self.friction.transmitted(v, self.drives.applied(q, v, u))

    def reachable_force(self, q: Tensor, v: Tensor, tau: Tensor) -> Tensor:
        ends = self.drives.force_range(v)
        if ends is None:
            return tau
        smallest, largest = (self.friction.transmitted(v, force) for force in ends)
        return tau.clamp(smallest, largest)

    def stiffness_matrix(self, q: Tensor) -> Tensor | None:
        drives = self.drives.springs()
        matrices = [] if drives is None else [torch.diag(drives)]
        matrices += [springs.matrices()[0] for springs in self.all_springs()]
        return torch.stack(matrices).sum(0) if matrices else None

    def spring_force(self, q: Tensor) -> Tensor:
        """Return the part of G from drives, springs and elastic joints, ``(*batch, N)``."""
        stiffness = self.stiffness_matrix(q)
        return torch.zeros_like(q) if stiffness is None else q @ stiffness

    def inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        force = self.structure.rigid_force(q, v, a, self.bodies(), gravity=False)
        return force + self.rotor_inertia() * a

    def _potential_force(self, q: Tensor) -> Tensor:
        zero = torch.zeros_like(q)
        gravity = self.structure.rigid_force(q, zero, zero, self.bodies(), gravity=True)
        return gravity + self.spring_force(q) - self.constant_force()

    def mass_and_bias(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        mass, bias = self.structure.mass_and_bias(q, v, self.bodies())
        bias = bias + self.spring_force(q) - self.constant_force()
        return mass + torch.diag(self.rotor_inertia()), bias


def _driven_joints(
    statistics: Statistics,
    structure: Structure,
    driven_joints: Sequence[str] | None,
    with_servos: bool,
) -> list[str]:
    """Return the names of the joints that the inputs drive."""
    names, inputs = structure.joint_names, statistics.num_inputs
    driven: list[str] = []
    if inputs:
        default = structure.driven if isinstance(structure, ElasticJoints) else names
        driven = list(driven_joints or default)
    if with_servos and inputs == 2 * len(driven):
        inputs //= 2  # targets and feed-forward forces
    sizes, expected = (statistics.num_coordinates, inputs), (len(names), len(driven))
    if sizes != expected or len(set(driven) & set(names)) < len(driven):
        raise ValueError(
            f"the data have {sizes[0]} coordinates and {sizes[1]} inputs, expected the "
            f"{len(names)} joints {', '.join(names)} and inputs of {', '.join(driven)}: name the "
            "joints that have an input by driven_joints=[...]"
        )
    return driven


def _spreads(spread: float | Mapping[str, float], bodies: Sequence[str]) -> Tensor:
    """Return the prior standard deviation of each body, ``(n,)``."""
    by_name = spread if isinstance(spread, Mapping) else {"default": spread}
    if unknown := set(by_name) - {"default", *bodies}:
        raise ValueError(
            f"spread names {', '.join(unknown)}, expected default and some of the bodies "
            f"{', '.join(bodies)}"
        )
    default = by_name.get("default", _GENERIC_SPREAD)
    return torch.tensor([by_name.get(name, default) for name in bodies], dtype=torch.float64)
