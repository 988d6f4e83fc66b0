"""What a head is told of the data before it learns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from pinn_dyn.models.known_constants import PositiveConstants
from pinn_dyn.models.mlp import MLP, Activation
from pinn_dyn.models.statistics import Statistics


@dataclass(frozen=True)
class Joint:
    """Name of a joint, and the units of what acts along it, by whether it turns or slides."""

    name: str
    turns: bool = True

    @property
    def force(self) -> str:
        """Of a torque or force."""
        return "Nm" if self.turns else "N"

    @property
    def speed(self) -> str:
        """Of its velocity."""
        return "rad/s" if self.turns else "m/s"

    @property
    def inertia(self) -> str:
        """Of an armature."""
        return "kg m^2" if self.turns else "kg"

    @property
    def damping(self) -> str:
        """Of viscous friction."""
        return "Nms/rad" if self.turns else "Ns/m"


@dataclass(frozen=True)
class Scales:
    """The scales that a head is built on, so that its network works on numbers near one.

    Attributes:
        statistics: means and standard deviations of q, v and u, in SI units.
        value: typical size of what the head gives, in the shape that its docstring names.
        angles: which coordinates are angles, and enter a network as sine and cosine.
        named: the joint of each coordinate, where the model knows it.
    """

    statistics: Statistics
    value: Tensor
    angles: tuple[int, ...] = ()
    named: tuple[Joint, ...] = ()

    @property
    def joints(self) -> tuple[Joint, ...]:
        """The joint of each coordinate, by its number without a name."""
        return self.named or tuple(Joint(f"joint {k + 1}") for k in range(self.size))

    @property
    def size(self) -> int:
        """N."""
        return self.statistics.num_coordinates

    @property
    def inputs(self) -> int:
        """M."""
        return self.statistics.num_inputs

    def positive(
        self, what: str, start: Tensor, spread: float, units: Sequence[str]
    ) -> PositiveConstants:
        """A learned positive constant of each joint, called "<what> of <joint>"."""
        names = [f"{what} of {joint.name}" for joint in self.joints]
        return PositiveConstants(start, spread, names, units)

    def network(
        self,
        outputs: int,
        hidden: Sequence[int],
        activation: Activation,
        after: Sequence[int] | None = None,
    ) -> MLP:
        """A network of q; outside the data what it sees of q saturates, see :class:`MLP`."""
        data = self.statistics
        limits = (data.q_low, data.q_high)
        mean, std = data.q_mean, data.q_std
        return MLP(self.size, outputs, hidden, activation, mean, std, self.angles, after, limits)
