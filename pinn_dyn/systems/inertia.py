"""Inertial parameters of a rigid body, as ten numbers and as a pseudo-inertia."""

from __future__ import annotations

import torch
from torch import Tensor

_OF_MATRIX = [0, 1, 4, 2, 5, 8]  # xx, xy, yy, xz, yz and zz of a flattened matrix
_OF_PARAMETERS = [4, 5, 7, 5, 6, 8, 7, 8, 9]  # the inverse, behind m and m c


def pseudo_inertia(parameters: Tensor) -> Tensor:
    """Return J ``(*batch, 4, 4)`` of ten parameters ``(*batch, 10)``.

    J = [[S, h], [h^T, m]] with h = m c and S the second moments of the mass about the origin,
    S = tr(I) / 2 - I. J is positive definite if and only if the body can have a positive density
    (Wensing, Kim and Slotine 2018, "Linear matrix inequalities for ... inertial parameter
    identification").
    """
    moments = parameters[..., _OF_PARAMETERS].unflatten(-1, (3, 3))
    half_trace = parameters[..., [4, 6, 9]].sum(-1)[..., None, None] / 2
    second = half_trace * torch.eye(3).to(parameters) - moments
    return joined(second, parameters[..., 1:4], parameters[..., 0])


def joined(second: Tensor, first: Tensor, mass: Tensor) -> Tensor:
    """Return J ``(*batch, 4, 4)`` of S ``(*batch, 3, 3)``, h ``(*batch, 3)`` and m ``(*batch)``."""
    upper = torch.cat([second, first.unsqueeze(-1)], dim=-1)
    lower = torch.cat([first, mass.unsqueeze(-1)], dim=-1)
    return torch.cat([upper, lower.unsqueeze(-2)], dim=-2)


def inertial_parameters(pseudo: Tensor) -> Tensor:
    """Return the ten parameters ``(*batch, 10)`` of J ``(*batch, 4, 4)``: I = tr(S) - S."""
    second = pseudo[..., :3, :3]
    trace = second.diagonal(dim1=-2, dim2=-1).sum(-1)
    moments = trace[..., None, None] * torch.eye(3).to(pseudo) - second
    columns = [pseudo[..., 3, 3:], pseudo[..., :3, 3], moments.flatten(-2)[..., _OF_MATRIX]]
    return torch.cat(columns, dim=-1)


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
    return joined(mass * second, mass * centre, mass)


def central_parameters(pseudo: Tensor) -> Tensor:
    """Return mass, center of mass c, and Ixx, Ixy, Iyy, Ixz, Iyz, Izz about c, ``(*batch, 10)``."""
    mass = pseudo[..., 3:, 3]
    center = pseudo[..., :3, 3] / mass
    second = pseudo[..., :3, :3] - mass[..., None] * center[..., :, None] * center[..., None, :]
    about_center = inertial_parameters(torch.nn.functional.pad(second, (0, 1, 0, 1)))
    return torch.cat([mass, center, about_center[..., 4:]], dim=-1)
