"""Frames of a bending segment and of segments in series; Stumpff functions."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pinn_dyn.mechanics.arrays import matvec

_TERMS = 16


def stumpff(x: Tensor) -> tuple[Tensor, ...]:
    """Return the Stumpff functions c_0 ... c_6 of x = theta^2 >= 0, for theta up to 2 pi.

    ::

        c_k(x) = sum_j (-x)^j / (k + 2 j)!
        c_0 = cos(theta),  c_1 = sin(theta)/theta,  c_2 = (1 - cos(theta))/theta^2
        c_k = 1/k! - x c_{k+2},    dc_k/dx = (k c_{k+2} - c_{k+1}) / 2

    The series of c_5 and c_6 plus the recursion downwards are exact to double precision.

    Source: Stumpff 1959, Himmelsmechanik I; Danby 1988, Fundamentals of Celestial Mechanics.
    """
    c5 = torch.full_like(x, 1 / math.factorial(5 + 2 * _TERMS))
    c6 = torch.full_like(x, 1 / math.factorial(6 + 2 * _TERMS))
    for j in range(_TERMS - 1, -1, -1):
        c5 = 1 / math.factorial(5 + 2 * j) - x * c5
        c6 = 1 / math.factorial(6 + 2 * j) - x * c6
    c4 = 1 / 24 - x * c6
    c3 = 1 / 6 - x * c5
    c2 = 1 / 2 - x * c4
    c1 = 1 - x * c3
    c0 = 1 - x * c2
    return c0, c1, c2, c3, c4, c5, c6


def first_slopes(c: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """Return dc_1/dx, dc_2/dx, dc_3/dx from the values of :func:`stumpff`."""
    return 0.5 * (c[3] - c[2]), 0.5 * (2 * c[4] - c[3]), 0.5 * (3 * c[5] - c[4])


def second_slopes(c: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Return d2c_1/dx2, d2c_2/dx2 from the values of :func:`stumpff`."""
    return 0.25 * (3 * c[5] - 3 * c[4] + c[3]), 0.25 * (8 * c[6] - 5 * c[5] + c[4])


class Tip(NamedTuple):
    """Frame at the end of a segment, in the world frame."""

    position: Tensor  # (*batch, 3)
    rotation: Tensor  # (*batch, 3, 3)
    linear: Tensor  # (*batch, 3, N), Jacobian of the position
    angular: Tensor  # (*batch, 3, N), Jacobian of the angular velocity
    linear_bias: Tensor  # (*batch, 3), (d linear/dt) v
    angular_bias: Tensor  # (*batch, 3), (d angular/dt) v


def tip_rotation(q: Tensor, c: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """Return the rotation exp([w]x), w = (-dy, dx, 0), and the Jacobian of its angular velocity.

    The angular velocity is (I + c_2 [w]x + c_3 [w]x^2) dw/dt in the base frame.
    """
    dx, dy, _ = q.unbind(-1)
    w = torch.stack([-dy, dx, torch.zeros_like(dx)], dim=-1)
    skew = cross_matrix(w)
    squared = skew @ skew
    eye = torch.eye(3, dtype=q.dtype, device=q.device)
    c1, c2, c3 = (c[k][..., -1, None, None] for k in (1, 2, 3))
    to_axis = torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 0]], dtype=q.dtype, device=q.device)
    return eye + c1 * skew + c2 * squared, (eye + c2 * skew + c3 * squared) @ to_axis


def turning_bias(q: Tensor, v: Tensor, c: tuple[Tensor, ...], c2x: Tensor, c3x: Tensor) -> Tensor:
    """Return d/dt(I + c_2 [w]x + c_3 [w]x^2) dw/dt, the bias of the angular acceleration."""
    dx, dy, _ = q.unbind(-1)
    vx, vy, _ = v.unbind(-1)
    zero = torch.zeros_like(dx)
    w, rate = torch.stack([-dy, dx, zero], -1), torch.stack([-vy, vx, zero], -1)
    growth = 2 * (dx * vx + dy * vy).unsqueeze(-1)
    c3, c2x, c3x = c[3][..., -1:], c2x[..., -1:], c3x[..., -1:]
    w_rate = torch.linalg.cross(w, rate)
    # [rate]x rate vanishes, and so does [w]x [rate]x rate.
    return (
        c2x * growth * w_rate
        + c3x * growth * torch.linalg.cross(w, w_rate)
        + c3 * torch.linalg.cross(rate, w_rate)
    )


def in_world(
    base: Tip,
    v: Tensor | None,
    r: Tensor,
    jac: Tensor,
    bias: Tensor,
    turn: Tensor,
    spin: Tensor,
    spin_bias: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Transform the kinematics of a segment from its base frame to the world frame."""
    rotation = base.rotation
    arm = r @ rotation.transpose(-1, -2)  # (*batch, S, 3)
    local = rotation.unsqueeze(-3) @ jac
    world_r = base.position.unsqueeze(-2) + arm
    world_jac = base.linear.unsqueeze(-3) + local - cross_matrix(arm) @ base.angular.unsqueeze(-3)
    world_spin = base.angular + rotation @ spin
    if v is None:
        return world_r, world_jac, bias, rotation @ turn, world_spin, spin_bias

    omega = matvec(base.angular, v).unsqueeze(-2)
    local_rate = matvec(local, v[..., None, :])
    local_spin = matvec(rotation @ spin, v)
    world_bias = (
        base.linear_bias.unsqueeze(-2)
        + torch.linalg.cross(base.angular_bias.unsqueeze(-2).expand_as(arm), arm)
        + torch.linalg.cross(
            omega.expand_as(arm), torch.linalg.cross(omega.expand_as(arm), arm) + 2 * local_rate
        )
        + bias @ rotation.transpose(-1, -2)
    )
    world_spin_bias = (
        base.angular_bias
        + matvec(rotation, spin_bias)
        + torch.linalg.cross(omega.squeeze(-2), local_spin)
    )
    return world_r, world_jac, world_bias, rotation @ turn, world_spin, world_spin_bias


def cross_matrix(w: Tensor) -> Tensor:
    """Return [w]x, ``(*batch, 3, 3)``, the matrix of the cross product with w ``(*batch, 3)``."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
