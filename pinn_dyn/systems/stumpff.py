"""Stumpff functions: sin and cos of a square root, smooth through zero."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_TERMS = 16


def stumpff(x: Tensor) -> tuple[Tensor, ...]:
    """Stumpff functions c_0 ... c_6 of x = theta^2 >= 0, for theta up to 2 pi.

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
    """dc_1/dx, dc_2/dx, dc_3/dx from the values of :func:`stumpff`."""
    return 0.5 * (c[3] - c[2]), 0.5 * (2 * c[4] - c[3]), 0.5 * (3 * c[5] - c[4])


def second_slopes(c: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
    """d2c_1/dx2, d2c_2/dx2 from the values of :func:`stumpff`."""
    return (
        0.25 * (3 * c[5] - 3 * c[4] + c[3]),
        0.25 * (8 * c[6] - 5 * c[5] + c[4]),
    )
