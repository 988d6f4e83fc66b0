"""Inertial parameters of a rigid body, as ten numbers and as a pseudo-inertia."""

from __future__ import annotations

import torch
from torch import Tensor

_MOMENTS = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]


def pseudo_inertia_basis() -> Tensor:
    """Return E ``(10, 4, 4)``, float64, with J = sum over a of pi_a E_a.

    J = [[S, h], [h^T, m]] with h = m c and S the second moments of the mass about the origin,
    S = tr(I) / 2 - I. J is positive definite if and only if the body can have a positive density
    (Wensing, Kim and Slotine 2018, "Linear matrix inequalities for ... inertial parameter
    identification").
    """
    basis = torch.zeros(10, 4, 4, dtype=torch.float64)
    basis[0, 3, 3] = 1
    for k in range(3):
        basis[1 + k, k, 3] = basis[1 + k, 3, k] = 1
    for a, (i, j) in enumerate(_MOMENTS, start=4):
        if i == j:
            basis[a, :3, :3] = 0.5 * torch.eye(3)
            basis[a, i, i] -= 1
        else:
            basis[a, i, j] = basis[a, j, i] = -1
    return basis


def pseudo_inertia(parameters: Tensor) -> Tensor:
    """Return J ``(*batch, 4, 4)`` of ten parameters ``(*batch, 10)``."""
    return torch.einsum("...a,aij->...ij", parameters, pseudo_inertia_basis().to(parameters))


def inertial_parameters(pseudo: Tensor) -> Tensor:
    """Return the ten parameters ``(*batch, 10)`` of J ``(*batch, 4, 4)``: I = tr(S) - S."""
    second = pseudo[..., :3, :3]
    trace = second.diagonal(dim1=-2, dim2=-1).sum(-1)
    moments = trace[..., None, None] * torch.eye(3).to(pseudo) - second
    columns = [pseudo[..., 3, 3], *pseudo[..., :3, 3].unbind(-1)]
    columns += [moments[..., i, j] for i, j in _MOMENTS]
    return torch.stack(columns, dim=-1)


def rod(start: Tensor, end: Tensor, *, radius: float, density: float) -> Tensor:
    """Return J of a homogeneous cylinder from ``start`` to ``end``, ``(3,)`` each in m.

    With the length l, the radius r and the direction d, its second moments are
    S = m (c c^T + l^2 d d^T / 12 + r^2 (1 - d d^T) / 4).
    """
    along = end - start
    length = along.norm()
    direction = along / length
    mass = density * torch.pi * radius**2 * length
    centre = (start + end) / 2
    parallel = torch.outer(direction, direction)
    across = torch.eye(3, dtype=start.dtype) - parallel
    second = torch.outer(centre, centre) + length**2 / 12 * parallel + radius**2 / 4 * across
    pseudo = torch.empty(4, 4, dtype=start.dtype)
    pseudo[:3, :3] = mass * second
    pseudo[:3, 3] = pseudo[3, :3] = mass * centre
    pseudo[3, 3] = mass
    return pseudo


def central_parameters(pseudo: Tensor) -> Tensor:
    """Return mass, center of mass c, and Ixx, Ixy, Iyy, Ixz, Iyz, Izz about c, ``(*batch, 10)``."""
    mass = pseudo[..., 3:, 3]
    center = pseudo[..., :3, 3] / mass
    second = pseudo[..., :3, :3] - mass[..., None] * center[..., :, None] * center[..., None, :]
    about_center = inertial_parameters(torch.nn.functional.pad(second, (0, 1, 0, 1)))
    return torch.cat([mass, center, about_center[..., 4:]], dim=-1)
