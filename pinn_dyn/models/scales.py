"""Scales of the data for the normalization of heads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from pinn_dyn.models.known_constants import Constants, PositiveConstants, SoftplusConstants
from pinn_dyn.models.mlp import MLP, Activation
from pinn_dyn.models.statistics import Statistics


@dataclass(frozen=True)
class Joint:
    """Name of a joint, and units of its quantities for a turning or sliding joint."""

    name: str
    turns: bool = True

    @property
    def force(self) -> str:
        """Unit of a torque or force."""
        return "Nm" if self.turns else "N"

    @property
    def speed(self) -> str:
        """Unit of the velocity."""
        return "rad/s" if self.turns else "m/s"

    @property
    def inertia(self) -> str:
        """Unit of an armature."""
        return "kg m^2" if self.turns else "kg"

    @property
    def stiffness(self) -> str:
        """Unit of a stiffness."""
        return "Nm/rad" if self.turns else "N/m"

    @property
    def damping(self) -> str:
        """Unit of viscous friction."""
        return "Nms/rad" if self.turns else "Ns/m"


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

    def positive(
        self,
        label: str,
        ratio: float,
        scale: Tensor,
        spread: float,
        units: Sequence[str],
        floor: float = 0.0,
    ) -> Constants:
        """Build learned positive constants, one per joint, named "<label> of <joint>".

        Args:
            label: meaning of the constant.
            ratio: initial value in units of the scale.
            scale: typical size, ``(N,)``.
            spread: prior standard deviation of the logarithm.
            units: N units.
            floor: lower limit in units of the scale, or of the mean scale if ``prior`` is true.
        """
        names = [f"{label} of {joint.name}" for joint in self.joints]
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
