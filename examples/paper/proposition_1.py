"""Proposition 1 of the paper in numbers: its conditions, its deltas and the error they allow.

Plant and law, paper eqs. (armdynamics) and (controller_PD), with N = M, and their closed loop::

    M(q) dv/dt + C(q, v) v + G(q) + D(q) v = A(q) u
    u = A_L^-1 G_L + A_L^T (K_P (q_ref - q) - K_D v)
    M dv/dt + C v + (D + Khat_D) v = Delta_all + Khat_P (q_ref - q)
    Delta_all = A A_L^-1 G_L - G,     Khat_P = A A_L^T K_P,     Khat_D = A A_L^T K_D

The arm rests where q - q_ref = h(q) = Khat_P^-1 Delta_all. docs/stability.md derives the numbers.

    python examples/paper/proposition_1.py RUN    a run of experiment=soft_arm_2
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

import pinn_dyn
from pinn_dyn.control import RandomSetPoints, Regulation
from pinn_dyn.control.laws import Gain, diagonal_gain
from pinn_dyn.evaluation import close_loops
from pinn_dyn.evaluation.learned_terms import fit_factor
from pinn_dyn.mechanics import MechanicalSystem, Terms, double_copy
from pinn_dyn.mechanics.arrays import matvec, require_last_dim

_DIFFERENCE = 1e-4  # step of the central differences, in the units of q
_SPHERE_POINTS = 16  # points on the sphere around a set point at which dh/dq is evaluated
_MARGIN = 2.0  # factor of the change of dh/dq over the sphere, for the points in between
_SLACK = 1.05  # radius of the ball over the bound


MEASUREMENT_TOLERANCE = 1e-6
"""Excess of a measured error over its bound that does not count: simulations end early."""


def certify(
    model: MechanicalSystem,
    truth: MechanicalSystem,
    q: Tensor,
    position_gain: Gain,
    velocity_gain: Gain,
) -> pd.DataFrame:
    """Evaluate Proposition 1 at configurations q ``(K, N)``, one row each.

    Args:
        model: the learned system.
        truth: the true system, with the same N = M.
        q: configurations, ``(K, N)``.
        position_gain, velocity_gain: diagonals of K_P and K_D, one number or N.

    Returns:
        The columns ``q1`` to ``qN``, those of :func:`factor_bounds` with the P of
        :func:`fit_factor`, and

        - ``condition_1``: smallest eigenvalue of the symmetric part of A A_L^T, eq. (PD_transpose),
          which must be positive;
        - ``position_eigenvalue``, ``velocity_eigenvalue``: the same of Khat_P and Khat_D;
        - ``delta_all``: |A A_L^-1 G_L - G|, to compare with ``potential_force``, |G|;
        - ``rest_error``: |Khat_P^-1 Delta_all|, the distance from q_ref of an arm that rests at q.

    Raises:
        ValueError: on sizes that do not match, or N != M.
    """
    model, truth, q = float64_pair(model, truth, q)
    K_P = diagonal_gain("position_gain", position_gain, q.shape[-1]).to(q)
    K_D = diagonal_gain("velocity_gain", velocity_gain, q.shape[-1]).to(q)
    with torch.no_grad():
        true, learned = truth.terms(q), model.terms(q)
        K_A = true.A @ learned.A.mT
        delta_all = matvec(true.A, solve(learned.A, learned.G)) - true.G
        columns = {
            "condition_1": smallest_eigenvalue(K_A),
            "position_eigenvalue": smallest_eigenvalue(K_A * K_P),
            "velocity_eigenvalue": smallest_eigenvalue(K_A * K_D),
            "delta_all": torch.linalg.vector_norm(delta_all, dim=-1),
            "potential_force": torch.linalg.vector_norm(true.G, dim=-1),
            "rest_error": torch.linalg.vector_norm(solve(K_A, delta_all) / K_P, dim=-1),
            **factor_bounds(fit_factor(true, learned), true, learned),
        }
    return per_configuration(q, columns)


def factor_bounds(P: Tensor, true: Terms, learned: Terms) -> dict[str, Tensor]:
    """Return the deltas of Proposition 1 for a factor P ``(K, N, N)``, with N = M.

    With Delta_A = A_L - P A, Delta_G = G_L - P G, Delta_I = A_L^-1 - X and X = (P A)^-1, the
    spectral norms, ``(K,)`` each:

    - ``condition_2``: |X Delta_A|, which must be below 1, eq. (smallenss_A_2);
    - ``delta_A``, ``delta_G``, ``delta_I``: |Delta_A|, |Delta_G|, |Delta_I|;
    - ``delta_I_bound``: |X Delta_A X| / (1 - |X Delta_A|), infinite where condition 2 fails;
    - ``delta_all_bound``: |P^-1| delta_G + |A| delta_I_bound (|P G| + delta_G).
    """
    PA, PG = P @ true.A, matvec(P, true.G)
    X = torch.linalg.inv(PA)
    delta_A = learned.A - PA
    delta_G = torch.linalg.vector_norm(learned.G - PG, dim=-1)
    condition_2 = _norm(X @ delta_A)
    neumann = _norm(X @ delta_A @ X) / (1 - condition_2)
    delta_I = torch.where(condition_2 < 1, neumann, torch.inf)
    size = torch.linalg.vector_norm(PG, dim=-1) + delta_G
    return {
        "condition_2": condition_2,
        "delta_A": _norm(delta_A),
        "delta_G": delta_G,
        "delta_I": _norm(torch.linalg.inv(learned.A) - X),
        "delta_I_bound": delta_I,
        "delta_all_bound": _norm(torch.linalg.inv(P)) * delta_G + _norm(true.A) * delta_I * size,
    }


def float64_pair(
    model: MechanicalSystem, truth: MechanicalSystem, q: Tensor
) -> tuple[MechanicalSystem, MechanicalSystem, Tensor]:
    """Return float64 copies of two systems and of configurations, after checking them."""
    sizes = [(system.num_coordinates, system.num_inputs) for system in (model, truth)]
    if sizes[0] != sizes[1]:
        raise ValueError(f"model has (N, M) = {sizes[0]}, truth {sizes[1]}: expected the same")
    require_last_dim("q", q, truth.num_coordinates, "N")
    if truth.num_coordinates != truth.num_inputs:
        raise ValueError(f"Proposition 1 needs N = M inputs, the robot has M = {truth.num_inputs}")
    if not (model.input_affine and truth.input_affine):
        raise ValueError("Proposition 1 needs a force A(q) u, linear in the input: stability=null")
    return double_copy(model, q.device), double_copy(truth, q.device), q.double()


def per_configuration(q: Tensor, columns: dict[str, Tensor]) -> pd.DataFrame:
    """Return a table with one row per configuration: q1 to qN, then the columns, ``(K,)`` each."""
    coordinates = {f"q{i + 1}": value for i, value in enumerate(q.unbind(-1))}
    return pd.DataFrame({k: v.cpu().numpy() for k, v in (coordinates | columns).items()})


def solve(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return matrix^-1 vector, batched; not finite where the matrix is singular."""
    return torch.linalg.solve_ex(matrix, vector.unsqueeze(-1))[0].squeeze(-1)


