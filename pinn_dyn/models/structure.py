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

    def generic_inertia(self) -> Tensor:
        """Return the pseudo-inertias of rods along the links, ``(n, 4, 4)``."""

    def prior_inertia(self) -> Tensor:
        """Return the pseudo-inertias of the description, or of a rod for an impossible body."""

    def parameters_of(self, inertia: Tensor) -> Tensor:
        """Return the inertial parameters pi of pseudo-inertias, ``(n, 10)``."""

    def mass_matrix(self, q: Tensor, inertia: Tensor) -> Tensor:
        """Return M(q), ``(*batch, N, N)``."""

    def potential_energy(self, q: Tensor, inertia: Tensor) -> Tensor:
        """Return V(q), ``(*batch,)``, J."""

    def mass_and_bias(self, q: Tensor, v: Tensor, inertia: Tensor) -> tuple[Tensor, Tensor]:
        """Return M(q) and C(q, v) v + G(q)."""

    def rigid_force(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor, gravity: bool
    ) -> Tensor:
        """Return M(q) a + C(q, v) v, and with ``gravity`` also + G(q), ``(*batch, N)``."""

    def regressor(self, q: Tensor, v: Tensor, a: Tensor) -> Tensor:
        """Return Y with M a + C v + G = Y pi, ``(*batch, N, 10 n)``."""

    def force_slopes(
        self, q: Tensor, v: Tensor, a: Tensor, inertia: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the derivatives of M a + C v + G by q and by v, ``(*batch, N, N)`` each."""
