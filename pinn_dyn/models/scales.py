"""Scales of the data for the normalization of heads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from torch import Tensor

from pinn_dyn.models.known_constants import Constants, PositiveConstants, SoftplusConstants
from pinn_dyn.models.mlp import MLP, Activation
from pinn_dyn.models.statistics import Statistics

_UNITS = {
    "ratio": ("1", "1"),
    "position": ("m", "rad"),
    "speed": ("m/s", "rad/s"),
    "force": ("N", "Nm"),
    "gain": ("N/u", "Nm/u"),
    "inertia": ("kg", "kg m^2"),
    "stiffness": ("N/m", "Nm/rad"),
    "damping": ("Ns/m", "Nms/rad"),
}
"""Units of the quantities of a sliding and of a turning joint."""


@dataclass(frozen=True)
class Joint:
    """Name of a joint, and whether it turns or slides."""

    name: str
    turns: bool = True

    def unit(self, quantity: str) -> str:
        """Return the unit of a quantity, such as ``"force"``; a unit is returned as it is."""
        return _UNITS.get(quantity, (quantity, quantity))[self.turns]


@dataclass(frozen=True)
class Scales:
    """Scales by which a head normalizes the inputs and outputs of its network.

    Attributes:
        statistics: means and standard deviations of q, v and u, in SI units.
        value: typical size of the output of the head. The docstring of the head gives the shape.
        angles: coordinates that are angles. Networks use their sine and cosine.
        named: the joint of each coordinate, or None if the model does not know the joints.
        prior: true if learned constants have a standard normal prior, for a least-squares fit.
    """

    statistics: Statistics
    value: Tensor
    angles: tuple[int, ...] = ()
    named: tuple[Joint, ...] | None = None
    prior: bool = False

    @property
    def joints(self) -> tuple[Joint, ...]:
        """Joint of each coordinate. Unnamed joints are numbered."""
        if self.named is not None:
            return self.named
        return tuple(Joint(f"joint {k + 1}") for k in range(self.size))

    @property
    def size(self) -> int:
        """Number of coordinates N."""
        return self.statistics.num_coordinates

    @property
    def inputs(self) -> int:
        """Number of inputs M."""
        return self.statistics.num_inputs

    def restricted(self, index: Sequence[int]) -> Scales:
        """Return the same scales for constants of some of the joints."""
        return replace(self, named=tuple(self.joints[k] for k in index))

    def positive(
        self,
        label: str,
        ratio: float,
        scale: Tensor,
        spread: float,
        quantity: str,
        floor: float = 0.0,
    ) -> Constants:
        """Build learned positive constants, one per joint, named "<label> of <joint>".

        Args:
            label: meaning of the constant.
            ratio: initial value in units of the scale.
            scale: typical size, ``(N,)``.
            spread: prior standard deviation of the logarithm.
            quantity: quantity whose unit the constants have, or the unit, see :meth:`Joint.unit`.
            floor: lower limit in units of the scale, or of the mean scale if ``prior`` is true.
        """
        names = [f"{label} of {joint.name}" for joint in self.joints]
        units = [joint.unit(quantity) for joint in self.joints]
        if self.prior:
            scale = scale.double()
            lower = floor * float(scale.mean())
            return PositiveConstants(ratio * scale, spread, names, units, lower)
        return SoftplusConstants(scale, ratio, names, units, floor)

    def network(
        self,
        outputs: int,
        hidden: Sequence[int],
        activation: Activation,
        after: Sequence[int] | None = None,
    ) -> MLP:
        """Build a network of q whose input saturates outside the data, see :class:`MLP`."""
        data = self.statistics
        normal, limits = (data.q_mean, data.q_std), (data.q_low, data.q_high)
        return MLP(self.size, outputs, hidden, activation, *normal, self.angles, after, limits)