def smallest_eigenvalue(matrix: Tensor) -> Tensor:
    """Return the smallest eigenvalue of the symmetric part."""
    return torch.linalg.eigvalsh(0.5 * (matrix + matrix.mT))[..., 0]


def _norm(matrix: Tensor) -> Tensor:
    return torch.linalg.matrix_norm(matrix, 2)


def predict_steady_state(
    model: MechanicalSystem,
    truth: MechanicalSystem,
    q_ref: Tensor,
    position_gain: Gain,
    velocity_gain: Gain,
) -> pd.DataFrame:
    """Predict the steady states of the true arm under the learned regulator, a row per set point.

    If |dh/dq| <= L < 1 in a ball around q_ref of radius |h(q_ref)| / (1 - L) or more, the map
    q -> q_ref + h(q) has exactly one fixed point q_ss there, and it lies within that radius. L is
    the slope at q_ref plus twice the largest change of the slope at 16 points of the sphere around
    it. The poles are those of M x'' + (D + Khat_D) x' + Khat_P (I - dh/dq) x = 0 at q_ss.

    Args:
        model: the learned system.
        truth: the true system, with the same N = M.
        q_ref: set points, ``(K, N)``.
        position_gain, velocity_gain: diagonals of K_P and K_D, one number or N.

    Returns:
        The columns ``q1`` to ``qN`` of q_ref, ``rest1`` to ``restN`` of q_ss (NaN where Newton's
        method does not converge), and

        - ``slope``: L;
        - ``bound``: |h(q_ref)| / (1 - L), infinite where no ball with L < 1 is large enough;
        - ``error``: |q_ss - q_ref|, a prediction and no bound;
        - ``condition_1``: smallest eigenvalue of the symmetric part of A A_L^T over the ball;
        - ``slowest_pole``: largest real part of the poles, 1/s, negative where stable;
        - ``fastest_pole``: largest absolute value of the poles, 1/s;
        - ``holds``: true where the bound is finite, condition 1 holds, and the loop is stable.
    """
    model, truth, q_ref = float64_pair(model, truth, q_ref)
    K_P = diagonal_gain("position_gain", position_gain, q_ref.shape[-1]).to(q_ref)
    K_D = diagonal_gain("velocity_gain", velocity_gain, q_ref.shape[-1]).to(q_ref)

    def h(q: Tensor) -> Tensor:
        return _input_error(model, truth, q) / K_P

    with torch.no_grad():
        bound, slope, radius = _contraction(h, q_ref)
        ball = torch.cat([q_ref.unsqueeze(0), q_ref + _sphere(q_ref) * radius[:, None]])
        K_A = truth.input_matrix(ball) @ model.input_matrix(ball).mT
        condition_1 = smallest_eigenvalue(K_A).amin(0)
        q_ss = _equilibrium(h, q_ref)
        poles = _poles(model, truth, q_ss, _jacobian(h, q_ss), K_P, K_D)
    slowest = poles.real.amax(-1)
    columns = {f"rest{i + 1}": value for i, value in enumerate(q_ss.unbind(-1))} | {
        "slope": slope,
        "bound": bound,
        "error": torch.linalg.vector_norm(q_ss - q_ref, dim=-1),
        "condition_1": condition_1,
        "slowest_pole": slowest,
        "fastest_pole": poles.abs().amax(-1),
        "holds": bound.isfinite() & (condition_1 > 0) & (slowest < 0),
    }
    return per_configuration(q_ref, columns)


