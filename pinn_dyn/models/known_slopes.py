"""Closed-form derivatives of the force of known mechanics."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.func import functional_call

from pinn_dyn.models.learned_constants import Called, LearnedConstants, Samples, Slopes


class KnownSlopes(Slopes):
    """Derivatives of :class:`~.known.KnownMechanics` with the regressor Y of its bodies::

        e = Y(q, v, a) pi(z) + drive force(q, v, a, u; z)
        de/dz = Y dpi/dz + d(drive force)/dz

    A single reverse pass through all drives, with a copy of the constants for each sample, gives
    the second term.
    """

    def by_parameters(self, *at: Tensor) -> Tensor:
        return self.by_regressor(self.model.structure.regressor(*at[:3]), *at)

    def by_regressor(self, regressor: Tensor, *at: Tensor) -> Tensor:
        """Return de/dz, ``(*batch, N, P)``, with Y at the samples, ``(*batch, N, 10 n)``."""
        model, z = self.model, self.model.bodies.z.detach()
        copies = z.expand(10, *z.shape).clone().requires_grad_()  # one for each parameter pi

        def elements(m: Any) -> Tensor:
            """Return the forces of all drives, followed by all springs, ``(*batch, N + S)``."""
            springs = (part.forces(*at[:2]) for part in m.all_springs())
            return torch.cat([m.drive_force(*at), *springs], dim=-1)

        called = Called(model, elements)
        values = {
            name: z.detach().expand(*at[0].shape[:-1], -1).clone().requires_grad_()
            for name, z in called.named_parameters()
            if name != "model.bodies.z"
        }
        with torch.enable_grad():
            table = model.structure.parameters_of(model.bodies.value_of(copies))
            (bodies,) = torch.autograd.grad(table.diagonal(dim1=0, dim2=-1).sum(), copies)
            total = functional_call(called, values, ()).sum()
            slopes = torch.autograd.grad(total, list(values.values()), materialize_grads=True)
        # Constants of drives have an entry per driven joint, not per joint.
        sides = dict.fromkeys(("armature", "drives"), model.drives.selection)
        sides["offset"] = model.offset_joints
        for name in ("springs", "elastic"):
            if (springs := getattr(model, name)) is not None:
                sides[name] = springs.stretch
        blocks = [regressor @ torch.block_diag(*bodies.movedim(0, 1))]
        for name, slope in zip(values, slopes, strict=True):
            side = sides.get(name.split(".")[1])
            blocks.append(
                torch.diag_embed(slope) if side is None else side.mT * slope[..., None, :]
            )
        return torch.cat(blocks, dim=-1)

    def by_state(self, *at: Tensor) -> Tensor:
        q, v, a, *inputs = at
        by_q, by_v = self.model.structure.force_slopes(q, v, a, self.model.bodies())
        state = q.clone().requires_grad_(), v.clone().requires_grad_()
        with torch.enable_grad():
            force = self.model.drive_force(*state, a, *inputs).sum()
            drives = torch.autograd.grad(force, state, materialize_grads=True)
        by_q, by_v = (x + torch.diag_embed(y) for x, y in zip((by_q, by_v), drives, strict=True))
        for springs in self.model.all_springs():
            stiffness, damping = springs.matrices()
            by_q, by_v = by_q + stiffness, by_v + damping
        return torch.cat([by_q, by_v], dim=-1)


class KnownSamples(Samples):
    """Samples with a regressor Y that is computed once; Y does not depend on the parameters."""

    def __init__(self, model: LearnedConstants, q: Tensor, v: Tensor, a: Tensor, u: Tensor):
        super().__init__(model, q, v, a, u)
        self._regressor = self.model.structure.regressor(q, v, a)

    def missing_force(self) -> Tensor:
        bodies = self._regressor @ self.model.body_parameters().flatten()
        force = bodies + self.model.drive_force(*self.at)
        for springs in self.model.all_springs():
            force = force + springs.forces(*self.at[:2]) @ springs.stretch
        return force

    def by_parameters(self) -> Tensor:
        return self.model.slopes().by_regressor(self._regressor, *self.at)
