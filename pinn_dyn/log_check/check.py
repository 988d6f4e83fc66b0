"""The check of a log before a training: measurements, each with a verdict."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from pydantic import PositiveFloat

from pinn_dyn import wording
from pinn_dyn.data import logs
from pinn_dyn.data.bandwidth import bandwidth
from pinn_dyn.data.logs.check.checks import held_rows
from pinn_dyn.data.logs.check.plausibility import LOST, STATE
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import round_rate
from pinn_dyn.identification.rigid_excitation import MOST, RigidExcitation, rigid_excitation
from pinn_dyn.log_check import numbers
from pinn_dyn.log_check.averages import (
    Averages,
    averages_of_widths,
    compared,
    parts_of,
    white_noise,
    with_products,
)
from pinn_dyn.log_check.chain import EXCHANGED, Order, chain_regressor, check_order
from pinn_dyn.log_check.delay import (
    INTERVAL,
    DelayCurve,
    are_held,
    clear_delays,
    input_delays,
)
from pinn_dyn.log_check.equation import Regressor
from pinn_dyn.log_check.figures import residuals
from pinn_dyn.log_check.input_faults import SATURATED, input_faults
from pinn_dyn.log_check.numbers import check_angles, check_velocity_lag
from pinn_dyn.log_check.page import LogCheck, store, stored
from pinn_dyn.log_check.runs import (
    Interval,
    Motion,
    check_rests,
    check_runs,
    equations_of_motion,
)
from pinn_dyn.log_check.structure import FIT, compare_structure, regressor
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.structure import Structure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_EXPLAINED = 0.1  # share of the motion that inputs explain, below which a training makes no sense
_NOISE, _STILL = 0.02, 0.25  # noise of q as a share of its range; the same of a joint at rest
_TARGET = 0.3  # part of the variance of q that the targets of servos leave
_OUTSIDE = 0.05  # share of the test outside the range of the training
_OF_MOTORS = {"rad", "m", "Pa"}  # units of motor angles, lengths of tendons, and pressures
_FORCES = {"Nm", "N", "A", "V"}
_TURNED = np.pi / 2  # rad per sample, above which no step fits
# Column of the table of coordinates, its upper limit, and the text beyond it.
_LIMITS = (
    ("noise / range", _NOISE, "its noise is {:.2g} % of its range"),
    ("test outside", _OUTSIDE, "{:.3g} % of the test is outside the training range"),
)
_FITS = 0.1  # usual residual of a window, below which no other equation is tried
_WRONG = "the robot of the URDF has other forces"  # reason why there is no delay
_judged = partial(judged, section="docs/bags_and_other_logs.md#is-the-log-good-enough")


def verdict(source: logs.LogSource, structure: Structure | None = None) -> list[str]:
    """Return what is wrong with a log: of the last check of the same data and robot.

    Without a check, a log with a structure is checked now; the result is empty for others.
    """
    texts = stored(source, _regressor(structure, len(source.u.columns)))
    if texts is None and structure is not None:
        check(source, structure=structure)
        texts = stored(source, _regressor(structure, len(source.u.columns)))
    return texts or []


def residual_figure(source: logs.LogSource, structure: Structure) -> Figure | None:
    """Draw what the rigid bodies leave of the forces over q and over v, per joint.

    The result is None with another number of inputs than joints, or with too few rows.
    """
    rigid = _regressor(structure, len(source.u.columns))
    training = [item for x in source.cleaned if x.split == "train" for item in x.clean]
    if rigid is None or training[0].u.shape[1] != len(source.u.columns):
        return None
    step = float(np.median(np.diff(training[0].t)))
    widths = averages_of_widths(parts_of(training, step), step)
    if not widths:
        return None
    data = widths[compared(widths)[0]]
    motion = equations_of_motion(data, source.q, source.u, data.width, rigid)
    return None if motion is None else residuals(motion, source.q, source.v, source.u)


@dataclass
class _Answers:
    """Answers of the equation of motion to the questions about a log.

    Attributes:
        measurements: measurements.
        curves: delay curve of each input.
        clear: delay of each input that is clear, s; 0 for others.
        held: rows for which the values of an input repeat, where its motion follows lines; else 1.
        motion: averages and equations; None if the rows are too few.
        driven: joint that each input drives, if there are fewer inputs than coordinates.
    """

    measurements: list[Measurement]
    curves: list[DelayCurve]
    clear: list[float]
    held: list[int]
    motion: Motion | None = None
    driven: Sequence[int] = ()


def check(
    source: logs.LogSource,
    *,
    longest_delay: PositiveFloat = 0.3,
    structure: Structure | None = None,
) -> LogCheck:
    """Check a log as its configuration reads, splits and cleans it.

    Args:
        source: the log.
        longest_delay: longest delay of an input that is tried, s.
        structure: kinematics of a rigid robot whose joints are the coordinates of the log, or None.

    Raises:
        LogError: if the log cannot be used at all.
    """
    splits = source.load()
    inputs = len(source.u.columns)
    stretches = [
        (x.split == "train", replace(item, u=item.u[:, :inputs]))  # no rates of inputs
        for x in source.cleaned
        for item in x.clean
    ]
    training = [item for is_training, item in stretches if is_training]
    others = [item for is_training, item in stretches if not is_training]
    step = float(np.median(np.diff(training[0].t)))
    coordinates = _coordinates(source, training, splits.test)
    noise = coordinates["noise of q"].to_numpy()
    highest = bandwidth([item.q for item in training], step, noise)
    servo = _follows_targets(source, training, step, longest_delay)
    rows = max(held_rows(item.q) for _, item in stretches)
    if rows == 1:
        answers = _answers(source, training, others, step, longest_delay, structure, servo)
    else:  # the acceleration of held values means nothing
        answers = _Answers([_held(rows, step)], [], [0.0] * inputs, [rows] * inputs)
    store(source, _regressor(structure, inputs), answers.measurements)
    measurements = [*source.measurements, *answers.measurements, *_limited(coordinates)]
    excitation = None
    if structure is not None:
        excitation = _excitation(structure, splits.train, coordinates, highest, step)
        measurements.append(_condition(excitation))
    dry = any(x.dry for x in answers.curves)
    steps = _lines(source, answers.held, rows, step)
    # A filter smears reversals of dry friction.
    if not steps and not (dry and source.v is not None):
        steps = _filter(source, training, step, coordinates, highest)
    angles = [unit == "rad" for unit in source.q.units]
    fast = (coordinates["fastest [/s]"] * step > _TURNED)[angles].any()
    return LogCheck(
        source=source,
        measurements=measurements,
        runs=pd.DataFrame([_run(part) for part in source.cleaned]),
        coordinates=coordinates,
        inputs=_inputs_table(source, training, answers.curves),
        delays=answers.curves,
        steps=steps,
        delay=_delay(source, answers.clear),
        hold=source.interpolation == "linear" and not servo and are_held(answers.curves, step),
        candidates=_candidates(source, structure, servo=servo, dry=dry, fast=bool(fast)),
        driven=answers.driven,
        rigid=excitation,
        motion=answers.motion,
    )


def _answers(
    source: logs.LogSource,
    training: Sequence[logs.Recording],
    others: Sequence[logs.Recording],
    step: float,
    longest: float,
    structure: Structure | None,
    servo: bool,
    odd: Sequence[Interval] = (),
) -> _Answers:
    """Ask the equation of motion, without the parts of runs that do not fit the others."""
    inputs, size = len(source.u.columns), len(source.q.columns)
    rigid = _regressor(structure, inputs)
    first = parts_of(training, step)
    everything = [*first, *parts_of(others, step)]
    names = list(dict.fromkeys(item.run for item in everything))
    if inputs > size:
        everything = [with_products(item) for item in everything]
    widths = averages_of_widths(everything, step)
    if odd:
        widths = [data.rows(~np.any([x.of(data) for x in odd], axis=0)) for data in widths]
    of_training = [data.rows(data.stretch < len(first)) for data in widths]
    motors = structure is None and {*source.u.units} <= _OF_MOTORS
    curves = input_delays(first, longest=longest, rigid=rigid, widths=of_training, motors=motors)
    if not widths:
        return _Answers([], curves, [0.0] * inputs, [1] * inputs)
    chosen = [widths[k] for k in compared(widths)]
    asked = _ask_inputs(source, chosen, len(first), curves, rigid, step, servo)
    late = [x.delayed(asked.clear) for x in chosen]
    if asked.order is not None and inputs == size:
        late = [asked.order.corrected(x) for x in late]
    data = [x.rows(x.stretch < len(first)) for x in late]
    of_robot = [] if structure is None else compare_structure(structure, data, source.u)
    wrong = {x.place for x in of_robot if x.name == FIT and x.verdict != "ok"}
    if wrong and structure is not None:  # whose delays are wrong, too
        pairs = zip(asked.curves, structure.joint_names, strict=True)
        asked.curves = [x.without(_WRONG) if j in wrong and x.of_bodies else x for x, j in pairs]
        asked.clear = [0.0] * inputs if servo else clear_delays(asked.curves, step)
    narrow, wide = _motions(source, late, rigid, exact=rigid is not None and not wrong)
    # A fault of an input or of the clock explains runs that differ.
    clocks = [x for x in source.measurements if x.name in (LOST, STATE)]
    bad = {x.name for x in [*asked.faults, *clocks] if x.verdict != "ok"}
    of_parts: list[Measurement] = []
    parts: list[Interval] = []
    if bad <= {SATURATED}:
        of_parts, parts = check_rests(narrow, wide, names)
        if not parts:
            of_runs, parts = check_runs(narrow, wide, names, exact=not wrong)
            of_parts += of_runs
    if parts and not odd:
        again = _answers(source, training, others, step, longest, structure, servo, parts)
        saturated = any(x.name == SATURATED and x.verdict != "ok" for x in again.measurements)
        if not saturated:  # parts that do not fit look like a saturation
            kept = [x for x in again.measurements if x.name not in {x.name for x in of_parts}]
            return replace(again, measurements=of_parts + kept)
    order = asked.order
    results = [] if bad else of_parts + ([] if order is None else order.measurements)
    results += asked.faults + _coordinates_measured(source, everything, late[0], structure, step)
    results += _inputs_measured(source, data[0], asked.curves, asked.clear) + of_robot
    drawn = narrow
    if wrong:
        drawn = equations_of_motion(late[0], source.q, source.u, late[0].width, rigid)
    driven = order.joints if order is not None and inputs < size else []
    return _Answers(results, asked.curves, asked.clear, asked.held, drawn, driven)


@dataclass
class _Inputs:
    """Answers about the inputs: faults, delay curves, clear delays, rows of a hold, and order."""

    faults: list[Measurement]
    curves: list[DelayCurve]
    clear: list[float]
    held: list[int]
    order: Order | None


def _ask_inputs(
    source: logs.LogSource,
    widths: Sequence[Averages],
    training: int,
    curves: list[DelayCurve],
    rigid: Regressor | None,
    step: float,
    servo: bool,
) -> _Inputs:
    """Ask for the order of the inputs, for their faults, and for their delays beside them."""
    # The lag of a servo is no delay.
    clear = [0.0] * len(curves) if servo else clear_delays(curves, step)
    order = None
    if not servo:
        order = check_order([x.delayed(clear) for x in widths], source.u, source.q.units)
    of_training = [x.rows(x.stretch < training) for x in widths]
    unexplained = None if order is None else order.unexplained
    faults, curves, held = input_faults(of_training, curves, source.u, rigid, unexplained)
    states = {x.place for x in source.measurements if x.name == STATE and x.verdict == "stop"}
    pairs = zip(curves, source.u.columns, strict=False)
    curves = [x.without("the input is a state") if name in states else x for x, name in pairs]
    bad = {x.name for x in order.measurements if x.verdict != "ok"} if order else set()
    if EXCHANGED in bad:
        curves = [x.without("the inputs are exchanged") for x in curves]
    clear = [0.0] * len(curves) if servo else clear_delays(curves, step)
    return _Inputs(faults, curves, clear, held, order)


def _motions(
    source: logs.LogSource, widths: Sequence[Averages], rigid: Regressor | None, *, exact: bool
) -> list[Motion | None]:
    """Return the equations with kernels of two widths.

    They are those of rigid bodies, or of a chain of unknown bodies. If these leave a part, those of
    single joints are used if they leave half of that: they have many more constants.
    """
    width, chain = max(x.width for x in widths), chain_regressor(source.q.units)
    results: list[Motion | None] = []
    least = np.inf
    for bodies in dict.fromkeys([rigid if exact else chain, None]):
        motions = [equations_of_motion(x, source.q, source.u, width, bodies) for x in widths]
        left = np.inf if motions[0] is None else float(np.median(motions[0].usual()))
        if not results or left < least / 2:
            results, least = motions, left
        if left < _FITS:
            break
    return results


def _coordinates_measured(
    source: logs.LogSource,
    parts: Sequence[logs.Recording],
    data: Averages,
    structure: Structure | None,
    step: float,
) -> list[Measurement]:
    """Measure wraps of angles and the lag of velocities."""
    free = [False] * len(source.q.columns) if structure is None else _free(structure)
    results = check_angles(data, source.q, free)
    if source.v is not None:
        results += check_velocity_lag(parts, source.q, source.v, step, data.width)
    return results


def _regressor(structure: Structure | None, inputs: int) -> Regressor | None:
    """Return the regressor of a robot with an input per joint."""
    square = structure is not None and structure.num_coordinates == inputs
    return regressor(structure) if structure is not None and square else None


def _free(structure: Structure) -> list[bool]:
    """Return true for coordinates whose joints turn without end."""
    limits = getattr(structure, "limits", None)
    if limits is None:
        return [False] * structure.num_coordinates
    return [abs(high - low - 2 * np.pi) < 1e-6 for low, high in limits[:, :2].tolist()]


def _held(rows: int, step: float) -> Measurement:
    text = (
        f"q is held at {1 / (rows * step):.3g} Hz: all columns repeat for {rows} rows; add the "
        "steps below to the data set, and check it again: the equation of motion is not yet checked"
    )
    return _judged("rows between two values of q", "q", rows, "1", True, text)


def _lines(source: logs.LogSource, held: Sequence[int], rows: int, step: float) -> list[str]:
    """Return steps that draw lines between the values of held signals, and thin out held rows."""
    longest = max(held, default=1)
    if max(longest, rows) == 1:
        return []
    signals = ["u"]
    if rows > 1:
        of_u = max((held_rows(x.raw.u) for x in source.cleaned), default=1)
        signals = ["q"] + ["v"] * (source.v is not None) + ["u"] * (of_u > 1)
        longest = max(rows, of_u)
    step_text = wording.step("InterpolateHeld", longest=2 * longest, signals=signals)
    lines = [wording.line(_key(source, "interpolate"), step_text)]
    if rows > 1:
        rate, gap = round_rate(rows * step), float(f"{10 * rows * step:.3g}")
        resample = wording.step("Resample", rate=rate, max_gap=gap)
        lines.append(wording.line(_key(source, "resample_held"), resample))
    return lines


def _candidates(
    source: logs.LogSource, structure: Structure | None, *, servo: bool, dry: bool, fast: bool
) -> list[tuple[str, list[str]]]:
    """Return models of a training, each with a reason, and their options."""
    friction = ["model/friction=coulomb"] * dry
    if servo:
        options = ["model/input=servo", "model/integrator=rosenbrock", *friction]
        return [("the inputs are targets of servos", ["model=lnn", *options])]
    units = set(source.u.units)
    if fast:
        reason = "angles turn too far between two samples for an equation of motion"
        return [(reason, ["model=mlp"])]
    if structure is None and units and units <= _OF_MOTORS:
        reason = (
            "the inputs are positions or pressures of motors, no forces: a soft robot has more "
            "modes than coordinates"
        )
        return [(reason, ["experiment=oscillators"])]
    reason = "the inputs are forces" + ", the joints have dry friction" * dry
    forces = [(reason, ["model=lnn", *friction])]
    if structure is not None or units <= _FORCES:
        return forces
    return [
        ("if the inputs are forces or torques", ["model=lnn", *friction]),
        ("if they are positions or pressures of motors", ["experiment=oscillators"]),
        ("if neither holds: a black box", ["model=mlp"]),
    ]


def _follows_targets(
    source: logs.LogSource, training: list[logs.Recording], step: float, longest: float
) -> bool:
    """Tell whether the inputs are targets that the coordinates follow."""
    same_units = source.u.units[: len(source.q.units)] == source.q.units
    return same_units and numbers.target_distance(training, step, longest) < _TARGET


def _inputs_measured(
    source: logs.LogSource,
    data: Averages,
    delays: Sequence[DelayCurve],
    clear: Sequence[float],
) -> list[Measurement]:
    """Measure the share of the motion that the inputs explain, and their delays."""
    if not delays:
        return []
    acting = [curve.delay or 0.0 for curve in delays]
    data = replace(data, u=data.u[:, : len(delays)])
    share = numbers.explained_share(
        data.delayed([a - c for a, c in zip(acting, clear, strict=True)])
    )
    text = (
        f"the inputs explain {100 * share:.2g} % of the motion, at any delay: are these the "
        "inputs of this robot, on the same clock?"
    )
    name, bad = "share of the motion that inputs add to (1, q, v)", share < _EXPLAINED
    expected = f"at least {_EXPLAINED}"
    results = [_judged(name, "inputs", share, expected, bad, text, "stop")]
    for name, curve, lag in zip(source.u.columns, delays, clear, strict=True):
        delay = np.nan if curve.delay is None else 1e3 * curve.delay
        text = (
            f"input {name!r} acts {1e3 * lag:.3g} ms after it is logged: add the delay below to "
            "the data set"
        )
        results.append(_judged("delay [ms]", name, delay, "no clear delay", lag > 0, text))
    return results


def _excitation(
    structure: Structure,
    motions: Sequence[Trajectory],
    coordinates: pd.DataFrame,
    highest: float,
    step: float,
) -> RigidExcitation:
    longest = max(item.duration for item in motions)
    # At least three periods of the cutoff are in the longest motion.
    cutoff = min(max(4 * highest, 1.0, 3.01 / longest), 0.4 / step)
    still = (coordinates["noise / range"] > _STILL).tolist()
    return rigid_excitation(structure, motions, cutoff=cutoff, still=still)


def _condition(excitation: RigidExcitation) -> Measurement:
    condition, open_joints = excitation.condition, ", ".join(excitation.open_joints)
    text = (
        f"the rigid-body regressor has the condition number {condition:.3g}: these motions do "
        f"not determine constants of {open_joints}; use more frequencies, poses and speeds"
    )
    name = f"condition number of {excitation.count} base parameters"
    return _judged(name, "training", condition, f"below {MOST:g}", condition > MOST, text)


def _inputs_table(
    source: logs.LogSource, training: list[logs.Recording], delays: Sequence[DelayCurve]
) -> pd.DataFrame:
    u = np.vstack([item.u[:, : len(delays)] for item in training])
    table = {
        "input": source.input_labels[: len(delays)],
        "min": u.min(axis=0),
        "max": u.max(axis=0),
        "delay [ms]": [np.nan if x.delay is None else 1e3 * x.delay for x in delays],
        "± [ms]": [np.nan if x.delay is None else 1e3 * INTERVAL * x.spread for x in delays],
        "dry friction": [x.friction for x in delays],
        "method": [x.reason or x.form for x in delays],
    }
    return pd.DataFrame(table)


def _run(part: logs.Cleaned) -> dict[str, object]:
    spacing = np.diff(part.raw.t)
    usual = float(np.median(spacing)) or float(spacing.mean())  # rounded stamps may repeat
    return {
        "run": part.raw.run,
        "split": part.split,
        "duration [s]": part.raw.duration,
        "rows": len(part.raw),
        "sample time [ms]": 1e3 * usual,
        "jitter [%]": round(100 * float(np.percentile(np.abs(spacing - usual), 95)) / usual, 3),
        "longest gap [ms]": 1e3 * float(spacing.max()),
    }


def _coordinates(
    source: logs.LogSource, training: list[logs.Recording], test: Sequence[Trajectory]
) -> pd.DataFrame:
    q = np.vstack([item.q for item in training])
    v = np.vstack([item.v for item in training if item.v is not None])
    raw = [x.raw.q for x in source.cleaned if x.split == "train" and len(x.raw) > 10]
    noise = np.median([white_noise(x) for x in raw], axis=0)
    tested = np.vstack([item.q.numpy() for item in test])
    low, high = q.min(axis=0), q.max(axis=0)
    outside = (tested < low) | (tested > high)
    all_poses = (np.array(source.q.units) == "rad") & (high - low > 2 * np.pi)
    table = {
        "coordinate": source.labels,
        "min": low,
        "max": high,
        "fastest [/s]": np.abs(v).max(axis=0),
        "noise of q": noise,
        "noise / range": noise / (high - low).clip(min=1e-300),
        "test outside": np.where(all_poses, 0.0, outside.mean(axis=0)),
    }
    return pd.DataFrame(table)


def _limited(coordinates: pd.DataFrame) -> list[Measurement]:
    results = []
    for name, limit, text in _LIMITS:
        for label, value in zip(coordinates["coordinate"], coordinates[name], strict=True):
            message = f"{label}: {text.format(100 * value)}"
            results.append(_judged(name, label, value, f"below {limit}", value > limit, message))
    return results


def _filter(
    source: logs.LogSource,
    training: list[logs.Recording],
    step: float,
    coordinates: pd.DataFrame,
    highest: float,
) -> list[str]:
    noise = coordinates["noise of q"].to_numpy()
    v = np.vstack([np.diff(item.q, axis=0) / step for item in training])
    share = float((2**0.5 * noise / step / v.std(axis=0).clip(min=1e-300)).max())
    cutoff = float(f"{max(4 * highest, 1.0):.2g}")
    filters = (logs.Butterworth, logs.MovingAverage)
    filtered = any(isinstance(x, filters) for x in source.steps.values())
    if filtered or share < _NOISE or not cutoff < 0.4 / step:
        return []
    reason = f"noise is {100 * share:.2g} % of the steps of q, the motion ends at {highest:.2g} Hz"
    return [
        wording.line(_key(source, "filter"), wording.step("Butterworth", cutoff=cutoff), reason)
    ]


def _delay(source: logs.LogSource, delays: Sequence[float]) -> float | list[float] | None:
    """Return the delay of the data set with the measured delays added, rounded to 0.1 ms."""
    if not any(delays):
        return None
    total = (np.resize(source.delay, len(delays)) + np.array(delays)).round(4).tolist()
    return total[0] if len(set(total)) == 1 else total


def _key(source: logs.LogSource, name: str) -> str:
    """Return a name for a step that no step of the data set has."""
    names = itertools.chain([name], (f"{name}_{k}" for k in itertools.count(2)))
    return next(key for key in names if key not in source.steps)