def required_gain(
    model: MechanicalSystem, truth: MechanicalSystem, q_ref: Tensor, *, error: float
) -> Tensor:
    """Return the smallest scalar K_P with a bound of at most ``error``, ``(K,)``::

        kappa = L_w + |w(q_ref)| / error,     w(q) = K_P h(q) = (A A_L^T)^-1 Delta_all

    with L_w the largest |dw/dq| over the ball of radius 1.05 ``error`` around q_ref.
    """
    model, truth, q_ref = float64_pair(model, truth, q_ref)
    w = partial(_input_error, model, truth)
    with torch.no_grad():
        radius = torch.full_like(q_ref[:, 0], _SLACK * error)
        slope = _largest_slope(w, _jacobian(w, q_ref), q_ref, radius)
        return slope + torch.linalg.vector_norm(w(q_ref), dim=-1) / error


def _input_error(model: MechanicalSystem, truth: MechanicalSystem, q: Tensor) -> Tensor:
    """Return w(q) = (A A_L^T)^-1 Delta_all = A_L^-T (A_L^-1 G_L - A^-1 G), ``(*batch, N)``."""
    A, A_L = truth.input_matrix(q), model.input_matrix(q)
    held = solve(A_L, model.potential_force(q)) - solve(A, truth.potential_force(q))
    return solve(A_L.mT, held)


