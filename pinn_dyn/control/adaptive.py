"""A tracking law that adapts the payload and the friction of its model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, PositiveFloat
from torch import Tensor

from pinn_dyn.control.contracts import Motion, Step
from pinn_dyn.control.laws import Gain, ModelBasedLaw
from pinn_dyn.mechanics import InputSolver, MechanicalSystem
from pinn_dyn.mechanics.arrays import matvec, spd_solve
from pinn_dyn.models.known_constants import PhysicalBodies
from pinn_dyn.systems import RigidChain
from pinn_dyn.systems.inertia import inertial_parameters

Part = Literal["payload", "friction", "offset"]
_STEP = 0.5  # largest relative change of an adapted constant in a period
_FACTOR = math.log(5.0)  # largest change of the friction, logarithmic


class AdaptiveTracking(ModelBasedLaw):
    """The law of Slotine and Li, which tracks a motion and adapts constants of a rigid chain::

        w = v_r + L (q_r - q),   s = w - v
        u = A^+ (M dw/dt + C(q, v) w + G + f (D w + F(w)) - o + K_D s)
        dJ/dt = g J S J,   df_i/dt = g f_i^2 (D w + F(w))_i s_i,   do_i/dt = -g b_i^2 s_i

    J is the pseudo-inertia of the body that carries the tip and its payload, f_i a factor of the
    friction of joint i, and o_i a constant torque in addition to the model. S is the symmetric
    matrix with tr(S X) = s^T Y(X) for all X, where Y(J) is the part of the law linear in J.

    Stability: let the plant have the constants J*, f* and o*, and no other difference. With the
    divergence d(J* || J) = log(det J / det J*) + tr(J^-1 J*) - 4 of positive matrices, and
    d(f*, f) = log(f / f*) + f* / f - 1,

        V = s^T M s / 2 + (d(J* || J) + sum of d(f*_i, f_i) + sum of (o_i - o*_i)^2 / (2 b_i^2)) / g

    has the derivative dV/dt <= -s^T K_D s, because dM/dt - 2 C is skew-symmetric and friction grows
    with v. Therefore s converges to zero, and q to q_r. J stays positive definite. f is limited to
    1/5 to 5 and o to -b to b; limits that include the true values do not increase V. Under
    measurement noise, constants that the motion does not excite drift.

    In discrete time with the period T: J <- B (1 - X/2)^-1 (1 + X/2) B^T with J = B B^T and
    X = g T B^T S B. The norm of X is limited to 1/2, which keeps J positive definite.

    At limits of the input, the torque A (u - u_applied) is missing. Then s - sigma replaces s in
    the laws of adaptation. sigma is the part of s that the missing torque explains (without C)::

        M dsigma/dt + K_D sigma = A (u - u_applied)

    Sources: Slotine and Li 1987, "On the adaptive control of robot manipulators"; Lee, Kwon and
    Park 2018, "A natural adaptive control law for robot manipulators"; Karason and Annaswamy 1994,
    "Adaptive control in the presence of input constraints".

    Args:
        model: a :class:`RigidChain`, or known mechanics on one, in float64.
        position_gain: diagonal of L, 1/s, one number or N.
        velocity_gain: diagonal of K_D, Nms/rad or Ns/m.
        rate: g, 1/J. The constants converge in a time of about M / (g tau^2) after a torque error
            tau.
        adapt: adapted constants: ``"payload"``, ``"friction"`` and ``"offset"``.
        offset: b, Nm or N.
        max_condition, solver: as for :class:`ModelBasedLaw`.

    Attributes:
        constants_size: number P of constants: logarithmic changes of J (10 parameters) and of f,
            and o / b.

    Raises:
        TypeError: if the model has no rigid chain.
    """

    needs_period = True

    def __init__(
        self,
        model: MechanicalSystem,
        position_gain: Gain,
        velocity_gain: Gain,
        *,
        rate: PositiveFloat = 1.0,
        adapt: Sequence[Part] = ("payload", "friction"),
        offset: PositiveFloat = 1.0,
        max_condition: Annotated[float, Field(ge=1)] = 1e6,
        solver: InputSolver | None = None,
    ):
        chain: Any = getattr(model, "structure", model)
        if not isinstance(chain, RigidChain):
            raise TypeError(
                f"a {type(model).__name__} has no rigid chain whose bodies could adapt: use "
                "model=known with a URDF"
            )
        self.chain, self.rate, self.offset = chain, float(rate), float(offset)
        self.adapt = tuple(adapt)
        bodies: Any = getattr(model, "bodies", None)
        inertia = chain.inertia if bodies is None else bodies().detach()
        body = chain._tip_body
        self._bodies = PhysicalBodies(inertia[body : body + 1], 1.0, [chain.body_names[body]])
        self._bodies.double().requires_grad_(False)
        self._columns = slice(10 * body, 10 * body + 10)
        self._parts = torch.func.jacrev(inertial_parameters)(inertia[body].double())
        n = chain.num_coordinates
        sizes = {"payload": 10, "friction": n, "offset": n}
        self.sizes = [size * (part in self.adapt) for part, size in sizes.items()]
        self.constants_size = sum(self.sizes)
        self.memory_size = self.constants_size + model.num_coordinates + model.num_inputs
        super().__init__(
            model, position_gain, velocity_gain, max_condition=max_condition, solver=solver
        )

    def step(
        self, q: Tensor, v: Tensor, reference: Motion, applied: Tensor, memory: Tensor
    ) -> Step:
        """Return u ``(*batch, M)``. The memory holds the constants, sigma and u."""
        sizes = [self.constants_size, self.num_coordinates, self.num_inputs]
        constants, lag, last_u = memory.split(sizes, dim=-1)
        tau = self._torque(q, v, reference, constants)
        u, _, report = self._input(q, v, tau, None, applied, constants)
        missing = self.model.applied_force(q, v, last_u) - self.model.applied_force(q, v, applied)
        mass = self.model.mass_matrix(q) / self.period
        gain = torch.diag_embed(self.velocity_gain.to(q).expand(q.shape))
        lag = spd_solve(mass + gain, matvec(mass, lag) + missing)
        changes = self.changes(q, v, reference, constants, lag)
        adapted = self.adapted(constants, changes, self.period)
        if self.sizes[0]:
            report = {**report, "adapted_mass": self._inertia(constants)[..., 3, 3]}
        return Step(u, torch.cat([adapted, lag, u], dim=-1), report)

    def start(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Return the memory with the constants of the model and no missing torque."""
        zero = q.new_zeros(*q.shape[:-1], self.constants_size + self.num_coordinates)
        return torch.cat([zero, u], dim=-1)

    def stiffness(self) -> None:
        """Return None: the position gain is in 1/s."""

    def changes(
        self, q: Tensor, v: Tensor, reference: Motion, memory: Tensor, lag: Tensor
    ) -> Tensor:
        """Return g B^T S B and the rates of change of log f and of o / b, ``(*batch, R)``."""
        w, rate = self._reference_velocity(q, v, reference)
        error = w - v - lag
        parts = []
        if self.sizes[0]:
            weights = (error.unsqueeze(-1) * self._regressor(q, v, w, rate)).sum(-2)
            S = (weights @ self._parts.flatten(1)).unflatten(-1, (4, 4))
            B = self._root(memory)
            parts.append((B.mT @ (0.5 * (S + S.mT)) @ B).flatten(-2))
        _, factor, _ = self._constants(memory)
        if self.sizes[1]:
            parts.append(factor * self.model.dissipative_force(q, w) * error)
        if self.sizes[2]:
            parts.append(-self.offset * error)
        return self.rate * torch.cat(parts, dim=-1)

    def adapted(self, memory: Tensor, changes: Tensor, period: float) -> Tensor:
        """Return the constants after a period in s with constant rates ``changes``."""
        body, friction, offset = memory.split(self.sizes, dim=-1)
        first = 16 if self.sizes[0] else 0
        moved, *rates = changes.split([first, *self.sizes[1:]], dim=-1)
        if first:
            X = period * moved.unflatten(-1, (4, 4))
            X = X / (1 + X.square().sum((-2, -1), keepdim=True).sqrt() / _STEP)
            unit = torch.eye(4).to(X)
            B = self._root(memory)
            inertia = B @ spd_solve((unit - X / 2).unsqueeze(-3), (unit + X / 2).mT) @ B.mT
            body = self._bodies.parameters_of(inertia.unsqueeze(-3)).squeeze(-2)
        steps = [(period * x).clamp(-_STEP, _STEP) for x in rates]
        friction = (friction + steps[0]).clamp(-_FACTOR, _FACTOR)
        return torch.cat([body, friction, (offset + steps[1]).clamp(-1, 1)], dim=-1)

    def _forces(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, None]:
        return self._torque(q, v, reference, q.new_zeros(self.constants_size)), None

    def _torque(self, q: Tensor, v: Tensor, reference: Motion, constants: Tensor) -> Tensor:
        w, rate = self._reference_velocity(q, v, reference)
        change, factor, offset = self._constants(constants)
        zero = torch.zeros_like(v)
        model = self.model
        # C(q, v) w by the polarization of C(q, v) v, whose symbols are symmetric in v and w.
        coriolis = model.inertial_force(q, v + w, zero) - model.inertial_force(q, v - w, zero)
        tau = model.inertial_force(q, zero, rate) + coriolis / 4 + model.potential_force(q)
        tau = tau + factor * model.dissipative_force(q, w) - offset
        if self.sizes[0]:
            tau = tau + matvec(self._regressor(q, v, w, rate), change)
        return tau + self.velocity_gain.to(q) * (w - v)

    def _reference_velocity(self, q: Tensor, v: Tensor, reference: Motion) -> tuple[Tensor, Tensor]:
        """Return w and dw/dt."""
        gain = self.position_gain.to(q)
        w = reference.v + gain * (reference.q - q)
        return w, reference.a + gain * (reference.v - v)

    def _regressor(self, q: Tensor, v: Tensor, w: Tensor, rate: Tensor) -> Tensor:
        """Return Y ``(*batch, N, 10)`` of the adapted body in M dw/dt + C(q, v) w + G."""
        zero = torch.zeros_like(v)
        at_rest = self.chain.regressor(q, zero, rate)
        both, apart = (self.chain.regressor(q, x, zero) for x in (v + w, v - w))
        return (at_rest + (both - apart) / 4)[..., self._columns]

    def _root(self, memory: Tensor) -> Tensor:
        """Return B with J = B B^T; NaN where J is indefinite by rounding."""
        factor, failed = torch.linalg.cholesky_ex(self._inertia(memory))
        return torch.where(failed[..., None, None] == 0, factor, torch.nan)

    def _inertia(self, memory: Tensor) -> Tensor:
        """Return J, ``(*batch, 4, 4)``."""
        z = memory[..., : self.sizes[0]] if self.sizes[0] else memory.new_zeros(10)
        return self._bodies.value_of(z.unsqueeze(-2)).squeeze(-3)

    def _constants(self, memory: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the change of the ten parameters, f and o."""
        _, friction, offset = memory.split(self.sizes, dim=-1)
        zero = memory.new_zeros(self.chain.num_coordinates)
        change = inertial_parameters(self._inertia(memory) - self._bodies.start()[0])
        factor = (friction if self.sizes[1] else zero).exp()
        return change, factor, self.offset * (offset if self.sizes[2] else zero)
