"""The contract of rigid bodies with known kinematics."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from torch import Tensor


@runtime_checkable
class Structure(Protocol):
    """Rigid bodies with known kinematics. All terms are linear in their pseudo-inertias.

    ``turning`` is true for each revolute joint. ``inertia`` holds the pseudo-inertias
    ``(n, 4, 4)``, and ``body_joints`` the indices of the joints that move the bodies.
    """

    num_coordinates: int
    joint_names: list[str]
    turning: list[bool]
    body_names: list[str]
    body_joints: list[int]
    inertia: Tensor

    def generic_inertia(self) -> Tensor: ...
    def prior_inertia(self) -> Tensor: ...
    def parameters_of(self, inertia: Tensor) -> Tensor: ...
    def mass_matrix(self, q: Tensor, inertia: Tensor) -> Tensor: ...
    def potential_energy(self, q: Tensor, inertia: Tensor) -> Tensor: ...
    def mass_and_bias(self, q: Tensor, v: Tensor, inertia: Tensor) -> tuple[Tensor, Tensor]: ...
    def rigid_force(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor, gravity: bool
    ) -> Tensor: ...
    def regressor(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor: ...
    def force_slopes(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor
    ) -> tuple[Tensor, Tensor]: ...