def _contraction(h: Callable[[Tensor], Tensor], q_ref: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the bound |h(q_ref)| / (1 - L), L, and the radius of the ball of L."""
    start = torch.linalg.vector_norm(h(q_ref), dim=-1)
    centre = _jacobian(h, q_ref)
    radius = _SLACK * start
    for _ in range(20):
        slope = _largest_slope(h, centre, q_ref, radius)
        bound = torch.where(slope < 1, start / (1 - slope), torch.inf)
        too_small = (bound > radius) & torch.isfinite(bound)
        if not bool(too_small.any()):
            break
        radius = torch.where(too_small, _SLACK * bound, radius)
    return torch.where(too_small, torch.inf, bound), slope, radius


def _largest_slope(
    h: Callable[[Tensor], Tensor], centre: Tensor, q: Tensor, radius: Tensor
) -> Tensor:
    """Estimate the largest |dh/dq| over balls around q from dh/dq at their centers."""
    change = torch.zeros_like(radius)
    for point in _sphere(q):
        jacobian = _jacobian(h, q + point * radius[:, None])
        change = torch.maximum(change, _spectral_norm(jacobian - centre))
    return _spectral_norm(centre) + _MARGIN * change


def _sphere(q: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(_SPHERE_POINTS, 1, q.shape[-1], generator=generator, dtype=q.dtype)
    return (points / torch.linalg.vector_norm(points, dim=-1, keepdim=True)).to(q.device)


def _equilibrium(h: Callable[[Tensor], Tensor], q_ref: Tensor) -> Tensor:
    """Solve q = q_ref + h(q) by Newton's method from q_ref; NaN where it does not converge."""
    q, eye = q_ref, torch.eye(q_ref.shape[-1], dtype=q_ref.dtype, device=q_ref.device)
    for _ in range(30):
        step = solve(eye - _jacobian(h, q), q - q_ref - h(q))
        q = q - step
        if bool((step.abs().amax(-1) < 1e-13).all()):
            break
    converged = torch.linalg.vector_norm(q - q_ref - h(q), dim=-1) < 1e-9
    return torch.where(converged[:, None], q, torch.nan)


def _poles(
    model: MechanicalSystem, truth: MechanicalSystem, q: Tensor, slope: Tensor, *gains: Tensor
) -> Tensor:
    finite = torch.isfinite(q).all(-1)
    terms, zero = truth.terms(q.nan_to_num()), torch.zeros_like(slope)
    K_P, K_D = (terms.A @ model.input_matrix(q.nan_to_num()).mT * gain for gain in gains)
    eye = torch.eye(q.shape[-1]).to(slope)
    stiffness = K_P @ (eye - slope.nan_to_num())
    lower = -torch.linalg.solve(terms.M, torch.cat([stiffness, terms.D + K_D], -1))
    upper = torch.cat([zero, eye.expand_as(zero)], -1)
    poles = torch.linalg.eigvals(torch.cat([upper, lower], -2))
    return torch.where(finite[:, None], poles, torch.nan)


def _jacobian(function: Callable[[Tensor], Tensor], q: Tensor) -> Tensor:
    steps = _DIFFERENCE * torch.eye(q.shape[-1], dtype=q.dtype, device=q.device)
    ahead, behind = function(q.unsqueeze(-2) + steps), function(q.unsqueeze(-2) - steps)
    return (ahead - behind).mT / (2 * _DIFFERENCE)


def _spectral_norm(matrix: Tensor) -> Tensor:
    finite = torch.isfinite(matrix).all(-1).all(-1)
    return torch.where(finite, torch.linalg.matrix_norm(matrix.nan_to_num(), 2), torch.inf)


def stability_report(
    title: str,
    conditions: pd.DataFrame,
    steady_states: pd.DataFrame | None = None,
    measured: Tensor | None = None,
    required_gains: Mapping[float, Tensor] | None = None,
) -> str:
    """Return Proposition 1 for one model in Markdown.

    Args:
        title: heading, which names the region and the gains.
        conditions: table of :func:`certify`.
        steady_states: table of :func:`predict_steady_state`.
        measured: |q - q_ref| at the end of the measured runs, ``(K,)``, NaN for a stopped run.
        required_gains: steady-state error and the K_P that each set point needs for it.
    """
    rows = []
    for name, key, good in (
        ("condition 1, eigenvalue of A A_L^T", "condition_1", conditions["condition_1"] > 0),
        ("eigenvalue of A A_L^T K_P", "position_eigenvalue", conditions["position_eigenvalue"] > 0),
        ("eigenvalue of A A_L^T K_D", "velocity_eigenvalue", conditions["velocity_eigenvalue"] > 0),
        ("condition 2, ‖A^-1 P^-1 (A_L - P A)‖", "condition_2", conditions["condition_2"] < 1),
        ("‖Delta_all‖ = ‖A A_L^-1 G_L - G‖", "delta_all", None),
        ("bound on ‖Delta_all‖ by P", "delta_all_bound", None),
        ("‖G‖, for comparison", "potential_force", None),
        ("distance from the set point at rest", "rest_error", None),
    ):
        worst = conditions[key].min() if "eigenvalue" in name else conditions[key].max()
        rows.append([name, conditions[key].median(), worst, "-" if good is None else _share(good)])
    coordinates = [name for name in conditions if name[:1] == "q"]
    farthest = conditions.nlargest(3, "rest_error")[[*coordinates, "rest_error"]]
    sections = [
        f"# {title}",
        f"Proposition 1 of the paper at {len(conditions)} configurations, and not between them. "
        "docs/stability.md explains the numbers. The eigenvalues must be positive, condition 2 "
        "below 1. P fits M, D, G and A together; with P = A_L A^-1, condition 2 is 0 everywhere.",
        _table(["", "median", "worst", "holds at"], rows),
        "Configurations with the largest `rest_error`, the distance from the set point at rest:",
        _table(list(farthest), farthest.to_numpy().tolist()),
    ]
    if steady_states is not None:
        sections += _steady_states(steady_states, measured)
    if required_gains:
        gains = [[error, k.median(), k.max()] for error, k in required_gains.items()]
        sections += [
            "## Gain for a desired steady-state error",
            "The smallest scalar K_P for which the bound is no larger, the κ of Proposition 1.",
            _table(["error", "K_P, median set point", "K_P, all set points"], gains),
        ]
    sections += [
        "## Limits of this report",
        "- L carries a margin, not a proof. The bound holds near the set point; the report does "
        "not show that the arm gets there from far away.\n"
        "- The law is in continuous time, without delay, noise or limits of the input, and the "
        "plant has no dry friction.",
    ]
    return "\n\n".join(sections) + "\n"


def _steady_states(table: pd.DataFrame, measured: Tensor | None) -> list[str]:
    error = pd.Series(torch.nan if measured is None else measured.numpy(), table.index)
    held = table.assign(measured=error)[table["holds"]]
    above = held["measured"] > held["bound"] + MEASUREMENT_TOLERANCE
    rows = [
        ["conditions hold", _share(table["holds"])],
        ["measured above the bound", f"{int(above.sum())} of {held['measured'].count()}"],
        ["slowest pole, 1/s", table["slowest_pole"].max()],
        ["control step below, s", 2 / table["fastest_pole"].max()],
    ]
    for name in ("bound", "error", "measured") if len(held) else ():
        text = f"{held[name].median():.3g} / {held[name].max():.3g}"
        rows.append([f"{name}, median / largest", text])
    return [
        "## Steady-state error",
        "‖q - q_ref‖ of the set points where the conditions hold: L < 1 and condition 1 in a ball "
        "around the set point, and all poles of the linearized loop on the left. A sampled "
        "controller needs at least a step below 2 / |fastest pole|. A run must last several times "
        "1 / |slowest pole| to reach its steady state.",
        _table(["", "value"], rows),
    ]


def _share(good: Tensor | pd.Series) -> str:
    return f"{int(good.sum())} of {len(good)}"


def _table(header: list[str], rows: list[list[Any]]) -> str:
    text = [[x if isinstance(x, str) else f"{float(x):.3g}" for x in row] for row in rows]
    lines = [header, ["---"] * len(header), *text]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def main() -> None:
    """Write the report for set points in a box with most of the training data."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", help="folder of a run whose robot is simulated")
    parser.add_argument("--count", type=int, default=120, help="number of set points")
    parser.add_argument("--samples", type=int, default=500, help="states of the conditions")
    parser.add_argument("--gains", type=float, nargs=2, default=[200.0, 20.0], help="K_P and K_D")
    box = "end of the box, the default has 80 percent of the data in each coordinate"
    parser.add_argument("--q-low", type=float, nargs="+", help=f"lower {box}")
    parser.add_argument("--q-high", type=float, nargs="+", help=f"upper {box}")
    parser.add_argument("--rate", type=float, default=20_000.0, help="rate of the loops, 1/s")
    parser.add_argument("--duration", type=float, default=2.0, help="length of the loops, s")
    parser.add_argument("--folder", type=Path, default=Path("stability"))
    args = parser.parse_args()

    run = pinn_dyn.load(args.run)
    learned, robot = double_copy(run.system), double_copy(run.source.system)
    q = torch.cat([motion.q for motion in run.source.load().train]).double()
    usual = [torch.from_numpy(np.quantile(q, level, axis=0)).tolist() for level in (0.1, 0.9)]
    box = args.q_low or usual[0], args.q_high or usual[1]
    reference, starts, region = (
        RandomSetPoints(*box, count, seed)
        for count, seed in ((args.count, 0), (args.count, 1), (args.samples, 2))
    )
    law = Regulation(learned, *args.gains)
    result = close_loops(
        {"learned": law},
        reference,
        robot,
        q0=starts.q,
        v0=0 * starts.q,
        duration=args.duration,
        rate=args.rate,
        samples_rate=200.0,
        progress=True,
    )
    record = result.records["learned"]
    conditions = certify(learned, robot, region.q, *args.gains)
    predicted = predict_steady_state(learned, robot, reference.q, *args.gains)
    measured = torch.linalg.vector_norm(record.q[:, -1] - reference.q, dim=-1)
    required = {
        error: required_gain(learned, robot, reference.q, error=error)
        for error in (1e-2, 1e-3, 1e-4)
    }
    title = f"Stability of the regulator, K_P = {args.gains[0]:g}, K_D = {args.gains[1]:g}"
    args.folder.mkdir(parents=True, exist_ok=True)
    conditions.to_csv(args.folder / "stability_region.csv", index=False)
    table = predicted.assign(measured_error=measured.numpy())
    table.to_csv(args.folder / "stability_set_points.csv", index=False)
    text = stability_report(title, conditions, predicted, measured, required)
    (args.folder / "stability.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
