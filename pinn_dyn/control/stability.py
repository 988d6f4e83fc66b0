"""The paper's Proposition 1 in numbers: its conditions, its deltas and the error they allow.

Plant and law, paper eqs. (armdynamics) and (controller_PD), with N = M::

    M(q) dv/dt + C(q, v) v + G(q) + D(q) v = A(q) u
    u = A_L^-1 G_L + A_L^T (K_P (q_ref - q) - K_D v)

together give the closed loop::

    M dv/dt + C v + (D + Khat_D) v = Delta_all + Khat_P (q_ref - q)
    Delta_all = A A_L^-1 G_L - G,     Khat_P = A A_L^T K_P,     Khat_D = A A_L^T K_D

The arm rests where q - q_ref = h(q) = Khat_P^-1 Delta_all. None of this depends on the factor P;
docs/stability.md derives it line by line. Shapes: K configurations q ``(K, N)``; float64 inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd
import torch
from torch import Tensor

from pinn_dyn.control.factor import FactorBounds, factor_bounds, fit_factor
from pinn_dyn.control.laws import Gain, diagonal_gain
from pinn_dyn.mechanics import MechanicalSystem, double_copy
from pinn_dyn.mechanics.arrays import matvec, require_finite, require_last_dim


@dataclass(frozen=True)
class StabilityCertificate:
    """Proposition 1 at K configurations of a region. Each is ``(K,)`` unless it says otherwise.

    Attributes:
        region: name of the region.
        q: configurations, ``(K, N)``.
        position_gain, velocity_gain: diagonals of K_P and K_D, ``(N,)``.
        condition_1: smallest eigenvalue of the symmetric part of A A_L^T, eq. (PD_transpose); the
            condition holds where it is positive.
        position_eigenvalue, velocity_eigenvalue: the same of Khat_P and Khat_D. For gains that
            differ between coordinates condition 1 does not make them positive.
        delta_all: |A A_L^-1 G_L - G|.
        potential_force: |G|, to compare with.
        rest_error: |Khat_P^-1 Delta_all|, the distance from q_ref of an arm that rests at q.
        rest_error_bound: delta_all / (min K_P * condition_1), a cruder bound on the same;
            infinite where condition 1 fails.
        smallest_singular_value_A, smallest_singular_value_A_L: of the true and the learned one.
        fitted: bounds with the P that fits M, D, G and A together.
        matched: bounds with P = A_L A^-1, which makes Delta_A vanish.
    """

    region: str
    q: Tensor
    position_gain: Tensor
    velocity_gain: Tensor
    condition_1: Tensor
    position_eigenvalue: Tensor
    velocity_eigenvalue: Tensor
    delta_all: Tensor
    potential_force: Tensor
    rest_error: Tensor
    rest_error_bound: Tensor
    smallest_singular_value_A: Tensor
    smallest_singular_value_A_L: Tensor
    fitted: FactorBounds
    matched: FactorBounds

    def to_frame(self) -> pd.DataFrame:
        """One row per configuration: q1 to qN, then every number of that configuration."""
        columns: dict[str, Tensor] = {}
        for name, value in vars(self).items():
            if isinstance(value, FactorBounds):
                columns |= {f"{name}_{key}": x for key, x in vars(value).items() if key != "P"}
            elif name not in ("region", "q", "position_gain", "velocity_gain"):
                columns[name] = value
        return per_configuration(self.q, columns)


def certify(
    model: MechanicalSystem,
    truth: MechanicalSystem,
    q: Tensor,
    position_gain: Gain,
    velocity_gain: Gain,
    *,
    region: str,
) -> StabilityCertificate:
    """Proposition 1 at every configuration of a region.

    Args:
        model: the learned system.
        truth: the true system, with the same N = M.
        q: configurations, ``(K, N)``.
        position_gain: diagonal of K_P, one number or N.
        velocity_gain: diagonal of K_D, one number or N.
        region: a name for where the configurations come from.

    Raises:
        TypeError: if one of the two is no mechanical system.
        ValueError: on sizes that do not match, an underactuated system, gains that are not
            positive, or an A or A_L without full rank.
    """
    model, truth, q = prepare(model, truth, q, "q")
    K_P = diagonal_gain("position_gain", position_gain, q.shape[-1]).to(q)
    K_D = diagonal_gain("velocity_gain", velocity_gain, q.shape[-1]).to(q)
    with torch.no_grad():
        true, learned = truth.terms(q), model.terms(q)
        A, A_L = true.A, learned.A
        K_A = A @ A_L.mT
        delta_all = matvec(A, solve(A_L, learned.G)) - true.G
        size = torch.linalg.vector_norm(delta_all, dim=-1)
        condition_1 = smallest_eigenvalue(K_A)
        crude = torch.where(condition_1 > 0, size / (K_P.min() * condition_1), torch.inf)
        rest = solve(K_A, delta_all) / K_P
        return StabilityCertificate(
            region=region,
            q=q,
            position_gain=K_P,
            velocity_gain=K_D,
            condition_1=condition_1,
            position_eigenvalue=smallest_eigenvalue(K_A * K_P),
            velocity_eigenvalue=smallest_eigenvalue(K_A * K_D),
            delta_all=size,
            potential_force=torch.linalg.vector_norm(true.G, dim=-1),
            rest_error=torch.linalg.vector_norm(rest, dim=-1),
            rest_error_bound=crude,
            smallest_singular_value_A=torch.linalg.svdvals(A)[..., -1],
            smallest_singular_value_A_L=torch.linalg.svdvals(A_L)[..., -1],
            fitted=factor_bounds(fit_factor(true, learned), true, learned),
            matched=factor_bounds(A_L @ torch.linalg.inv(A), true, learned),
        )


def prepare(
    model: MechanicalSystem, truth: MechanicalSystem, q: Tensor, name: str
) -> tuple[MechanicalSystem, MechanicalSystem, Tensor]:
    """Checked float64 copies of the two systems and of the configurations."""
    require_same_robot(model, truth)
    if truth.num_coordinates != truth.num_inputs:
        raise ValueError(
            f"truth has N = {truth.num_coordinates} coordinates and M = {truth.num_inputs} "
            "inputs: Proposition 1 needs N = M. See check_without_truth for what can be said still"
        )
    q = require_samples(name, q, truth)
    model, truth = double_copy(model, q.device), double_copy(truth, q.device)
    for matrix, system in (("A", truth), ("A_L", model)):
        with torch.no_grad():
            smallest = torch.linalg.svdvals(system.input_matrix(q))[..., -1]
        bad = int(smallest.argmin())
        if not smallest[bad] > 1e-12:
            raise ValueError(
                f"{matrix} is singular at {name}[{bad}] = {q[bad].tolist()}: Proposition 1 needs "
                "A and A_L of full rank. Leave such configurations out"
            )
    return model, truth, q


def require_system(name: str, system: object) -> None:
    """Refuse what is no mechanical system by a TypeError."""
    if not isinstance(system, MechanicalSystem):
        raise TypeError(
            f"{name} is a {type(system).__name__}, expected a MechanicalSystem: only a "
            "mechanical system has the terms M, D, G, A"
        )


def require_same_robot(model: object, truth: object) -> None:
    """Refuse systems of other sizes by a ValueError, and what is none by a TypeError."""
    sizes = []
    for name, system in (("model", model), ("truth", truth)):
        require_system(name, system)
        assert isinstance(system, MechanicalSystem)
        sizes.append((system.num_coordinates, system.num_inputs))
    if sizes[0] != sizes[1]:
        raise ValueError(f"model has (N, M) = {sizes[0]}, truth {sizes[1]}: expected the same")


def require_samples(name: str, q: Tensor, system: MechanicalSystem) -> Tensor:
    """The configurations ``(K, N)`` in float64; a ValueError if they are none."""
    if q.ndim != 2 or q.shape[0] < 1:
        raise ValueError(
            f"{name} has shape {tuple(q.shape)}, expected (K, N) with at least one row"
        )
    require_last_dim(name, q, system.num_coordinates, "N")
    require_finite(name, q)
    return q.double()


def per_configuration(q: Tensor, columns: dict[str, Tensor]) -> pd.DataFrame:
    """A table with one row per configuration: q1 to qN, then the columns, ``(K,)`` each."""
    coordinates = {f"q{i + 1}": value for i, value in enumerate(q.unbind(-1))}
    return pd.DataFrame({k: v.cpu().numpy() for k, v in (coordinates | columns).items()})


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """matrix^-1 vector, batched; not finite where the matrix is singular."""
    return torch.linalg.solve_ex(matrix, vector.unsqueeze(-1))[0].squeeze(-1)


def smallest_eigenvalue(matrix: Tensor) -> Tensor:
    """Smallest eigenvalue of the symmetric part."""
    return torch.linalg.eigvalsh(0.5 * (matrix + matrix.mT))[..., 0]
