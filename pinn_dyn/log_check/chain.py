"""Equation of motion of all joints of a chain, with one set of constants for all of them.

A torque that has the other sign, or the torque of another joint, makes M(q) asymmetric, or the
Coriolis forces unlike M(q). Equations of single joints with constants of their own do not see this.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from pinn_dyn.data.logs import Columns, Measurement
from pinn_dyn.data.logs.measurement import judged
from pinn_dyn.log_check.averages import Averages
from pinn_dyn.log_check.equation import (
    EquationOfMotionRegression,
    Regressor,
    force_columns,
    solve,
    tenths,
)

SIGN = "sign of the input"
"""Name of the measurement that judges the sign of an input."""
EXCHANGED = "residual of the inputs as logged over that with two of them exchanged"
"""Name of the measurement that judges the order of the inputs."""
FRICTION = "power of the friction over that of the forces"
"""Name of the measurement that judges the direction of the time."""
OWN = 7
"""Columns of each joint of its own: offset, spring, rotor, damping, and three of dry friction."""
_LARGEST = 4  # chain of unknown bodies
_ROWS = 1500
_WORSE, _TENTHS = 4.0, 0.8  # residual of a reading over that of another; tenths with more
_EXPLAINS = 0.5  # largest residual of a reading that counts
_NEGATIVE, _POWER = 0.1, 0.2  # shares of positive inertia and of power of reversed inputs
_FORWARDS = 0.01  # power of friction over that of the forces, against the motion
_NOTICEABLE = 0.05  # share of a force from which its inertial part is judged
_UNITS = {"Nm", "N", "A"}  # of inputs that push their joint forward


def chain_regressor(units: Sequence[str]) -> Regressor | None:
    """Return the regressor of a chain of unknown bodies; None for more than four joints.

    The torque is that of a kinetic energy T = ½ vᵀ M(q) v and a potential energy V(q)::

        tau = d/dt (∂T/∂v) - ∂T/∂q + ∂V/∂q

    In sin and cos of the angles, M_ij with i ≤ j is of degree 1 in the joints from i + 1 to j and
    of degree 2 in later ones; V is of degree 1 in each joint. Slides have powers of q instead.

    Args:
        units: units of the coordinates, from the base on.
    """
    if not 0 < len(units) <= _LARGEST or not set(units) <= {"rad", "m"}:
        return None

    def function(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        factors = [_factors(x, unit) for x, unit in zip(q.T, units, strict=True)]
        columns = []
        for i, j in itertools.combinations_with_replacement(range(len(units)), 2):
            degrees = [int(k > i) + int(k > j) for k in range(len(units))]
            values, slopes = _products(factors, degrees)
            rates = np.einsum("rnk,rn->rk", slopes, v)
            column = -slopes * (v[:, i] * v[:, j])[:, None, None]
            column[:, i] += values * a[:, [j]] + rates * v[:, [j]]
            column[:, j] += values * a[:, [i]] + rates * v[:, [i]]
            columns.append(column)
        _, slopes = _products(factors, [1] * len(units))
        return np.concatenate([*columns, slopes[:, :, 1:]], axis=2)

    return function


def _factors(q: np.ndarray, unit: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return functions of a coordinate up to each degree, and their slopes, ``(R, .)``."""
    one, zero = np.ones_like(q), np.zeros_like(q)
    if unit == "rad":
        values = [one, np.cos(q), np.sin(q), np.cos(2 * q), np.sin(2 * q)]
        slopes = [zero, -np.sin(q), np.cos(q), -2 * np.sin(2 * q), 2 * np.cos(2 * q)]
        counts = (1, 3, 5)
    else:
        values, slopes, counts = [one, q, q**2], [zero, one, 2 * q], (1, 2, 3)
    return [(np.stack(values[:n], axis=1), np.stack(slopes[:n], axis=1)) for n in counts]


