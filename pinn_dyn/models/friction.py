"""Heads for dry friction: none, or a smooth Coulomb law for each coordinate."""

from __future__ import annotations

import abc

import torch
import torch.nn.functional as F
from pydantic import PositiveFloat
from torch import Tensor, nn

from pinn_dyn.models.known_constants import Named
from pinn_dyn.models.scales import Scales


class Friction(nn.Module, abc.ABC):
    """A dissipative force F(v) ``(*batch, N)`` beside D(q) v, with v^T F(v) >= 0.

    Attributes:
        by_load: whether a drive loses more under load, see :meth:`transmitted`.
    """

    by_load: bool = False

    @abc.abstractmethod
    def forward(self, v: Tensor) -> Tensor:
        """F(v), ``(*batch, N)``, at v ``(*batch, N)``."""

    def transmitted(self, v: Tensor, force: Tensor) -> Tensor:
        """What of the force of a drive arrives at the joint, ``(*batch, N)``; here all of it."""
        return force

    def physical_constants(self) -> list[Named]:
        """The constants as they act, of a law whose parameters are such; here none."""
        return []

    @abc.abstractmethod
    def slope(self, v: Tensor) -> Tensor:
        """dF_i/dv_i >= 0, ``(*batch, N)``; F_i depends on v_i alone."""


class NoFriction(Friction):
    """F = 0: dissipation is viscous, as in the paper.

    Args:
        scales: of the data.
    """

    def __init__(self, scales: Scales):
        super().__init__()

    def forward(self, v: Tensor) -> Tensor:
        return torch.zeros_like(v)

    def slope(self, v: Tensor) -> Tensor:
        return torch.zeros_like(v)


class CoulombFriction(Friction):
    """F_i(v) = c_i tanh(v_i / w_i), a smooth Coulomb law with learned c_i > 0 and w_i > 0.

    c_i is the friction force of coordinate i (N or Nm), w_i the speed at which it has mostly set
    in. Passive by construction: v_i F_i(v) >= 0 for every v. See Armstrong-Helouvry, Dupont and
    Canudas de Wit (1994), "A survey of models, analysis tools and compensation methods for the
    control of machines with friction", for the law and what it leaves out (stiction).

    Args:
        scales: of the data; the value is a typical generalized force, ``(N,)``.
        level: c starts at this part of the typical forces.
        width: w starts at this part of the typical speeds beyond a hundredth, below which it never
            falls, as a jump in the force could not be integrated.
    """

    force: Tensor
    v_std: Tensor

    def __init__(self, scales: Scales, *, level: PositiveFloat = 0.1, width: PositiveFloat = 0.1):
        super().__init__()
        self.raw_force = nn.Parameter(torch.full((scales.size,), level).expm1().log())
        self.raw_width = nn.Parameter(torch.full((scales.size,), width).expm1().log())
        self.register_buffer("force", scales.value.float().clone())
        self.register_buffer("v_std", scales.statistics.v_std.float().clone())

    def forward(self, v: Tensor) -> Tensor:
        force, width = self._constants()
        return force * torch.tanh(v / width)

    def slope(self, v: Tensor) -> Tensor:
        """c_i (1 - tanh(v_i / w_i)^2) / w_i."""
        force, width = self._constants()
        return force / width * (1 - torch.tanh(v / width) ** 2)

    def _constants(self) -> tuple[Tensor, Tensor]:
        """c and w, ``(N,)`` each."""
        force = self.force * F.softplus(self.raw_force)
        width = self.v_std * (F.softplus(self.raw_width) + 0.01)
        return force, width
