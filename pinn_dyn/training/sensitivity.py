"""How the motion of known mechanics depends on its parameters."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.func import functional_call

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import rollout
from pinn_dyn.models.known import KnownMechanics

_BODIES = "model.bodies.z"


class Sensitivity:
    """Derivatives of :class:`KnownMechanics` by its standardized parameters z ``(P,)``.

    Its equation of motion is e(q, v, a, u; z) = Y(q, v, a) pi(z) + drive force(v, a, u; z) = 0::

        de/dz = Y dpi/dz + d(drive force)/dz        da/dz = -M^-1 de/dz at fixed q, v, u

    The bodies need the regressor Y alone; the drive of a joint depends on its own constants, so one
    reverse pass through drives with constants of their own for each sample gives all of the rest.

    Args:
        model: in float64, at the z of interest.
    """

    def __init__(self, model: KnownMechanics):
        self.model = model
        self._bodies = self._body_slopes()

    def force(self, regressor: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """de/dz, ``(*batch, N, P)``, from Y ``(*batch, N, 10 n)``."""
        drives = self._drive_slopes(lambda m: m.drive_force(v, a, u), v)
        return torch.cat([regressor @ self._bodies, drives], dim=-1)

    def gain(self) -> Tensor:
        """dk/dz, ``(N, P)``, of the drive gains."""
        gain = self.model.fixed_gain
        # The zero keeps the sum differentiable where the gain is not learned.
        drives = self._drive_slopes(lambda m: m.drive_gain() + 0 * m.offset(), gain)
        return torch.cat([gain.new_zeros(len(gain), len(self._bodies)), drives], dim=-1)

    def rollout(self, windows: Windows) -> Tensor:
        """Derivatives of the increments of the windows by z, ``(B, H, 2N, P)``.

        The state x = (q, v) and its sensitivity S = dx/dz ``(2N, P)`` are rolled out together by
        the integrator of every roll-out, under ::

            dS/dt = (S_v, -M^-1 (de/dx S + de/dz))

        RK4 of this equation is the derivative of RK4.
        """
        model, size = self.model, self.model.num_coordinates
        count = sum(p.numel() for p in model.parameters())

        def derivative(state: Tensor, u: Tensor) -> Tensor:
            q, v = state[..., : 2 * size].chunk(2, dim=-1)
            sensitivity = state[..., 2 * size :].unflatten(-1, (2 * size, count))
            a = model.forward_dynamics(q, v, u)
            by_z = self.force(model.structure.regressor(q, v, a), v, a, u)
            change = self._by_state(q, v, a, u) @ sensitivity + by_z
            factor = torch.linalg.cholesky_ex(model.mass_matrix(q))[0]
            rates = [sensitivity[..., size:, :], -torch.cholesky_solve(change, factor)]
            return torch.cat([v, a, torch.cat(rates, dim=-2).flatten(-2)], dim=-1)

        x0 = windows.start("qv")
        start = torch.cat([x0, x0.new_zeros(len(windows), 2 * size * count)], dim=-1)
        with torch.no_grad():
            path = rollout(
                derivative, start, windows.t, windows.input, substeps=model.integrator.substeps
            )
        return path[:, 1:, 2 * size :].unflatten(-1, (2 * size, count))

    def _by_state(self, q: Tensor, v: Tensor, a: Tensor, u: Tensor) -> Tensor:
        """de/d(q, v), ``(*batch, N, 2N)``; of the drive of a joint, by its own v alone."""
        model = self.model
        by_q, by_v = model.structure.force_slopes(q, v, a, model.bodies())
        speed = v.clone().requires_grad_()
        with torch.enable_grad():
            (drive,) = torch.autograd.grad(model.drive_force(speed, a, u).sum(), speed)
        return torch.cat([by_q, by_v + torch.diag_embed(drive)], dim=-1)

    def _body_slopes(self) -> Tensor:
        """dpi/dz of the bodies, ``(10 n, 10 n)``: a block for each body."""
        z = self.model.bodies.z.detach()
        copies = z.expand(10, *z.shape).clone().requires_grad_()
        with torch.enable_grad():
            called = _Called(self.model, KnownMechanics.body_parameters)
            table = functional_call(called, {_BODIES: copies}, ())
            (slopes,) = torch.autograd.grad(table.diagonal(dim1=0, dim2=-1).sum(), copies)
        return torch.block_diag(*slopes.movedim(0, 1))

    def _drive_slopes(self, function: Callable[[KnownMechanics], Tensor], like: Tensor) -> Tensor:
        """d function_i / dz, ``(*batch, N, P - 10 n)``, of a function of the shape of ``like``."""
        called = _Called(self.model, function)
        values = {
            name: z.detach().expand_as(like).clone().requires_grad_()
            for name, z in called.named_parameters()
            if name != _BODIES
        }
        with torch.enable_grad():
            total = functional_call(called, values, ()).sum()
            slopes = torch.autograd.grad(total, list(values.values()), materialize_grads=True)
        return torch.cat([torch.diag_embed(slope) for slope in slopes], dim=-1)


class _Called(nn.Module):
    """A function of a model as the forward pass of a module."""

    def __init__(self, model: KnownMechanics, function: Callable[[KnownMechanics], Tensor]):
        super().__init__()
        self.model = model
        self.function = function

    def forward(self) -> Tensor:
        return self.function(self.model)
