"""Draws from the posterior of a least-squares fit."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models.known_constants import Constants

_STEPS_PER_DIMENSION = 10
_MARGIN = 0.999  # of the way to the border of what is possible


def sampled_models(model: Predictor, covariance: Tensor, count: int, seed: int) -> list[Predictor]:
    """Draw models from the posterior of their constants.

    The force of the model is linear in the pseudo-inertias J of the bodies and in most positive
    constants c, but not in their parameters z. The draws have the normal distribution of J and c
    with the posterior covariance C of z, restricted to what is possible::

        J = J_fit + (dJ/dz) e,   c = c_fit + (dc/dz) e,   e ~ N(0, C),   J > 0,   c > 0

    The common factor of all masses and forces is drawn in its logarithm instead of e, because data
    with learned drive gains do not determine it. In directions that the data do not determine, C is
    the covariance of the prior. So draws keep all forces that the data determine, also where the
    prior is wide, and every body has a positive density. A hit-and-run sampler draws them: along a
    random direction, e is normal on the interval of what is possible. Source: Smith 1984, Efficient
    Monte Carlo procedures for generating points uniformly distributed over bounded regions.

    Args:
        model: model with the fitted z.
        covariance: C, ``(P, P)``.
        count: number of draws.
        seed: seed of the draws.

    Returns:
        Copies of the model in float64 with drawn constants.
    """
    model = copy.deepcopy(model).double().requires_grad_(False)
    z = parameters_to_vector(model.parameters())
    limits = _Limits(model, len(z))
    root = torch.linalg.cholesky(covariance.double())
    common = limits.log_factor + limits.factor * z  # dz by the logarithm of the common factor
    rise = torch.linalg.solve_triangular(root, common[:, None], upper=False)
    size = rise.norm().clamp(min=1e-9)
    root = root @ (torch.eye(len(z)).to(z) - rise @ rise.T / size**2)
    generator = torch.Generator().manual_seed(seed)
    noise = _possible(limits, root, count, generator)
    factor = torch.randn(count, 1, generator=generator).to(z) / size
    shifted = limits.parameters_of(z, noise)
    models = []
    for values in shifted * torch.exp(limits.factor * factor) + limits.log_factor * factor:
        member = copy.deepcopy(model)
        vector_to_parameters(values, member.parameters())
        models.append(member)
    return models


class _Limits:
    """Limits of a shift e ``(*batch, P)`` of the parameters, linear in bodies and constants.

    A common factor s of all masses and forces multiplies z by s to the power of ``factor``, and
    adds ``log_factor`` log s.
    """

    def __init__(self, model: nn.Module, size: int):
        self.factor = torch.zeros(size, dtype=torch.float64)
        self.log_factor = self.factor.clone()
        self.parts: list[tuple[Constants, slice, Tensor, Tensor]] = []
        positions, first = {}, 0
        for parameter in model.parameters():
            positions[id(parameter)] = slice(first, first + parameter.numel())
            first += parameter.numel()
        for part in model.modules():
            if not isinstance(part, Constants):
                continue
            where = positions[id(part.z)]
            if not part.positive:
                self.factor[where] = torch.as_tensor(part.scale_with_force).double()
                continue
            values = part()
            slopes = torch.func.jacrev(part.value_of)(part.z).reshape(-1, part.z.numel())
            self.parts.append((part, where, values, slopes))
            rise = torch.func.jvp(part.parameters_of, (values,), (values,))[1].flatten()
            self.log_factor[where] = rise * part.scale_with_force

    def changes(self, shift: Tensor) -> list[Tensor]:
        """Return the change of the constants of each part, ``(*batch, n)`` or with matrices."""
        return [
            (shift[..., where] @ slopes.T).unflatten(-1, values.shape)
            for _, where, values, slopes in self.parts
        ]

    def reach(self, shift: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Return the least and the largest s for which shift + s direction is possible."""
        factors = []  # all factors 1 + s x of eigenvalues stay positive
        changes = zip(self.parts, self.changes(shift), self.changes(direction), strict=True)
        for (part, _, values, _), moved, change in changes:
            if values.ndim == 1:
                factors.append(change / (values + moved - part.lower))
                continue
            root = torch.linalg.cholesky(values + moved)
            half = torch.linalg.solve_triangular(root, change, upper=False)
            whitened = torch.linalg.solve_triangular(root, half.mT, upper=False)
            factors.append(torch.linalg.eigvalsh(whitened).flatten(1))
        values = torch.cat(factors, dim=-1)
        largest, least = values.amax(1).clamp(min=1e-9), values.amin(1).clamp(max=-1e-9)
        return -_MARGIN / largest, -_MARGIN / least

    def parameters_of(self, z: Tensor, shift: Tensor) -> Tensor:
        """Return z of shifted bodies and constants, ``(*batch, P)``."""
        parameters = z + shift
        for (part, where, values, _), moved in zip(self.parts, self.changes(shift), strict=True):
            parameters[:, where] = part.parameters_of(values + moved).flatten(1)
        return parameters


def _possible(limits: _Limits, root: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return e = R w with w ~ N(0, I), restricted to the limits, ``(count, P)``."""
    w = torch.zeros(count, len(root), dtype=torch.float64)
    for _ in range(_STEPS_PER_DIMENSION * len(root)):
        direction = torch.randn(w.shape, generator=generator).to(w)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        lowest, highest = limits.reach(w @ root.T, direction @ root.T)
        center = -(w * direction).sum(-1)
        low, high = (torch.special.ndtr(end - center) for end in (lowest, highest))
        level = low + (high - low) * torch.rand(count, generator=generator).to(w)
        step = center + torch.special.ndtri(level.clamp(1e-12, 1 - 1e-12))
        w = w + torch.maximum(torch.minimum(step, highest), lowest)[:, None] * direction
    return w @ root.T


DRAWS = 20


def posterior_draws(model: Predictor, covariance: Tensor, size: int = DRAWS) -> Ensemble:
    """Draw E models with parameters from N(z, C). The draws are the same every time.

    The spread of their predictions shows the uncertainty of the fitted constants. It includes
    neither the noise of the measured initial state nor forces that the model lacks.

    Args:
        model: model with the fitted z.
        covariance: C, ``(P, P)``.
        size: E.
    """
    z = parameters_to_vector(model.parameters()).detach().double()
    root = torch.linalg.cholesky(covariance.double())
    noise = torch.randn(size, len(z), generator=torch.Generator().manual_seed(0)).double()
    members = [copy.deepcopy(model) for _ in range(size)]
    for member, shift in zip(members, noise @ root.T, strict=True):
        vector_to_parameters((z + shift).to(next(model.parameters()).dtype), member.parameters())
    return Ensemble(members)
