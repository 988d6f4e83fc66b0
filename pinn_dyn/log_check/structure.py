"""Comparison of a URDF with a log: does the rigid-body equation explain the torques?"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
import torch

from pinn_dyn import wording
from pinn_dyn.data.logs import Columns, Measurement
from pinn_dyn.data.logs.measurement import judged
from pinn_dyn.log_check.averages import Averages
from pinn_dyn.log_check.delay import FEWEST
from pinn_dyn.log_check.equation import (
    EquationOfMotionRegression,
    Regressor,
    force_columns,
    tenths,
    unexplained,
)
from pinn_dyn.models.structure import Structure
from pinn_dyn.systems import RigidChain

SECTION = "docs/known_mechanics.md#does-the-urdf-fit-the-log"
FIT = "residual of the URDF over that of a generic equation"
"""Name of the measurement of the fit of a URDF."""
SCALE = "torque over that of the URDF's bodies"
"""Name of the measurement of the scale of an input; NaN where it is not clear."""
_WORSE = 4.0  # mean square over that of a generic equation
_TENTHS = 8  # of the data in which the URDF leaves more
_EXPLAINS = 0.3  # unexplained share with a cause over that without, at most
_TIE = 1.1  # unexplained share over that of the best cause, up to which both are named
_UNKNOWN = (
    "no reversed, exchanged or coupled joint, offset, gear, direction of gravity or spring "
    "explains it; check the kinematics (lengths, axes, order of the joints) and the columns"
)
_ROWS = 1500  # of the comparison
_FEW = 300  # rows that causes are tried on
_TRIED = 3  # inputs with the largest residuals that causes have to explain
_ANGLES = np.linspace(-np.pi, np.pi, 12, endpoint=False)  # rad, of homing offsets
_FACTORS = [1.0, *(x**k for x in (1.4, 2.0, 3.0, 5.0, 10.0) for k in (1, -1))]  # of gears
_TRIALS = 60  # of a factor and an offset
_ENOUGH = 0.1  # unexplained share with a cause over that without, at which no more are tried
_CHUNK = 500  # rows of a call of a regressor, for its memory
_SCALE = 2.5  # of torques over those of the URDF's bodies
_CERTAIN = 0.1  # largest standard error of a scale, as a share of it


@dataclass(frozen=True)
class _Cause:
    """A change of a log or of a URDF that may explain the torques.

    Attributes:
        text: cause and cure.
        data: averages of the changed log.
        bodies: regressor of the rigid bodies at the rows, ``(R, N, P)``.
        extra: input and a column that explains it, too; None without.
    """

    text: str
    data: Averages
    bodies: np.ndarray
    extra: tuple[int, np.ndarray] | None = None


def regressor(structure: Structure) -> Regressor:
    """Return the regressor of a structure on NumPy arrays."""

    def function(*motion: np.ndarray) -> np.ndarray:
        parts = zip(*(np.array_split(x, len(x) // _CHUNK + 1) for x in motion), strict=True)
        bodies = [structure.regressor(*map(torch.from_numpy, part)).numpy() for part in parts]
        return np.concatenate(bodies)

    return function


@dataclass(frozen=True)
class StructureFit:
    """Comparison of what rigid bodies and a generic equation leave of each torque.

    Attributes:
        data: averages with the narrow kernel.
        left, generic: shares of the inputs that they leave, by joint.
        suspects: joints where the bodies leave four times as much as a generic equation can.
        bad: joints where they leave more than a generic equation does of held-out data, too.
    """

    data: Averages
    left: dict[int, float]
    generic: dict[int, float]
    suspects: set[int]
    bad: set[int]


def fit_structure(structure: Structure, widths: Sequence[Averages]) -> StructureFit | None:
    """Compare rigid bodies and a generic equation; None for others than rigid robots.

    Both are fitted to nine tenths of the data and judged on the last tenth. The URDF does not fit a
    joint if it leaves four times as much as the generic equation, in most tenths, with kernels of
    two widths.

    Args:
        structure: rigid robot with one input per joint; others are not compared.
        widths: averages of the training with kernels of two widths, and inputs as they act.
    """
    size = structure.num_coordinates
    if not isinstance(structure, RigidChain) or widths[0].u.shape[1] != size:
        return None
    rigid = regressor(structure)
    thinned = [data.thinned(_ROWS) for data in widths]
    bodies = [rigid(data.q, data.v, data.a) for data in thinned]
    joints = np.flatnonzero(thinned[0].moving.sum(axis=0) >= FEWEST).tolist()
    pairs = zip(thinned, bodies, strict=True)
    shares = [[_shares(data, x, i) for i in joints] for data, x in pairs]
    left, generic, worse = np.reshape(shares, (2, len(joints), 3)).transpose(2, 0, 1)
    suspect = np.all(left > _WORSE * generic, axis=0)
    bad = suspect & np.all(worse > 0, axis=0)
    return StructureFit(
        data=thinned[0],
        left=dict(zip(joints, left[0].tolist(), strict=True)),
        generic=dict(zip(joints, generic[0].tolist(), strict=True)),
        suspects={i for i, x in zip(joints, suspect, strict=True) if x},
        bad={i for i, x in zip(joints, bad, strict=True) if x},
    )


def _shares(data: Averages, bodies: np.ndarray, i: int) -> tuple[float, float, bool]:
    """Return the shares of an input that rigid bodies and a generic equation leave.

    The share of the bodies is that of held-out data; a generic equation can leave as little as it
    does of the data that it is fitted to. The third result is true if the bodies leave more of
    held-out data than a generic equation, in most tenths.
    """
    rows = data.moving[:, i]
    data = data.rows(rows)
    y = data.u[:, [i]] - data.u[:, [i]].mean(axis=0)
    left = []
    for x in (bodies[rows], None):
        columns = force_columns(data, i, x)
        regression = EquationOfMotionRegression({**columns, "y": y}, tenths(data))
        left.append(regression.fit("y", list(columns)).held_out[:, 0])
    of_bodies, generic = left
    worse = of_bodies.sum() > _WORSE * generic.sum() and (of_bodies > generic).sum() >= _TENTHS
    return float(of_bodies.sum() / (y**2).sum()), unexplained(y, *columns.values()), bool(worse)


def compare_structure(
    structure: Structure, fit: StructureFit, u: Columns
) -> tuple[list[Measurement], set[int]]:
    """Name the cause of what rigid bodies leave; return the joints that do not fit, too.

    The causes that are tried are reversed joints, exchanged or coupled joints or
    inputs, offsets and factors of q, other directions of gravity, and springs. At the other joints
    the scale s_i of the torques is compared with that of the URDF's bodies::

        u_i = s_i Y_i(q, v, a) pi_0 + r a_i + d v_i + c sign(v_i) - o

    Args:
        structure: rigid robot.
        fit: comparison of its bodies with a generic equation.
        u: columns of the inputs.
    """
    assert isinstance(structure, RigidChain)
    worst = sorted(fit.suspects, key=lambda i: -fit.left[i])[:_TRIED]
    hint = _explanation(structure, fit.data, worst) if worst else ""
    bad = fit.suspects if hint else fit.bad
    results = []
    for i, left in fit.left.items():
        joint, generic = structure.joint_names[i], fit.generic[i]
        measurement = judged(
            name=FIT,
            place=joint,
            value=left / max(generic, 1e-300),
            expected=f"below {_WORSE:g}",
            bad=i in bad,
            text=f"the URDF leaves {100 * left:.2g} % of {u.columns[i]!r} at joint {joint} "
            f"unexplained, a generic equation {100 * generic:.2g} %: {hint or _UNKNOWN}",
            section=SECTION,
        )
        results.append(measurement)
    return results + _scales(structure, fit.data, u, bad), bad


def _left(cause: _Cause, joints: Sequence[int]) -> float:
    """Return the sum of the shares of inputs that rigid bodies leave, per degree of freedom."""
    shares = []
    for i in joints:
        rows = cause.data.moving[:, i]
        if rows.sum() < _FEW // 4:  # exchanged with a joint that rests
            return np.inf
        data = cause.data.rows(rows)
        columns = force_columns(data, i, cause.bodies[rows])
        if cause.extra is not None and cause.extra[0] == i:
            columns["extra"] = cause.extra[1][rows].reshape(len(data), -1)
        shares.append(unexplained(data.u[:, [i]], *columns.values()))
    return float(np.sum(shares))


def _explanation(structure: RigidChain, data: Averages, joints: Sequence[int]) -> str:
    """Return the causes that leave least of the inputs, in words; "" if none leaves much less.

    Causes that need a search are tried if simpler ones leave a part.
    """
    data = data.thinned(_FEW)
    plain = _changed("", data, regressor(structure))
    total = _left(plain, joints)
    texts: dict[str, float] = {}
    for causes in (_causes, _offsets, _gears):
        texts |= {x.text: _left(x, joints) for x in causes(structure, plain, joints)}
        least = min(texts.values())
        if least < _ENOUGH * total:
            break
    if least >= _EXPLAINS * total:
        return ""
    # In a plane, the mirror image of a reversed joint is the other joint reversed.
    return "; or ".join(text for text, left in texts.items() if left < max(_TIE * least, 1e-6))


def _causes(structure: RigidChain, plain: _Cause, joints: Sequence[int]) -> Iterator[_Cause]:
    names, data, rigid = structure.joint_names, plain.data, regressor(structure)
    for k, name in enumerate(names):
        cause = _moved(plain, rigid, k, -1.0, 0.0)
        forces = _forces(structure, cause.data)
        columns = "q and v" if (data.u[:, k] * forces[:, k]).sum() > 0 else "q, v and u"
        text = f"joint {name} turns the other way in the log: reverse its axis, or {columns} of it"
        yield replace(cause, text=text)
        springs = wording.setting("model.springs", [name])
        text = f"a spring at joint {name} explains it: fit it with {springs}"
        yield replace(plain, text=text, extra=(k, data.q[:, k]))
    for i, j in itertools.permutations(range(len(names)), 2):
        text = (
            f"the input of joint {names[i]} holds the torques of the joints {names[j]} and "
            f"{names[i]}, as of a belt or a differential: convert it to torques of the joints"
        )
        yield replace(plain, text=text, extra=(i, plain.bodies[:, j]))
    for i, j in itertools.combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[i, j]] = order[[j, i]]
        pair = f"of the joints {names[i]} and {names[j]} are exchanged"
        text = f"the inputs {pair}"
        yield replace(plain, text=text, data=replace(data, u=data.u[:, order]))
        yield _changed(f"the columns {pair} (q, v and u)", _ordered(data, order), rigid)
    setting = wording.setting("model.structure.gravity", [0.0, 0.0, 0.0])
    text = (
        "gravity is missing in the log, as in torques before its compensation is added: log the "
        f"torques that act, or set {setting}"
    )
    weightless = _changed(text, data, regressor(structure.with_gravity([0.0, 0.0, 0.0])))
    yield weightless
    least = _left(weightless, joints)
    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        gravity = (float(np.linalg.norm(structure.gravity)) * direction + 0.0).tolist()
        setting = wording.setting("model.structure.gravity", gravity)
        bodies = regressor(structure.with_gravity(gravity))
        cause = _changed(f"the base is mounted otherwise: set {setting}", data, bodies)
        if _left(cause, joints) < least / _TIE:  # gravity along an axis has no torque
            yield cause


def _changed(text: str, data: Averages, rigid: Regressor) -> _Cause:
    """Return the cause that the log or the robot is another one."""
    return _Cause(text, data, rigid(data.q, data.v, data.a))


def _moved(plain: _Cause, rigid: Regressor, k: int, factor: float, offset: float) -> _Cause:
    """Return the cause that q of joint k is a multiple of that of the robot, plus an offset."""
    k_alone = np.arange(plain.data.q.shape[1]) == k
    motion = _scaled(plain.data, np.where(k_alone, 1 / factor, 1.0))
    return _changed("", replace(motion, q=motion.q + offset * k_alone), rigid)


def _offset(
    plain: _Cause, structure: RigidChain, k: int, factor: float, joints: Sequence[int]
) -> tuple[float, float]:
    """Return what the best offset of joint k leaves, and the offset.

    The torque of bodies is of degree 2 in sin and cos of an angle, or in the position of a slide:
    five offsets tell that of all others.
    """

    def basis(x: float) -> list[float]:
        if structure.turning[k]:
            return [1.0, np.cos(x), np.sin(x), np.cos(2 * x), np.sin(2 * x)]
        return [1.0, x, x**2, x**3, x**4]

    rigid, nodes = regressor(structure), 2 * np.pi * np.arange(-2, 3) / 5
    causes = [_moved(plain, rigid, k, factor, x) for x in nodes]
    bodies, weights = np.array([x.bodies for x in causes]), np.linalg.inv([basis(x) for x in nodes])

    def left(x: float) -> float:
        values = np.tensordot(basis(x) @ weights, bodies, 1)
        return _left(replace(causes[2], bodies=values), joints)

    _, start = min((left(x), x) for x in _ANGLES)
    bounds = start - _ANGLES[1] + _ANGLES[0], start + _ANGLES[1] - _ANGLES[0]
    fit = scipy.optimize.minimize_scalar(left, bounds=bounds, method="bounded")
    return float(fit.fun), float(fit.x)


def _offsets(structure: RigidChain, plain: _Cause, joints: Sequence[int]) -> Iterator[_Cause]:
    for k, name in enumerate(structure.joint_names):
        _, offset = _offset(plain, structure, k, 1.0, joints)
        cause = _moved(plain, regressor(structure), k, 1.0, offset)
        yield replace(cause, text=_off(name, offset))


def _off(name: str, offset: float) -> str:
    return (
        f"{name} is {-offset:.3g} off: add {offset:.3g} to its column, or correct the origin of "
        "the joint"
    )


def _gears(structure: RigidChain, plain: _Cause, joints: Sequence[int]) -> Iterator[_Cause]:
    """Return the best factor of q of a joint, and the best offset beside it."""
    rigid = regressor(structure)

    def left(k: int, factor: float, offset: float) -> float:
        return _left(_moved(plain, rigid, k, factor, offset), joints)

    starts = []
    for k in range(structure.num_coordinates):
        _, factor = min((left(k, x, 0.0), x) for x in _FACTORS)
        least, offset = _offset(plain, structure, k, factor, joints)
        starts.append((least, k, factor, offset))
    _, k, factor, offset = min(starts)
    start = np.array([np.log(factor), offset])
    both = scipy.optimize.minimize(
        lambda x: left(k, np.exp(x[0]), x[1]),
        start,
        method="Nelder-Mead",
        options={
            "maxfev": _TRIALS,
            "initial_simplex": start + np.array([[0, 0], [0.15, 0], [0, 0.25]]),
        },
    )
    factor, offset = np.exp(both.x[0]), both.x[1]
    if left(k, factor, 0.0) <= max(_TIE * both.fun, 1e-6):
        offset = 0.0
    name = structure.joint_names[k]
    text = f"q and v of joint {name} are {factor:.3g} times those of the URDF, as by a gear"
    if offset:
        text += f", and {_off(name, offset * factor)}"
    yield replace(_moved(plain, rigid, k, factor, offset), text=text)


def _scaled(data: Averages, scale: np.ndarray) -> Averages:
    sign = np.sign(scale)
    return replace(
        data,
        q=data.q * scale,
        v=data.v * scale,
        a=data.a * scale,
        sign=data.sign * sign,
        slow_sign=data.slow_sign * np.tile(sign, 2),
    )


def _ordered(data: Averages, order: np.ndarray) -> Averages:
    size = len(order)
    return replace(
        data,
        q=data.q[:, order],
        v=data.v[:, order],
        a=data.a[:, order],
        sign=data.sign[:, order],
        slow_sign=data.slow_sign[:, np.concatenate([order, size + order])],
        moving=data.moving[:, order],
        u=data.u[:, order],
    )


def _forces(structure: RigidChain, data: Averages) -> np.ndarray:
    """Return the forces of the bodies of the URDF, ``(R, N)``."""
    q, v, a = map(torch.from_numpy, (data.q, data.v, data.a))
    return np.asarray(structure.rigid_force(q, v, a).numpy())


def _scales(
    structure: RigidChain, data: Averages, u: Columns, bad: Collection[int]
) -> list[Measurement]:
    """Compare the torques with those of the bodies of the URDF, where both are clear."""
    forces = set(u.units) <= {"Nm", "N"}
    if not (forces or set(u.units) <= {"A"}) or structure.tree.problems:
        return []
    forces_of_bodies = _forces(structure, data)
    expected, results = f"{1 / _SCALE:g} to {_SCALE:g}" if forces else "above 0", []
    for i, joint in enumerate(structure.joint_names):
        rows = data.moving[:, i]
        if i in bad or rows.sum() < FEWEST:
            continue
        columns = {
            "bodies": forces_of_bodies[rows, i],
            "drive": np.column_stack([data.a[rows, i], data.v[rows, i], np.ones(rows.sum())]),
            "sign": data.sign[rows, i],
            "y": data.u[rows, i],
        }
        regression = EquationOfMotionRegression(columns, tenths(data.rows(rows)))
        fit = regression.fit("y", ["bodies", "drive", "sign"])
        scale, parts = float(fit.theta[0, 0, 0]), fit.theta[1:, 0, 0]
        error = float(np.sqrt((len(parts) - 1) * parts.var()))
        clear = error < _CERTAIN * abs(scale)
        wrong = not 1 / _SCALE < scale < _SCALE if forces else scale < 0
        cause = "reversed" if scale < 0 else "in another unit, or at the motor instead of the joint"
        measurement = judged(
            name=SCALE,
            place=joint,
            value=scale if clear else np.nan,
            expected=expected,
            bad=clear and wrong,
            text=f"input {u.columns[i]!r} is {scale:.3g} times the torque of the URDF's bodies at "
            f"joint {joint}: is it {cause}? Correct the column or its unit, or the masses of the "
            "URDF",
            section=SECTION,
        )
        results.append(measurement)
    return results
