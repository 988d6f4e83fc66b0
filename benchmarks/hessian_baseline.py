"""The rival: accelerations from the Hessian of the Lagrangian, sample by sample.

This is how the paper's JAX code (after Cranmer et al., Lagrangian Neural Networks, 2020) computes
them, written with torch.func: for one sample, with L(q, v) = v^T M(q) v / 2 - V(q),

    a = (d2L/dv2)^-1 (dL/dq - (d2L/dv dq) v + A(q) u - D(q) v)

and ``vmap`` over the batch. The four terms come from the heads of a LagrangianNetwork, weights
included, but none of its derivative formulas. A linear solve stands where that code inverts the
Hessian: the faster choice, in favour of the rival.
"""

import torch
from torch import Tensor
from torch.func import grad, hessian, jacfwd, vmap

from pinn_dyn.mechanics import Signal, rollout
from pinn_dyn.models import CholeskyFactor, LagrangianNetwork, NetworkCholesky, NetworkInput


class HessianBaseline:
    """State derivative and RK4 step of a Lagrangian network by per-sample Hessians.

    Args:
        model: the network whose heads give M, V, D and A; its weights are shared.
    """

    def __init__(self, model: LagrangianNetwork):
        self.model = model

    @staticmethod
    def square(head: CholeskyFactor, q: Tensor) -> Tensor:
        """L L^T of one sample, from a plain pass through the network: the fastest under vmap."""
        assert isinstance(head, NetworkCholesky)
        factor = head._assemble(head._entries(head.network(q))[0])
        return factor @ factor.T

    def lagrangian(self, q: Tensor, v: Tensor) -> Tensor:
        """L(q, v) of one sample, a scalar."""
        kinetic = 0.5 * torch.dot(v, self.square(self.model.mass, q) @ v)
        return kinetic - self.model.potential_energy(q)

    def acceleration(self, q: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """a of one sample, ``(N,)``."""
        mass = hessian(self.lagrangian, argnums=1)(q, v)
        mixed = jacfwd(grad(self.lagrangian, argnums=1), argnums=0)(q, v)
        matrix = self.model.input
        assert isinstance(matrix, NetworkInput)
        drive = (matrix.scale * matrix.network(q).unflatten(-1, matrix.shape)) @ u
        force = drive - self.square(self.model.damping, q) @ v
        force = force + grad(self.lagrangian, argnums=0)(q, v) - mixed @ v
        return torch.linalg.solve(mass, force)

    def state_derivative(self, x: Tensor, u: Tensor) -> Tensor:
        """d(q, v)/dt, ``(B, 2N)``; ordinary autograd differentiates through it."""
        q, v = x.chunk(2, dim=-1)
        return torch.cat([v, vmap(self.acceleration)(q, v, u)], dim=-1)

    def increments(self, x0: Tensor, t: Tensor, input: Signal) -> Tensor:
        """As ``LagrangianNetwork.increments``, by the same integrator."""
        return rollout(self.state_derivative, x0, t, input) - x0.unsqueeze(-2)
