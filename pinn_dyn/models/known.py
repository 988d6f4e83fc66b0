"""Known mechanics with learned constants: an analytic structure as a model."""

from __future__ import annotations

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
"""Names of the ten inertial parameters of a body, in the order of the regressor's columns."""

Start = Literal["generic", "prior"]
"""Where the bodies start: plausible rods along the links, or those of the description."""


@runtime_checkable
class Structure(Protocol):
    """Rigid bodies with known kinematics: what :class:`KnownMechanics` needs of an analytic system.

    ``turning`` says of each joint whether it turns, else it slides; ``inertia`` are
    pseudo-inertias ``(n, 4, 4)`` of the n bodies, in which all terms are linear.
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
    """Rigid bodies with known kinematics, on drives; all constants are learned::

        (M(q) + diag(r)) a + C(q, v) v + G(q) - o + D v + F(v) = T(v, diag(k) u)

    T is the force k u, or what a gear with friction by load transmits of it. M, C and G of the
    ``structure`` with bodies of learned pseudo-inertia; r armature (inertia of the rotors, seen at
    the joint), o constant torque (a potential -o^T q), D = diag(d) viscous and F dry friction, k
    drive gains from the input to the torque: Nm/A where currents are logged. Every value of the
    parameters is a physical robot: bodies of positive density, r, d, k > 0.

    Each parameter is a standard normal variate a priori (:mod:`.known_constants`). The scales of
    the drives come from the data: with f_i the typical torque k_i u_i, d ~ f/v, F and o ~ f and
    r ~ f/a.

    Args:
        statistics: scales of the data.
        structure: the kinematics, such as a :class:`~pinn_dyn.systems.RigidChain`.
        start: ``"generic"`` starts from rods along the links, ``"prior"`` from the bodies of the
            structure's description. For a simulated robot the latter would be the truth.
        spread: how far bodies may be from their start, see :class:`PhysicalBodies`; 0.3 for a data
            sheet, 3 for generic ones, whose intervals are too narrow with 1
            (``benchmarks/random_chains.py``).
        friction: builder of the dry friction.
        drive_gain: k at its start, one number or N; learned if ``gain_spread`` is positive.
        gain_spread: standard deviation of log k a priori; 0 where the input is a torque.
        integrator: the method of integration; :class:`~pinn_dyn.mechanics.Rosenbrock` where
            friction outweighs inertia.

    Raises:
        ValueError: if the structure has no rigid bodies, the data have other coordinates than it,
            on bodies that are not physical, a spread or gains that are not positive, or a negative
            ``gain_spread``.
    """

    def __init__(
        self,
        statistics: Statistics,
        structure: Structure,
        start: Start = "generic",
        spread: PositiveFloat = 3.0,
        friction: FrictionHead = NoFriction,
        drive_gain: PositiveFloat | Sequence[PositiveFloat] = 1.0,
        gain_spread: NonNegativeFloat = 0.0,
        integrator: Integrator | None = None,
    ):
        if not isinstance(structure, Structure):
            raise ValueError(
                f"structure is a {type(structure).__name__}, expected rigid bodies such as a "
                "RigidChain: constants of other systems are learned by model=known_system"
            )
        size = structure.num_coordinates
        if (statistics.num_coordinates, statistics.num_inputs) != (size, size):
            raise ValueError(
                f"the data have {statistics.num_coordinates} coordinates and "
                f"{statistics.num_inputs} inputs, the structure has the {size} joints "
                f"{', '.join(structure.joint_names)}: expected one coordinate and one input for "
                "each; lock the others (structure.locked_joints)"
            )
        super().__init__(size, size)
        self.structure = structure
        self.integrator = integrator or RK4()
        gain = torch.as_tensor(drive_gain, dtype=torch.float64)
        if gain.shape not in ((), (size,)):
            raise ValueError(f"drive_gain has {len(gain)} numbers, expected 1 or {size}")
        gain = gain.expand(size)
        force = gain * statistics.u_rms.double()
        acceleration = statistics.acceleration.double()
        joints = tuple(map(Joint, structure.joint_names, structure.turning))
        bodies = structure.generic_inertia() if start == "generic" else structure.inertia
        self.bodies = PhysicalBodies(bodies, spread, structure.body_names)
        scales = Scales(statistics, force, named=joints, prior=True)
        inertia, damping = force / acceleration, force / statistics.v_std.double()
        self.armature = scales.positive(
            "armature", 0.03, inertia, 1.5, [joint.inertia for joint in joints]
        )
        self.viscous = scales.positive(
            "viscous friction", 0.1, damping, 1.5, [joint.damping for joint in joints]
        )
        self.offset = RealConstants(
            0.3 * force,
            [f"{'torque' if joint.turns else 'force'} offset of {joint.name}" for joint in joints],
            [joint.force for joint in joints],
        )
        self.friction = friction(scales)
        self.input_affine = not self.friction.by_load
        self.gain: Constants | None = None
        if gain_spread > 0:
            units = [f"{joint.force}/u" for joint in joints]
            self.gain = scales.positive("drive gain", 1.0, gain, gain_spread, units)
        self.register_buffer("fixed_gain", gain.clone())
        self.fixed_gain: Tensor
        self.float()

    # What is learned.

    def drive_gain(self) -> Tensor:
        """k, ``(N,)``."""
        return self.fixed_gain if self.gain is None else self.gain()

    def physical_constants(self) -> list[Named]:
        """All constants in SI units: masses, m c, moments of inertia, drives, friction, gains."""
        table = self.body_parameters()
        found = []
        for column, label in enumerate(INERTIAL):
            unit = "kg" if column == 0 else "kg m" if column < 4 else "kg m^2"
            names = [f"{label} of {body}" for body in self.structure.body_names]
            lower = 0.0 if label in ("mass", "Ixx", "Iyy", "Izz") else -float("inf")
            found.append(Named(names, [unit] * len(names), table[:, column], lower))
        drives = [part.named() for part in (self.armature, self.viscous, self.offset)]
        gains = [] if self.gain is None else [self.gain.named()]
        return [*found, *drives, *self.friction.physical_constants(), *gains]

    def body_parameters(self) -> Tensor:
        """pi ``(n, 10)``: the inertial parameters, with M a + C v + G = Y(q, v, a) pi."""
        return self.structure.parameters_of(self.bodies())

    def drive_force(self, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """r a + D v + F(v) - o - T(v, k u), ``(*batch, N)``: all but the bodies, on one side.

        The equation of motion is Y pi + drive force = 0. The drive of a joint depends on the
        constants of that joint alone.
        """
        resistance = self.armature() * a + self.viscous() * v + self.friction(v)
        return resistance - self.offset() - self.friction.transmitted(v, self.drive_gain() * u)

    def slopes(self) -> KnownSlopes:
        """The derivatives of the missing force, by closed formulas."""
        return KnownSlopes(self)

    def samples(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> KnownSamples:
        """e at fixed samples, by their regressor."""
        return KnownSamples(self, q, v, a, u)

    # The contract of a mechanical system.

    def mass_matrix(self, q: Tensor) -> Tensor:
        """M(q) + diag(r), ``(*batch, N, N)``."""
        self._check(q=q)
        return self.structure.mass_matrix(q, self.bodies()) + torch.diag(self.armature())

    def potential_energy(self, q: Tensor) -> Tensor:
        """V(q) - o^T q, ``(*batch,)``, J."""
        self._check(q=q)
        return self.structure.potential_energy(q, self.bodies()) - (self.offset() * q).sum(-1)

    def damping_matrix(self, q: Tensor) -> Tensor:
        """D = diag(d), ``(*batch, N, N)``."""
        return torch.diag_embed(self.viscous().expand_as(q))

    def input_matrix(self, q: Tensor) -> Tensor:
        """A = diag(k), ``(*batch, N, N)``."""
        return torch.diag_embed(self.drive_gain().expand_as(q))

    def _input_force(self, q: Tensor, u: Tensor) -> Tensor:
        return self.drive_gain() * u

    def _applied_force(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        return self.friction.transmitted(v, self._input_force(q, u))

    def _inertial_force(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        force = self.structure.rigid_force(q, v, a, self.bodies(), gravity=False)
        return force + self.armature() * a

    def _potential_force(self, q: Tensor) -> Tensor:
        rest = torch.zeros_like(q)
        return (
            self.structure.rigid_force(q, rest, rest, self.bodies(), gravity=True) - self.offset()
        )

    def _mass_and_bias(self, q: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        mass, bias = self.structure.mass_and_bias(q, v, self.bodies())
        return mass + torch.diag(self.armature()), bias - self.offset()

    def _friction_force(self, v: Tensor) -> Tensor:
        return self.friction(v)

    def _friction_slope(self, v: Tensor) -> Tensor:
        return self.friction.slope(v)
