"""Learned physical constants as functions of parameters z with a standard normal prior."""

from __future__ import annotations

import abc
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Named(NamedTuple):
    """Constants in physical units. The unit of a drive gain is that of the force per u: Nm/u.

    If ``upper_limit`` is true, data give only an upper limit of the values.
    """

    names: list[str]
    units: list[str]
    values: Tensor
    lower: float = -math.inf
    upper_limit: bool = False


class Constants(nn.Module, abc.ABC):
    """Constants of one kind as a function of the parameters ``z``, which may have any value.

    In a least-squares fit, z has a standard normal prior.

    Attributes:
        positive: true for numbers above ``lower``, and for positive definite matrices.
        names, units: meaning and unit of each entry of the flattened z.
        lower: lower limit of the constants.
        scale_with_force: true if a common factor of all masses and forces multiplies the constants,
            one value or one per entry of the flattened z.
    """

    positive: bool = False
    lower: float = -math.inf
    scale_with_force: Tensor | bool

    def __init__(self, start: Tensor, names: Sequence[str], units: Sequence[str]):
        super().__init__()
        self.z = nn.Parameter(start)
        self.names, self.units = list(names), list(units)
        self.scale_with_force = torch.tensor(["N" in unit or "kg" in unit for unit in self.units])

    @abc.abstractmethod
    def value_of(self, z: Tensor) -> Tensor:
        """Return the constants in SI units for the parameters z, ``(*batch, ...)``."""

    def parameters_of(self, values: Tensor) -> Tensor:
        """Return z of constants ``(*batch, ...)``; NaN if they are beyond their limit."""
        raise NotImplementedError(f"{type(self).__name__} has no inverse")

    def forward(self) -> Tensor:
        """Return the constants in SI units."""
        return self.value_of(self.z)

    def named(self) -> Named:
        """Return the constants with their names and units."""
        return Named(self.names, self.units, self().flatten(), self.lower)


class HasConstants(nn.Module):
    """Part of a model that lists its constants."""

    def physical_constants(self) -> list[Named]:
        """Return all constants in physical units, and all other parameters by attribute name."""
        constants: list[Named] = []
        for path, module in self.named_modules():
            if isinstance(module, Constants):
                constants.append(module.named())
                continue
            for name, parameter in module.named_parameters(path, recurse=False):
                names = [f"{name} {k + 1}" for k in range(parameter.numel())]
                constants.append(Named(names, ["1"] * len(names), parameter.flatten()))
        return constants


class PositiveConstants(Constants):
    """Log-normal constants start exp(spread z) + floor. The initial z is zero.

    Args:
        start: prior median, ``(n,)``.
        spread: prior standard deviation of the logarithm; 0.7 is a factor of two.
        names, units: n names and units.
        floor: lower limit of the constants.
    """

    positive = True
    start: Tensor

    def __init__(
        self,
        start: Tensor,
        spread: float,
        names: Sequence[str],
        units: Sequence[str],
        floor: float = 0.0,
    ):
        if not bool((start > 0).all()):
            raise ValueError(f"{names[0]}: start is {start.tolist()}, expected positive numbers")
        super().__init__(torch.zeros(start.shape), names, units)
        self.register_buffer("start", start.float().clone())
        self.spread = spread
        self.lower = floor

    def value_of(self, z: Tensor) -> Tensor:
        values = self.start * torch.exp(self.spread * z)
        return values + self.lower if self.lower else values

    def parameters_of(self, values: Tensor) -> Tensor:
        return torch.log((values - self.lower) / self.start) / self.spread


class SoftplusConstants(Constants):
    """Positive constants scale (softplus(z) + floor), for training by gradients.

    Args:
        scale: typical size, ``(n,)``.
        ratio: initial softplus(z).
        names, units: n names and units.
        floor: lower limit of the constants, in units of the scale.
    """

    scale: Tensor
    lower = 0.0

    def __init__(
        self,
        scale: Tensor,
        ratio: float,
        names: Sequence[str],
        units: Sequence[str],
        floor: float = 0.0,
    ):
        super().__init__(torch.full((len(scale),), ratio).expm1().log(), names, units)
        self.register_buffer("scale", scale.float().clone())
        self.floor = floor

    def value_of(self, z: Tensor) -> Tensor:
        values = F.softplus(z)
        return self.scale * (values + self.floor if self.floor else values)


