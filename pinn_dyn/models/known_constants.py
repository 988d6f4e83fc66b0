"""Learned physical constants; every parameter is a standard normal variate a priori.

So the prior is the same for all of them, ``|z|^2 / 2``: a least-squares fit adds z to its
residuals, and a parameter that no data determine stays where it started.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn


class Named(NamedTuple):
    """Constants in physical units: n names, their units, values ``(n,)``, and what none is below.

    A drive gain has the unit of its force by u, such as ``Nm/u``: no model knows that of its input.
    """

    names: list[str]
    units: list[str]
    values: Tensor
    lower: float = -float("inf")


class Constants(nn.Module, abc.ABC):
    """Constants of one kind, made of the standardized parameters ``z``.

    Attributes:
        z: the parameters, zero at the start.
        names: of the entries of z, flattened: what a direction in them means.
        units: of what these names stand for.
        lower: no constant is below it.
    """

    lower = -float("inf")

    def __init__(self, shape: Sequence[int], names: Sequence[str], units: Sequence[str]):
        super().__init__()
        self.z = nn.Parameter(torch.zeros(tuple(shape)))
        self.names = list(names)
        self.units = list(units)

    @abc.abstractmethod
    def forward(self) -> Tensor:
        """The constants in SI units."""

    def named(self) -> Named:
        """The constants with their names and units."""
        return Named(self.names, self.units, self().flatten(), self.lower)


class PositiveConstants(Constants):
    """start exp(spread z), elementwise: log-normal, so that no step leaves the positive numbers.

    Args:
        start: the median a priori, ``(n,)``.
        spread: standard deviation of the logarithm; 0.7 is a factor of two.
        names: n names.
        units: n units.

    Raises:
        ValueError: if a start is not positive.
    """

    start: Tensor
    lower = 0.0

    def __init__(self, start: Tensor, spread: float, names: Sequence[str], units: Sequence[str]):
        if not bool((start > 0).all()):
            raise ValueError(f"{names[0]}: start is {start.tolist()}, expected positive numbers")
        super().__init__(start.shape, names, units)
        self.register_buffer("start", start.float().clone())
        self.spread = spread

    def forward(self) -> Tensor:
        return self.start * torch.exp(self.spread * self.z)


class RealConstants(Constants):
    """spread * z: normal around zero.

    Args:
        spread: standard deviation a priori, ``(n,)``.
        names: n names.
        units: n units.
    """

    spread: Tensor

    def __init__(self, spread: Tensor, names: Sequence[str], units: Sequence[str]):
        super().__init__(spread.shape, names, units)
        self.register_buffer("spread", spread.float().clone())

    def forward(self) -> Tensor:
        return self.spread * self.z


class PhysicalBodies(Constants):
    """Pseudo-inertias of n bodies, each that of a body of positive density for every z::

        J = B U U^T B^T,    J_start = B B^T,    B = sqrt(m) [[S^(1/2), c], [0, 1]]

              | e^d1  s12   s13   t1 |
        U = e^a | 0   e^d2  s23   t2 |          (a, d, s, t) = spread * z
              | 0     0     e^d3  t3 |
              | 0     0     0     1  |

    m, c and S are mass, centre of mass and covariance of the mass at the start, so a is half the
    logarithm of the relative mass, d and s stretch and shear the body, and t shifts its centre, in
    units of its own extent. Source: Rucker and Wensing 2022, "Smooth parameterization of rigid-body
    inertia", eq. (9), here relative to a start.

    Args:
        start: pseudo-inertias, ``(n, 4, 4)``, kg, kg m, kg m^2.
        spread: standard deviation of (a, d, s, t) a priori.
        bodies: n names.

    Raises:
        ValueError: if a start is not a body of positive density; the message names it.
    """

    root: Tensor

    def __init__(self, start: Tensor, spread: float, bodies: Sequence[str]):
        start = start.double()
        for name, body in zip(bodies, start, strict=True):
            smallest = float(torch.linalg.eigvalsh(body)[0])
            if not smallest > 0:
                raise ValueError(
                    f"body {name!r} has a pseudo-inertia with the eigenvalue {smallest:.3g}, "
                    "expected positive ones: no body of positive density has these mass and "
                    "moments; correct its <inertial>, or use start='generic'"
                )
        parts = ["mass", "x extent", "y extent", "z extent", "xy shear", "xz shear", "yz shear"]
        parts += ["x centre", "y centre", "z centre"]
        names = [f"{part} of {body}" for body in bodies for part in parts]
        super().__init__((len(start), 10), names, ["1"] * len(names))
        mass = start[:, 3, 3, None, None]
        centre = start[:, :3, 3:] / mass
        root = torch.zeros_like(start)
        root[:, :3, :3] = torch.linalg.cholesky(start[:, :3, :3] / mass - centre @ centre.mT)
        root[:, :3, 3:], root[:, 3, 3] = centre, 1
        self.register_buffer("root", (mass.sqrt() * root).float())
        self.spread = spread

    def forward(self) -> Tensor:
        """J, ``(n, 4, 4)``; for z ``(*batch, n, 10)`` there are as many."""
        a, d1, d2, d3, s12, s13, s23, t1, t2, t3 = (self.spread * self.z).unbind(-1)
        zero, one = torch.zeros_like(a), torch.ones_like(a)
        rows = [
            [torch.exp(d1), s12, s13, t1],
            [zero, torch.exp(d2), s23, t2],
            [zero, zero, torch.exp(d3), t3],
            [zero, zero, zero, one],
        ]
        stretch = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
        root = torch.exp(a)[..., None, None] * (self.root @ stretch)
        return root @ root.mT
