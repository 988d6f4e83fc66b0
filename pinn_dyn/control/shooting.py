"""Transcription and solver of the optimal control problem of predictive control."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy
import torch
from torch import Tensor

from pinn_dyn.exports.casadi_function import import_casadi
from pinn_dyn.exports.compiled import Compiled
from pinn_dyn.mechanics import MechanicalSystem

_STEP_SIZES = 0.5 ** np.arange(7)  # steps that the line search tries
_DIFFERENCE = 1e-7  # change of a state or input for a slope, relative to the larger of 1 and it
_CONVERGED = 1e-4  # largest change of a number in the last iteration, relative


class Weights(NamedTuple):
    """Weights: factor E ``(rows, 2N)`` of Q = E^T E, diagonals of R and S ``(M,)``, and rho."""

    state: np.ndarray
    input: np.ndarray
    rate: np.ndarray
    limit: float


class Limits(NamedTuple):
    """Soft limits of the state ``(2N,)``; hard limits of the input and its rate, ``(M,)``."""

    x_low: np.ndarray
    x_high: np.ndarray
    u_low: np.ndarray
    u_high: np.ndarray
    rate: np.ndarray


class Plan(NamedTuple):
    """A plan of S steps: states after each step ``(2N, S)``, and inputs ``(M, S)``.

    ``gap`` is the largest error of the equation of motion, relative to the largest change of the
    state in a step. ``excess`` ``(2N, S)`` is the violation of the state limits.
    """

    x: np.ndarray
    u: np.ndarray
    gap: float
    excess: np.ndarray
    iterations: int


class ShootingProblem:
    """Multiple shooting of a mechanical system with the implicit midpoint rule::

        min  h/2 sum_k (|x_k - x_ref,k|^2_Q + |u_k - u_ref,k|^2_R) + sum_k |u_k - u_k-1|^2_S / (2 h)
             + |x_S - x_ref,S|^2_P / 2 + h rho sum_k (|e_k|_1 + |e_k|^2 / 2)
        q_k+1 = q_k + h (v_k + v_k+1) / 2,   x = (q, v)
        v_k+1 = v_k + h (a((x_k + x_k+1) / 2, u_k) + d)
        x_low - e_k <= x_k <= x_high + e_k,   u_low <= u_k <= u_high,   |u_k - u_k-1| <= h rate

    The rule needs a single acceleration a per step, where RK4 needs four, and is stable for stiff
    systems. The solver is sequential quadratic programming with the Gauss-Newton Hessian and a
    line search on the l1 penalty. PIQP, an interior-point method, solves the quadratic programs.

    Source: Bock and Plitt 1984, A multiple shooting algorithm for direct solution of optimal
    control problems; Diehl et al. 2005, A real-time iteration scheme for nonlinear optimization in
    optimal feedback control; Schwan et al. 2023, PIQP: a proximal interior-point QP solver.

    Args:
        model: the system, in float64.
        step: h, s.
        steps: S.
        weights: weights of the cost.
        limits: limits of the state and the input.
    """

    def __init__(
        self, model: MechanicalSystem, step: float, steps: int, weights: Weights, limits: Limits
    ):
        n, m = model.num_coordinates, model.num_inputs
        self.step, self.steps, self.sizes = step, steps, (n, m)
        self.weights, self.limits = weights, limits
        bounded = (limits.x_low, limits.x_high, limits.rate)
        self._rows = [np.flatnonzero(np.isfinite(x)).tolist() for x in bounded]
        self._transcribe(import_casadi())

        self._model, self._compiled = model, Compiled(model)

    def _dynamics(self, z: Tensor) -> Tensor:
        n, m = self.sizes
        return self._model.forward_dynamics(*z.split([n, n, m], dim=-1))

    def _transcribe(self, ca: Any) -> None:
        (n, m), h, steps = self.sizes, self.step, self.steps
        weights, (lows, highs, rated) = self.weights, self._rows
        X, U = ca.MX.sym("X", 2 * n, steps), ca.MX.sym("U", m, steps)
        excess = ca.MX.sym("excess", 2 * n if lows or highs else 0, steps)
        x0, u0, d = ca.MX.sym("x0", 2 * n), ca.MX.sym("u0", m), ca.MX.sym("d", n)
        x_ref, u_ref = ca.MX.sym("x_ref", 2 * n, steps), ca.MX.sym("u_ref", m, steps)
        P = ca.MX.sym("P", 2 * n, 2 * n)
        w = ca.veccat(X, U, excess)
        arguments = [w, x0, u0, d, x_ref, u_ref, P]

        error, change = X - x_ref, U - ca.horzcat(u0, U[:, :-1])
        R, S = (ca.diag(ca.DM(np.sqrt(x))) for x in weights[1:3])
        Q = ca.sparsify(ca.DM(weights.state))
        cost = (
            h * ca.sumsqr(ca.mtimes(Q, error[:, :-1])) / 2
            + h * ca.sumsqr(ca.mtimes(R, U - u_ref)) / 2
            + ca.sumsqr(ca.mtimes(S, change)) / (2 * h)
            + ca.dot(error[:, -1], ca.mtimes(P, error[:, -1])) / 2
            + h * weights.limit * (ca.sum1(ca.vec(excess)) + ca.sumsqr(excess) / 2)
        )
        before = ca.horzcat(x0, X[:, :-1])
        middle = ca.vertcat((before + X) / 2, U)
        a, slopes = ca.MX.sym("a", n, steps), ca.MX.sym("slopes", n, (2 * n + m) * steps)
        rate = ca.vertcat(middle[n : 2 * n, :], a + ca.repmat(d, 1, steps))
        rows = ca.veccat(
            X - before - h * rate,
            X[lows, :] + excess[lows, :],
            X[highs, :] - excess[highs, :],
            change[rated, :],
        )
        blocks = ca.diagcat(*ca.horzsplit(slopes, 2 * n + m))
        of_states = ca.mtimes(blocks, ca.jacobian(ca.vec(middle), w))
        jacobian = ca.jacobian(rows, w) + ca.mtimes(ca.jacobian(rows, ca.vec(a)), of_states)
        hessian, gradient = ca.hessian(cost, w)
        self._values = ca.Function("values", [*arguments, a], [cost, rows])
        self._slopes = ca.Function("slopes", [*arguments, slopes], [gradient, jacobian])
        self._hessian = ca.Function("hessian", [P], [hessian])
        parts = {"h": hessian.sparsity(), "a": jacobian.sparsity()}
        quiet = {"error_on_fail": False, "print_time": False}
        self._quadratic = ca.conic("quadratic", "piqp", parts, quiet)

    def accelerations(self, z: np.ndarray) -> np.ndarray:
        """Return a ``(..., N)`` at the states and inputs z = (q, v, u), ``(..., 2N + M)``."""
        rows = torch.from_numpy(z)
        with torch.no_grad():
            return self._compiled.rows("forward_dynamics", self._dynamics, rows).numpy()

    def slopes(self, z: np.ndarray) -> np.ndarray:
        """Return da/dz, ``(K, N, 2N + M)``, at K states and inputs, by forward differences.

        For networks, forward differences are faster than exact derivatives.
        """
        moved = z + _DIFFERENCE * np.maximum(1, np.abs(z))
        points = np.where(np.eye(z.shape[-1], dtype=bool), moved[:, None], z[:, None])
        a = self.accelerations(np.concatenate([z[:, None], points], axis=1))
        return ((a[:, 1:] - a[:, :1]) / (moved - z)[..., None]).transpose(0, 2, 1)

    def terminal_weight(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Return P of the linear-quadratic regulator at a state ``(2N,)`` and input ``(M,)``.

        Raises:
            ValueError: if no input stabilizes the linear system.
        """
        (n, _), h = self.sizes, self.step
        slopes = self.slopes(np.concatenate([x, u])[None])[0]
        A = np.vstack([np.eye(n, 2 * n, n), slopes[:, : 2 * n]])
        B = np.vstack([np.zeros_like(slopes[:, 2 * n :]), slopes[:, 2 * n :]])
        left = np.eye(2 * n) - h / 2 * A
        A, B = np.linalg.solve(left, np.eye(2 * n) + h / 2 * A), np.linalg.solve(left, h * B)
        try:
            Q, R = h * self.weights.state.T @ self.weights.state, h * np.diag(self.weights.input)
            return scipy.linalg.solve_discrete_are(A, B, Q, R)
        except np.linalg.LinAlgError as error:
            raise ValueError(
                f"no linear law stabilizes the model at q = {x[:n].round(4).tolist()} ({error}): "
                "set terminal_weight to a number"
            ) from error

    def solve(
        self,
        x0: np.ndarray,
        u0: np.ndarray,
        d: np.ndarray,
        x_ref: np.ndarray,
        u_ref: np.ndarray,
        P: np.ndarray,
        guess: tuple[np.ndarray, np.ndarray],
        *,
        period: float,
        iterations: int,
    ) -> Plan:
        """Return a plan from a state.

        Args:
            x0, u0, d: state ``(2N,)``, previous input ``(M,)``, additional acceleration ``(N,)``.
            x_ref, u_ref: references ``(2N, S)`` and ``(M, S)``.
            P: terminal weight, ``(2N, 2N)``.
            guess: states and inputs of the initial plan.
            period: time since u0 was applied, s.
            iterations: largest number of quadratic programs.

        Raises:
            FloatingPointError: if the state or an acceleration is not finite, or a quadratic
                program has no solution.
        """
        (n, m), steps, limits = self.sizes, self.steps, self.limits
        lows, highs, rated = self._rows
        free = np.full(2 * n * steps, np.inf)
        excess = np.zeros((2 * n if lows or highs else 0, steps))
        low, high = (
            np.concatenate([sign * free, np.tile(u, steps), end + 0 * excess.ravel()])
            for sign, u, end in ((-1, limits.u_low, 0.0), (1, limits.u_high, np.inf))
        )
        change = np.tile(limits.rate[rated] * self.step, steps)
        change[: len(rated)] = limits.rate[rated] * period
        x_low = np.tile(limits.x_low[lows], steps)
        x_high = np.tile(limits.x_high[highs], steps)
        motion = np.zeros(2 * n * steps)
        rows_low = np.concatenate([motion, x_low, np.full(x_high.size, -np.inf), -change])
        rows_high = np.concatenate([motion, np.full(x_low.size, np.inf), x_high, change])

        w = np.concatenate([x.ravel(order="F") for x in (*guess, excess)]).clip(low, high)
        arguments = [x0, u0.clip(limits.u_low, limits.u_high), d, x_ref, u_ref, P]
        H = self._hessian(P)

        def violation(rows: np.ndarray) -> float:
            return float(np.maximum(rows_low - rows, rows - rows_high).clip(min=0).sum())

        def evaluated(w: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            """Return the points z of the accelerations, the cost, and the constraint rows."""
            x, u = w[: free.size].reshape(steps, 2 * n), w[free.size :][: m * steps]
            points = np.hstack([(np.vstack([x0, x[:-1]]) + x) / 2, u.reshape(steps, m)])
            cost, rows = self._values(w, *arguments, self.accelerations(points).T)
            return points, np.array(cost).ravel(), np.array(rows).ravel()

        penalty = 0.0
        points, cost, rows = evaluated(w)
        count = 0
        while count < iterations:
            count += 1
            slopes = np.concatenate(self.slopes(points), axis=-1)
            if not (np.isfinite(rows).all() and np.isfinite(slopes).all()):
                raise FloatingPointError("the state or an acceleration is not finite")
            gradient, jacobian = self._slopes(w, *arguments, slopes)
            solution = self._quadratic(
                h=H,
                g=gradient,
                a=jacobian,
                lbx=low - w,
                ubx=high - w,
                lba=rows_low - rows,
                uba=rows_high - rows,
            )
            change_of_w = np.array(solution["x"]).ravel()
            if not self._quadratic.stats()["success"] or not np.isfinite(change_of_w).all():
                raise FloatingPointError("a quadratic program has no solution")
            penalty = max(penalty, 1.5 * float(np.abs(np.array(solution["lam_a"])).max()))
            merit = float(cost[0]) + penalty * violation(rows)
            expected = float(np.array(gradient).ravel() @ change_of_w) - penalty * violation(rows)
            for size in _STEP_SIZES:
                trial = w + size * change_of_w
                points, cost, rows = evaluated(trial)
                if float(cost[0]) + penalty * violation(rows) <= merit + 1e-4 * size * expected:
                    break
            w = trial
            if np.abs(size * change_of_w).max() <= _CONVERGED * (1 + np.abs(w).max()):
                break
        x, u = w[: free.size].reshape(steps, 2 * n).T, w[free.size : free.size + m * steps]
        moved = np.abs(np.diff(np.column_stack([x0, x]))).max()
        gap = float(np.abs(rows[: free.size]).max() / (moved + 1e-3))
        beyond = np.maximum(limits.x_low[:, None] - x, x - limits.x_high[:, None]).clip(min=0)
        return Plan(x, u.reshape(steps, m).T.copy(), gap, beyond, count)