class RealConstants(Constants):
    """Normal constants spread * z around zero, with n spreads, names and units."""

    spread: Tensor

    def __init__(self, spread: Tensor, names: Sequence[str], units: Sequence[str]):
        super().__init__(torch.zeros(spread.shape), names, units)
        self.register_buffer("spread", spread.float().clone())

    def value_of(self, z: Tensor) -> Tensor:
        return self.spread * z


class PhysicalBodies(Constants):
    """Pseudo-inertias of n bodies. Each body has a positive density for all z::

        J = B U U^T B^T,    J_start = B B^T,    B = sqrt(m) [[S^(1/2), c], [0, 1]]

              | e^d1  s12   s13   t1 |
        U = e^a | 0   e^d2  s23   t2 |          (a, d, s, t) = spread * z
              | 0     0     e^d3  t3 |
              | 0     0     0     1  |

    m, c and S are the mass, the center of mass and the covariance of the mass of the initial body.
    Source: Rucker and Wensing (2022), "Smooth parameterization of rigid-body inertia", eq. (9),
    here relative to an initial body.

    Args:
        start: pseudo-inertias of bodies of positive density, ``(n, 4, 4)``, kg, kg m, kg m^2.
        spread: prior standard deviation of (a, d, s, t), one number or n.
        bodies: n names.
    """

    positive = True
    root: Tensor
    spread: Tensor

    def __init__(self, start: Tensor, spread: float | Tensor, bodies: Sequence[str]):
        start = start.double()
        for name, body in zip(bodies, start, strict=True):
            smallest = float(torch.linalg.eigvalsh(body)[0])
            if not smallest > 0:
                raise ValueError(
                    f"body {name!r} has a pseudo-inertia with the eigenvalue {smallest:.3g}, "
                    "expected positive ones: correct its <inertial>, or use model.start=generic"
                )
        parts = ["mass", "x extent", "y extent", "z extent", "xy shear", "xz shear", "yz shear"]
        parts += ["x centre", "y centre", "z centre"]
        names = [f"{part} of {body}" for body in bodies for part in parts]
        super().__init__(torch.zeros(len(start), 10), names, ["1"] * len(names))
        self.scale_with_force = True
        mass = start[:, 3, 3, None, None]
        centre = start[:, :3, 3:] / mass
        root = torch.zeros_like(start)
        root[:, :3, :3] = torch.linalg.cholesky(start[:, :3, :3] / mass - centre @ centre.mT)
        root[:, :3, 3:], root[:, 3, 3] = centre, 1
        self.register_buffer("root", (mass.sqrt() * root).float())
        spreads = torch.as_tensor(spread, dtype=torch.float32).expand(len(start))
        self.register_buffer("spread", spreads[:, None].clone())

    def start(self) -> Tensor:
        """Return J_start, ``(n, 4, 4)``."""
        return self.root @ self.root.mT

    def value_of(self, z: Tensor) -> Tensor:
        """Return J, ``(*batch, n, 4, 4)``, for z ``(*batch, n, 10)``."""
        a, d1, d2, d3, s12, s13, s23, t1, t2, t3 = (self.spread * z).unbind(-1)
        zero, unit = torch.zeros_like(a), torch.ones_like(a)
        rows = [
            [torch.exp(d1), s12, s13, t1],
            [zero, torch.exp(d2), s23, t2],
            [zero, zero, torch.exp(d3), t3],
            [zero, zero, zero, unit],
        ]
        stretch = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
        root = torch.exp(a)[..., None, None] * (self.root @ stretch)
        return root @ root.mT

    def parameters_of(self, values: Tensor) -> Tensor:
        """Return z of pseudo-inertias, ``(*batch, n, 10)``; NaN without a positive density."""
        whitened = torch.linalg.solve(self.root, torch.linalg.solve(self.root, values).mT)
        # Reversed rows and columns turn the lower Cholesky factor into an upper factor.
        factor, failed = torch.linalg.cholesky_ex(whitened.flip(-2, -1))
        stretch = torch.where(failed[..., None, None] == 0, factor, torch.nan).flip(-2, -1)
        scale = stretch[..., 3, 3]
        unit = stretch / scale[..., None, None]
        sizes = unit.diagonal(dim1=-2, dim2=-1)[..., :3].log()
        shears = unit[..., [0, 0, 1, 0, 1, 2], [1, 2, 2, 3, 3, 3]]
        values = torch.cat([scale.log()[..., None], sizes, shears], dim=-1)
        return values / self.spread