def _products(
    factors: Sequence[list[tuple[np.ndarray, np.ndarray]]], degrees: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return all products of functions of coordinates ``(R, K)``, and slopes ``(R, N, K)``."""
    rows = len(factors[0][0][0])
    values, slopes = np.ones((rows, 1)), np.zeros((rows, len(factors), 1))
    for k, (choices, degree) in enumerate(zip(factors, degrees, strict=True)):
        value, slope = choices[degree]
        products = np.einsum("rnk,rm->rnkm", slopes, value)
        products[:, k] += np.einsum("rk,rm->rkm", values, slope)
        slopes = products.reshape(rows, len(factors), -1)
        values = np.einsum("rk,rm->rkm", values, value).reshape(rows, -1)
    return values, slopes


def chain_columns(data: Averages, regressor: Regressor) -> np.ndarray:
    """Return the columns of a chain and of its drives, ``(R, N, P)``; the last are of one joint."""
    n = data.q.shape[1]
    own = np.zeros((len(data), n, n, OWN))
    for k in range(n):
        parts = [np.ones(len(data)), data.q[:, k], data.a[:, k], data.v[:, k], data.sign[:, k]]
        parts += [data.slow_sign[:, k], data.slow_sign[:, n + k]]
        own[:, k, k] = np.column_stack(parts)
    bodies = regressor(data.q, data.v, data.a)
    return np.concatenate([bodies, own.reshape(len(data), n, -1)], axis=2)


class Readings:
    """Ways to read the inputs of a log, and their residuals in one equation of all joints.

    A reading says which joint each input drives, and the sign of each input up to a sign of all of
    them. With an input per joint, two inputs may be exchanged. The columns of the equation do not
    depend on the reading: one regression serves all.

    Args:
        data: averages.
        regressor: regressor of the bodies.
        forces: the inputs are forces; the gains of others are those that fit best.

    Attributes:
        joints, signs: of each input, ``(H, M)``; the first reading is the log.
        x, y: columns ``(R, N, P)`` and left sides of each reading, ``(R, N, H)``.
        left: unexplained share of each reading on held-out data, by tenth, ``(B, H)``.
        theta: coefficients, ``(P, H)``.
        residual: y - x theta, ``(R, N, H)``.
    """

    def __init__(self, data: Averages, regressor: Regressor, *, forces: bool):
        self.data, self.regressor = data.thinned(_ROWS), regressor
        n, inputs = data.q.shape[1], data.u.shape[1]
        self.joints, self.signs = _readings(n, inputs)
        u = self.data.u - self.data.u.mean(axis=0)
        size = u.std(axis=0).clip(min=1e-300)
        weights = np.full(n, 1 / size.mean())
        if inputs == n:
            weights = 1 / size
        mask = self.data.moving * weights
        self.x = chain_columns(self.data, regressor)
        columns = (self.x * mask[:, :, None]).reshape(-1, self.x.shape[2])
        if not forces and inputs == n:
            u = u * _gains(columns, u, mask)
        self.y = np.zeros((len(u), n, len(self.joints)))
        for h, (joints, signs) in enumerate(zip(self.joints, self.signs, strict=True)):
            self.y[:, joints, h] = u * signs
        y = (self.y * mask[:, :, None]).reshape(-1, len(self.joints))
        block = np.repeat(tenths(self.data), n)
        fit = EquationOfMotionRegression({"x": columns, "y": y}, block).fit("y", ["x"])
        size = np.bincount(block)[:, None] * (y**2).mean(axis=0).clip(min=1e-300)
        self.left, self.theta = fit.held_out / size, fit.theta[0]
        self.residual = self.y - self.x @ self.theta

    def likely(self) -> np.ndarray:
        """Return the numbers of the readings whose residual is close to the smallest.

        A reading is unlikely if its mean residual is four times the smallest and it is larger in
        most tenths, or if it explains less than half of the inputs and another reading more.
        """
        means = self.left.mean(axis=0)
        wins = (self.left > self.left[:, [means.argmin()]]).mean(axis=0)
        far = (means > _WORSE * means.min()) & (wins >= _TENTHS)
        far |= (means > _EXPLAINS) & (means.min() < _EXPLAINS)
        return np.flatnonzero(~far)

    @cached_property
    def inertial(self) -> np.ndarray:
        """Columns of the diagonal of M(q), ``(R, N, P)``."""
        units = enumerate(np.eye(self.x.shape[1]))
        pushed = [(k, replace(self.data, a=self.data.a + unit)) for k, unit in units]
        columns = [chain_columns(data, self.regressor)[:, k] for k, data in pushed]
        return np.stack(columns, axis=1) - self.x

    def direction(self, h: int) -> float:
        """Return the sign of M(q) for a reading, see :func:`_direction`."""
        y, inertia = self.y[:, :, h], self.inertial @ self.theta[:, h]
        left = self.residual[:, :, h] * self.data.moving
        return _direction(inertia, self.data.a, y, left, y * self.data.v)

    def dissipated(self, h: int) -> np.ndarray:
        """Return the power of the friction of each joint over that of its force, ``(N,)``."""
        n, v = self.data.q.shape[1], self.data.v
        columns = np.arange(self.x.shape[2])[-OWN * n :].reshape(n, OWN)[:, 3:].ravel()
        friction = self.x[:, :, columns] @ self.theta[columns, h]
        force = np.abs(self.y[:, :, h] * v).mean(axis=0).clip(min=1e-300)
        return np.asarray((friction * v).mean(axis=0) / force)


def _readings(joints: int, inputs: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the joints and the signs of the inputs of all readings, ``(H, M)`` each."""
    plain = np.arange(joints)
    if inputs < joints:
        orders = [np.array(x) for x in itertools.permutations(plain, inputs)]
        exchanged: list[np.ndarray] = []
    else:
        orders, exchanged = [plain], []
        for i, j in itertools.combinations(plain, 2):
            order = plain.copy()
            order[[i, j]] = order[[j, i]]
            exchanged.append(order)
    signs = [np.array((1.0, *x)) for x in itertools.product((1.0, -1.0), repeat=inputs - 1)]
    pairs = list(itertools.product(orders, signs)) + [(x, signs[0]) for x in exchanged]
    return np.array([x for x, _ in pairs]), np.array([x for _, x in pairs])


def _gains(columns: np.ndarray, u: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the sizes of the gains of the inputs with the smallest residual, ``(M,)``."""
    y = ((u * mask)[:, :, None] * np.eye(u.shape[1])).reshape(-1, u.shape[1])
    left = y - columns @ solve(columns, y)
    size = np.linalg.norm(y, axis=0).clip(min=1e-300)
    _, vectors = np.linalg.eigh(left.T @ left / np.outer(size, size))
    return np.abs(vectors[:, 0]).clip(min=1e-3) / size


class Order(NamedTuple):
    """Joint and sign of each input.

    Attributes:
        measurements: measurements.
        joints: joint that each input drives.
        signs: factor 1 or -1 of each input.
    """

    measurements: list[Measurement]
    joints: Sequence[int]
    signs: np.ndarray

    def corrected(self, data: Averages) -> Averages:
        """Return averages with the inputs of the joints in turn, and their signs."""
        order = np.argsort(self.joints)
        factors = self.signs[order]
        inputs = {k: (t, u[:, order] * factors) for k, (t, u) in data.inputs.items()}
        return replace(data, u=data.u[:, order] * factors, inputs=inputs)


def _direction(
    inertia: np.ndarray, a: np.ndarray, y: np.ndarray, left: np.ndarray, power: np.ndarray
) -> float:
    """Return the sign of the inertia where it is clear, -1 if the inputs give no power; 0 if mixed.

    Args:
        inertia: inertias that an equation y = inertia a + ... of each joint has, ``(R, N)``.
        a: accelerations, ``(R, N)``.
        y, left: inputs, and their residuals, ``(R, N)``.
        power: powers of the inputs, ``(R, N)``.
    """
    smallest = np.maximum(2 * left.std(axis=0), _NOTICEABLE * y.std(axis=0))
    clear = (inertia * a).std(axis=0) > smallest
    positive = (inertia > 0).mean(axis=0)[clear]
    if (positive > _NEGATIVE).all():
        return 1.0
    low = power.sum() < _POWER * np.abs(power).sum()
    return -1.0 if low and (positive < _NEGATIVE).all() else 0.0


def single_signs(data: Averages, u: Columns) -> Order:
    """Look for reversed inputs by the equation of each joint, whose inertia is positive."""
    data, results = data.thinned(_ROWS), []
    for k, name in enumerate(u.columns):
        x = np.hstack([*force_columns(data, k, None).values()])
        mask = data.row_weights() * data.moving[:, [k]]
        y, power = (data.u - np.median(data.u, axis=0))[:, [k]] * mask, (data.u * data.v)[:, [k]]
        theta = solve(x * mask, y)
        pushed = replace(data, a=data.a + np.eye(data.q.shape[1])[k])
        inertia = (np.hstack([*force_columns(pushed, k, None).values()]) - x) @ theta
        left = y - x * mask @ theta
        sign = _direction(inertia, data.a[:, [k]], y, left, power * mask)
        measurement = judged(
            name=SIGN,
            place=name,
            value=sign,
            expected="1",
            bad=sign < 0,
            text=f"input {name!r} seems to push joint {k + 1} backwards: its effective inertia is "
            f"negative, and its mean power {power.mean():.3g} W: is it reversed?",
        )
        results.append(measurement)
    signs = np.array([-1.0 if x.verdict != "ok" else 1.0 for x in results])
    return Order(results, list(range(len(signs))), signs)


def check_order(widths: Sequence[Averages], u: Columns, units: Sequence[str]) -> Order | None:
    """Look for reversed and exchanged inputs by an equation of all joints, with two kernels.

    The sign of all inputs together is that of M(q), which is positive definite, where the inputs
    give little or negative power.

    Args:
        widths: averages with kernels of two widths, and inputs as they act.
        u: columns of the inputs.
        units: units of the coordinates.

    Returns:
        None for more inputs than joints, and inputs that are no forces. With more than four joints,
        the signs are those of :func:`single_signs`.
    """
    regressor, count = chain_regressor(units), len(u.columns)
    if not 0 < count <= len(units) or not set(u.units) <= _UNITS:
        return None
    if regressor is None:
        return single_signs(widths[0], u) if count == len(units) else None
    forces, square = set(u.units) <= {"Nm", "N"}, count == len(units)
    readings, again = (Readings(data, regressor, forces=forces) for data in widths)
    likely = np.union1d(readings.likely(), again.likely())
    directions = np.array([readings.direction(h) for h in likely])
    if square and likely[0] == 0 and directions[0] > 0:
        likely, directions = likely[:1], directions[:1]
    likely, directions = likely[directions != 0], directions[directions != 0]
    chosen = joints, signs = readings.joints[0], readings.signs[0]
    left = float(readings.left[:, 0].mean())
    if len(likely):
        best = readings.left[:, likely].mean(axis=0).argmin()
        joints = readings.joints[likely[best]]
        all_signs = readings.signs[likely] * directions[:, None]
        agreed = (all_signs == all_signs[best]).all(axis=0)
        signs = np.where(agreed, all_signs[best], 1.0)
        left = float(readings.left[:, likely[best]].mean())
    if square and (left > _EXPLAINS or (readings.joints[likely] != joints).any()):
        joints, signs = chosen
    h, way = (likely[best], directions[best]) if len(likely) else (0, 1.0)
    power = np.max([way * x.dissipated(h) for x in (readings, again)], axis=0)
    results = [_sign(*x) for x in zip(u.columns, joints.tolist(), signs.tolist(), strict=True)]
    if square:
        results.append(_exchange(u, joints, readings.left[:, 0].mean() / max(left, 1e-300)))
    results.append(_friction(power.max(), left < _EXPLAINS and bool((power < -_FORWARDS).all())))
    return Order(results, joints.tolist(), signs)


def _sign(name: str, joint: int, sign: float) -> Measurement:
    return judged(
        name=SIGN,
        place=name,
        value=sign,
        expected="1",
        bad=sign < 0,
        text=f"input {name!r} seems to push joint {joint + 1} backwards: with the other sign M(q) "
        "is positive, and the equations of all joints agree: is it reversed?",
    )


def _exchange(u: Columns, joints: np.ndarray, ratio: float) -> Measurement:
    names = [repr(name) for k, name in enumerate(u.columns) if joints[k] != k]
    return judged(
        name=EXCHANGED,
        place="inputs",
        value=ratio,
        expected=f"below {_WORSE:g}",
        bad=len(names) > 0,
        text=f"the inputs {' and '.join(names)} are exchanged: then the equations of all joints "
        "agree; correct the order of the columns",
    )


def _friction(power: float, bad: bool) -> Measurement:
    return judged(
        name=FRICTION,
        place="all joints",
        value=power,
        expected="above 0",
        bad=bad,
        text="the friction of all joints pushes forwards: does the time of the log run backwards, "
        "or is more than the friction compensated in the inputs?",
    )
