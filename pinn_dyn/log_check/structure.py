"""Comparison of a URDF with a log: does the rigid-body equation explain the torques?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from pinn_dyn import wording
from pinn_dyn.data.logs import Columns, DelayCurve, LogSource, Recording, clear_delays
from pinn_dyn.data.logs.check.averages import Averages
from pinn_dyn.data.logs.check.delay import force_columns
from pinn_dyn.data.logs.check.equation import EquationOfMotionRegression, Regressor
from pinn_dyn.data.logs.check.input_faults import delayed, input_faults
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.models.structure import Structure
from pinn_dyn.systems import RigidChain

SECTION = "docs/known_mechanics.md#does-the-urdf-fit-the-log"
SCALE = "torque over that of the URDF's bodies"
"""Name of the measurement of the scale of an input; NaN where it is not clear."""
_UNEXPLAINED = 0.05  # share of the variance of a torque from which a URDF may be wrong
_WORSE = 4.0  # unexplained share over that of a generic equation
_EXPLAINS = 0.3  # unexplained share with a cause over that without, at most
_TIE = 1.1  # unexplained share over that of the best cause, up to which both are named
_ROWS = 1500  # that the causes are tried on
_ANGLES = np.linspace(-np.pi, np.pi, 24, endpoint=False)  # rad, of homing offsets
_FACTORS = np.array([2.0, 3.0, 4.0, 5.0, 6.0, 10.0])  # of gears, and their inverses
_SCALE = 2.5  # of torques over those of the URDF's bodies
_CERTAIN = 0.1  # largest standard error of a scale, as a share of it


@dataclass(frozen=True)
class _Cause:
    """A change of a log or of a URDF that may explain the torques."""

    text: str
    data: Averages
    rigid: Regressor | None
    spring: int | None = None


def regressor(structure: Structure) -> Regressor:
    """Return the regressor of a structure on NumPy arrays."""

    def function(*motion: np.ndarray) -> np.ndarray:
        return structure.regressor(*map(torch.from_numpy, motion)).numpy()

    return function


def findings(source: LogSource, structure: Structure) -> list[Measurement]:
    """Return what contradicts a fit of known mechanics to the log: a part of its check.

    These are drives that saturate, clocks that drift, and a structure that the torques contradict.
    """
    inputs = len(source.u.columns)
    training = [item for x in source.cleaned if x.split == "train" for item in x.clean]
    training = [replace(item, u=item.u[:, :inputs]) for item in training]  # no rates of inputs
    step = training[0].sample_time("a comparison with the URDF")
    rigid = regressor(structure) if structure.num_coordinates == inputs else None
    undelayed = DelayCurve(np.zeros(1), np.zeros(1), 0.0, 0.0, "")
    faults, _ = input_faults(training, [undelayed] * inputs, source.u, step, rigid)
    faults += compare_structure(structure, training, (), source.u, step)
    return [item for item in faults if item.verdict != "ok"]


def compare_structure(
    structure: Structure,
    recordings: Sequence[Recording],
    curves: Sequence[DelayCurve],
    u: Columns,
    step: float,
) -> list[Measurement]:
    """Compare what rigid bodies and a generic equation leave of each torque, and name the cause.

    The causes that are tried are reversed joints, exchanged joints or inputs, offsets and factors
    of q, other directions of gravity, and springs. If the URDF fits, the scale s_i of the torques
    is compared with that of its bodies::

        u_i = s_i Y_i(q, v, a) pi_0 + r a_i + d v_i + c sign(v_i) - o

    Args:
        structure: rigid robot with one input per joint; others are not compared.
        recordings: training stretches.
        curves: delays of the inputs.
        u: columns of the inputs.
        step: sample time, s.
    """
    size = structure.num_coordinates
    parts = delayed(recordings, clear_delays(curves, step))
    data = Averages.of(parts, step, spacing=0.5)
    if data is None or not isinstance(structure, RigidChain) or len(u.columns) != size:
        return []
    data = data.rows(np.arange(len(data.t)) % max(1, len(data.t) // _ROWS) == 0)
    if len(data.t) < 4 * data.q.shape[1] * 14:
        return []
    rigid = regressor(structure)
    plain = _Cause("", data, rigid)
    left, generic = _left(plain), _left(replace(plain, rigid=None))
    bad = (left > _UNEXPLAINED) & (left > _WORSE * generic)
    hint = _explanation(structure, plain, left) if bad.any() else ""
    results = []
    for i, joint in enumerate(structure.joint_names):
        text = (
            f"the URDF leaves {100 * left[i]:.2g} % of {u.columns[i]!r} at joint {joint} "
            f"unexplained, a generic equation {100 * generic[i]:.2g} %: {hint}"
        )
        measured = ("share that the URDF does not explain", joint, left[i])
        results.append(_judged(*measured, f"below {_UNEXPLAINED}", bool(bad[i]), text))
    return results if bad.any() else [*results, *_scales(structure, data, u)]


def _judged(
    name: str, place: str, value: float, expected: str, bad: bool, text: str
) -> Measurement:
    return judged(name, place, value, expected, bad, text, section=SECTION)


def _left(cause: _Cause) -> np.ndarray:
    """Return the share of each input that the equation leaves, ``(N,)``."""
    shares, motion = [], (cause.data.q, cause.data.v, cause.data.a)
    # A call for all joints: the regressor takes most of the time of a check.
    bodies = None if cause.rigid is None else cause.rigid(*motion)
    for i in range(cause.data.q.shape[1]):
        moving = cause.data.moving[:, i]
        data = cause.data.rows(moving)
        if len(data.t) < _ROWS // 10:
            shares.append(0.0)
            continue
        rigid = None if bodies is None else lambda *_, of_rows=bodies[moving]: of_rows
        columns = force_columns(data, i, rigid)
        if cause.spring == i:
            columns["spring"] = data.q[:, i]
        y = data.u[:, 0, i] - data.u[:, 0, i].mean()
        regression = EquationOfMotionRegression({**columns, "y": y}, np.zeros(len(y), dtype=int))
        shares.append(float(regression.fit("y", list(columns)).shares()[0, 0]))
    return np.array(shares)


def _explanation(structure: RigidChain, plain: _Cause, left: np.ndarray) -> str:
    """Return the cause that leaves the least, in words."""
    causes = list(_causes(structure, plain))
    totals = np.array([_left(cause).sum() for cause in causes])
    if totals.min() < _EXPLAINS * left.sum():
        # In a plane, the mirror image of a reversed joint is the other joint reversed.
        return "; or ".join(causes[k].text for k in np.flatnonzero(totals < _TIE * totals.min()))
    return (
        "no reversed or exchanged joint, offset, gear, direction of gravity or spring explains it; "
        "check the kinematics (lengths, axes, order of the joints) and the columns"
    )


def _causes(structure: RigidChain, plain: _Cause) -> Iterator[_Cause]:
    names, size = structure.joint_names, structure.num_coordinates
    data = plain.data
    for k, name in enumerate(names):
        reversed_k = np.where(np.arange(size) == k, -1.0, 1.0)
        power = float((data.u[:, 0, k] * data.v[:, k]).mean())
        columns = "q, v and u" if power > 0 else "q and v"
        text = f"joint {name} turns the other way in the log: reverse its axis, or {columns} of it"
        yield replace(plain, text=text, data=_scaled(data, reversed_k))
        springs = wording.setting("model.springs", [name])
        text = f"a spring at joint {name} explains it: fit it with {springs}"
        yield replace(plain, text=text, spring=k)
        yield from _offsets(plain, k, name)
        for factor in (*_FACTORS, *(1 / _FACTORS)):
            scale = np.where(np.arange(size) == k, 1 / factor, 1.0)
            text = f"q and v of joint {name} are {factor:.3g} times those of the URDF, as by a gear"
            yield replace(plain, text=text, data=_scaled(data, scale))
    for i in range(size):
        for j in range(i):
            order = np.arange(size)
            order[[i, j]] = order[[j, i]]
            pair = f"{names[j]} and {names[i]}"
            text = f"the inputs of the joints {pair} are exchanged"
            yield replace(plain, text=text, data=replace(data, u=data.u[:, :, order]))
            text = f"the columns of the joints {pair} are exchanged (q, v and u)"
            yield replace(plain, text=text, data=_ordered(data, order))
    magnitude = float(np.linalg.norm(structure.gravity))
    for axis in range(3):
        for sign in (1.0, -1.0):
            gravity = [sign * magnitude * (x == axis) for x in range(3)]
            text = wording.setting("model.structure.gravity", gravity)
            text = f"the base is mounted otherwise: set {text}"
            yield replace(plain, text=text, rigid=regressor(structure.with_gravity(gravity)))


def _offsets(plain: _Cause, k: int, name: str) -> Iterator[_Cause]:
    """Yield the best offset of coordinate k, found on a grid that is refined twice."""

    def shifted(offset: float) -> _Cause:
        q = plain.data.q + offset * (np.arange(plain.data.q.shape[1]) == k)
        text = (
            f"{name} is {-offset:.3g} off: add {offset:.3g} to its column, or correct the origin "
            "of the joint"
        )
        return replace(plain, text=text, data=replace(plain.data, q=q))

    grid = _ANGLES
    for _ in range(3):
        best = min(grid, key=lambda x: float(_left(shifted(x)).sum()))
        gap = (grid[1] - grid[0]) / 4
        grid = best + gap * np.arange(-4, 5)
    yield shifted(float(best))


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
        u=data.u[:, :, order],
    )


def _scales(structure: RigidChain, data: Averages, u: Columns) -> list[Measurement]:
    """Compare the torques with those of the bodies of the URDF, where both are clear."""
    forces = set(u.units) <= {"Nm", "N"}
    if not (forces or set(u.units) <= {"A"}) or structure.tree.problems:
        return []
    q, v, a = map(torch.from_numpy, (data.q, data.v, data.a))
    bodies = structure.rigid_force(q, v, a).numpy()
    results = []
    for i, joint in enumerate(structure.joint_names):
        rows = data.moving[:, i]
        if rows.sum() < _ROWS // 10:
            continue
        columns = {
            "bodies": bodies[rows, i],
            "drive": np.column_stack([data.a[rows, i], data.v[rows, i], np.ones(rows.sum())]),
            "sign": data.sign[rows, i],
            "y": data.u[rows, 0, i],
        }
        blocks = np.arange(rows.sum()) * 10 // rows.sum()
        regression = EquationOfMotionRegression(columns, blocks)
        fit = regression.fit("y", ["bodies", "drive", "sign"], regression.jackknife())
        scale, parts = float(fit.theta[0, 0, 0]), fit.theta[1:, 0, 0]
        error = float(np.sqrt((len(parts) - 1) * parts.var()))
        clear = error < _CERTAIN * abs(scale)
        wrong = not 1 / _SCALE < scale < _SCALE if forces else scale < 0
        cause = "reversed" if scale < 0 else "in another unit, or at the motor instead of the joint"
        text = (
            f"input {u.columns[i]!r} is {scale:.3g} times the torque of the URDF's bodies at joint "
            f"{joint}: is it {cause}? Correct the column or its unit, or the masses of the URDF"
        )
        expected = f"{1 / _SCALE:g} to {_SCALE:g}" if forces else "above 0"
        value = scale if clear else np.nan
        results.append(_judged(SCALE, joint, value, expected, clear and wrong, text))
    return results
