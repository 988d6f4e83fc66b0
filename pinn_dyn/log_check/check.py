"""The check of a log before a training: measurements, each with a verdict."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
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
from pinn_dyn.log_check.chain import chain_regressor, check_order
from pinn_dyn.log_check.delay import (
    INTERVAL,
    DelayCurve,
    are_held,
    clear_delays,
    input_delays,
)
from pinn_dyn.log_check.equation import Regressor
from pinn_dyn.log_check.figures import residuals
from pinn_dyn.log_check.input_faults import DRIFT, HELD, SATURATED, input_faults
from pinn_dyn.log_check.numbers import check_angles, check_velocity_lag
from pinn_dyn.log_check.page import LogCheck, store, stored
from pinn_dyn.log_check.runs import (
    Equation,
    Interval,
    check_rests,
    check_runs,
    equation_of_motion,
)
from pinn_dyn.log_check.structure import (
    StructureFit,
    compare_structure,
    fit_structure,
    regressor,
)
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
    rigid = _Log(source, structure).rigid
    if stored(source, rigid) is None and structure is not None:
        check(source, structure=structure)
    return stored(source, rigid) or []


def residual_figure(source: logs.LogSource, structure: Structure) -> Figure | None:
    """Draw what the rigid bodies leave of the forces over q and over v, per joint.

    The result is None with another number of inputs than joints, or with too few rows.
    """
    log = _Log(source, structure)
    widths = [] if log.rigid is None else log.of_training(log.widths)
    if not widths:
        return None
    data = widths[compared(widths)[0]]
    motion = equation_of_motion(data, source.q, source.u, data.width, log.rigid)
    return None if motion is None else residuals(motion, source.q, source.v, source.u)


@dataclass(frozen=True)
class _Log:
    """A log, and what is known before its equation of motion.

    Attributes:
        source: the log.
        structure: kinematics of its robot, or None.
        longest_delay: longest delay of an input that is tried, s.
    """

    source: logs.LogSource
    structure: Structure | None
    longest_delay: float = 0.3

    @cached_property
    def training(self) -> list[logs.Recording]:
        """Stretches of the training."""
        return self._stretches("train")

    def _stretches(self, *splits: str) -> list[logs.Recording]:
        inputs, parts = len(self.source.u.columns), self.source.cleaned
        stretches = [item for x in parts if x.split in splits for item in x.clean]
        return [replace(item, u=item.u[:, :inputs]) for item in stretches]  # no rates of inputs

    @cached_property
    def step(self) -> float:
        """Sample time, s."""
        return float(np.median(np.diff(self.training[0].t)))

    @property
    def square(self) -> bool:
        """True for an input per coordinate."""
        return len(self.source.u.columns) == len(self.source.q.columns)

    @cached_property
    def rigid(self) -> Regressor | None:
        """Regressor of a robot with an input per joint, or None."""
        inputs = len(self.source.u.columns)
        if self.structure is None or self.structure.num_coordinates != inputs:
            return None
        return regressor(self.structure)

    @cached_property
    def servo(self) -> bool:
        """True if the inputs are targets that the coordinates follow."""
        units = self.source.q.units
        if self.source.u.units[: len(units)] != units:
            return False
        return numbers.target_distance(self.training, self.step, self.longest_delay) < _TARGET

    @cached_property
    def parts(self) -> list[logs.Recording]:
        """Stretches of the training, or parts of long ones."""
        return parts_of(self.training, self.step)

    @cached_property
    def widths(self) -> list[Averages]:
        """Averages of all stretches with kernels of a few widths."""
        everything = [*self.parts, *parts_of(self._stretches("validation", "test"), self.step)]
        if len(self.source.u.columns) > len(self.source.q.columns):
            everything = [with_products(item) for item in everything]
        return averages_of_widths(everything, self.step)

    def of_training(self, widths: Sequence[Averages]) -> list[Averages]:
        """Return the averages of the training."""
        return [x.rows(x.stretch < len(self.parts)) for x in widths]

    def clear_delays(self, curves: Sequence[DelayCurve]) -> list[float]:
        """Return the clear delay of each input, s; 0 for others, as for the lag of a servo."""
        return [0.0] * len(curves) if self.servo else clear_delays(curves, self.step)


@dataclass
class _Answers:
    """Answers of the equation of motion to the questions about a log.

    Attributes:
        curves: delay curve of each input.
        clear: delay of each input that is clear, s; 0 for others.
        held: rows for which the values of an input repeat, where its motion follows lines; else 1.
        measurements: measurements.
        late: averages with kernels of two widths, and inputs as they act.
        motion: equation of motion; None if the rows are too few.
        fit: comparison with the bodies of a URDF.
        driven: joint that each input drives, if there are fewer inputs than coordinates.
        odd: parts of runs that do not fit the others.
        of_parts: measurements of these parts.
    """

    curves: list[DelayCurve]
    clear: list[float]
    held: list[int]
    measurements: list[Measurement]
    late: Sequence[Averages] = ()
    motion: Equation | None = None
    fit: StructureFit | None = None
    driven: Sequence[int] = ()
    odd: Sequence[Interval] = ()
    of_parts: Sequence[Measurement] = ()


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
    log = _Log(source, structure, longest_delay)
    training, step, inputs = log.training, log.step, len(source.u.columns)
    coordinates = _coordinates(source, training, splits.test)
    noise = coordinates["noise of q"].to_numpy()
    highest = bandwidth([item.q for item in training], step, noise)
    rows = max(held_rows(item.q) for x in source.cleaned for item in x.clean)
    if rows > 1:  # the acceleration of held values means nothing
        answers = _Answers([], [0.0] * inputs, [rows] * inputs, [_held(rows, step)])
    elif any(x.name == STATE and x.verdict == "stop" for x in source.measurements):
        answers = _Answers([], [0.0] * inputs, [1] * inputs, [])
    else:
        answers = _answers(log)
    store(source, log.rigid, answers.measurements)
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
        hold=source.interpolation == "linear" and not log.servo and are_held(answers.curves, step),
        candidates=_candidates(source, structure, servo=log.servo, dry=dry, fast=bool(fast)),
        driven=answers.driven,
        rigid=excitation,
        motion=answers.motion,
    )


def _answers(log: _Log) -> _Answers:
    """Ask the equation of motion, without the parts of runs that do not fit the others."""
    answers = _asked(log, log.widths)
    if answers.odd:
        odd = [np.any([x.of(data) for x in answers.odd], axis=0) for data in log.widths]
        again = _asked(log, [x.rows(~rows) for x, rows in zip(log.widths, odd, strict=True)])
        if not _are_bad(again.measurements, SATURATED):  # which odd parts look like
            names = {x.name for x in answers.of_parts}
            kept = [x for x in again.measurements if x.name not in names]
            answers = replace(again, measurements=[*answers.of_parts, *kept])
    if answers.late:
        _describe(log, answers)
    return answers


def _are_bad(measurements: Sequence[Measurement], *names: str) -> bool:
    """Tell whether a measurement of these names is not ok."""
    return any(x.name in names and x.verdict != "ok" for x in measurements)


def _asked(log: _Log, widths: Sequence[Averages]) -> _Answers:
    """Ask for the order, the faults and the delays of the inputs, and compare the runs."""
    source, rigid = log.source, log.rigid
    training, longest = log.of_training(widths), log.longest_delay
    curves = input_delays(log.parts, longest=longest, rigid=rigid, widths=training)
    if not widths:
        return _Answers(curves, [0.0] * len(curves), [1] * len(curves), [])
    chosen, order = [widths[k] for k in compared(widths)], None
    if not log.servo:
        delays = log.clear_delays(curves)
        order = check_order([x.delayed(delays) for x in chosen], source.u, source.q.units)
    faults, curves, held = input_faults(log.of_training(chosen), curves, source.u, rigid)
    if order is not None and log.square and order.joints != sorted(order.joints):
        curves = [x.without("the inputs are exchanged") for x in curves]
    clear = log.clear_delays(curves)
    late = [x.delayed(clear) for x in chosen]
    if order is not None and log.square:
        late = [order.corrected(x) for x in late]
    fit = None if log.structure is None else fit_structure(log.structure, log.of_training(late))
    fits = fit is None or not fit.bad
    narrow, wide = _equations(log, late, fits)
    answers = _Answers(curves, clear, held, faults, late, narrow, fit)
    if order is not None and not log.square:
        answers.driven = order.joints
    # A fault of an input or of the clock explains runs that differ.
    if _are_bad([*faults, *source.measurements], DRIFT, HELD, LOST):
        return answers
    names = list(dict.fromkeys(item.run for item in late[0].recordings))
    answers.of_parts, answers.odd = check_rests(narrow, wide, names)
    if not answers.odd:
        of_runs, answers.odd = check_runs(narrow, wide, names, exact=fits)
        answers.of_parts = [*answers.of_parts, *of_runs]
    if not _are_bad(faults, SATURATED):
        of_order = [] if order is None else order.measurements
        answers.measurements = [*answers.of_parts, *of_order, *faults]
    return answers


def _describe(log: _Log, answers: _Answers) -> None:
    """Add what the averages say of coordinates, inputs and the URDF to the answers."""
    source, data = log.source, answers.late[0]
    of_robot: list[Measurement] = []
    if answers.fit is not None and log.structure is not None:
        of_robot, wrong = compare_structure(log.structure, answers.fit, source.u)
        if wrong:  # whose delays are wrong, too
            for k in (k for k in wrong if answers.curves[k].of_bodies):
                answers.curves[k] = answers.curves[k].without(_WRONG)
            answers.clear = log.clear_delays(answers.curves)
            answers.motion = equation_of_motion(data, source.q, source.u, data.width, log.rigid)
    answers.measurements += check_angles(data, source.q, _free(log))
    if source.v is not None:
        answers.measurements += check_velocity_lag(data, source.q, source.v)
    (training,) = log.of_training([data])
    answers.measurements += _inputs_measured(source, training, answers.curves, answers.clear)
    answers.measurements += of_robot


def _equations(log: _Log, widths: Sequence[Averages], fits: bool) -> list[Equation | None]:
    """Return the equations with kernels of two widths.

    They are those of rigid bodies, or of a chain of unknown bodies. If these leave a part, those of
    single joints are used if they leave half of that: they have many more constants.
    """
    q, u, width = log.source.q, log.source.u, max(x.width for x in widths)

    def equations(bodies: Regressor | None) -> tuple[list[Equation | None], float]:
        results = [equation_of_motion(x, q, u, width, bodies) for x in widths]
        first = results[0]
        return results, np.inf if first is None else float(np.median(first.usual()))

    chain = chain_regressor(q.units) if log.square else None
    bodies = log.rigid if log.rigid is not None and fits else chain
    results, left = equations(bodies)
    if bodies is not None and left >= _FITS:
        of_joints, least = equations(None)
        results = of_joints if least < left / 2 else results
    return results


def _free(log: _Log) -> list[bool]:
    """Return true for coordinates whose joints turn without end."""
    limits = getattr(log.structure, "limits", None)
    if limits is None:
        return [False] * len(log.source.q.columns)
    return [abs(high - low - 2 * np.pi) < 1e-6 for low, high in limits[:, :2].tolist()]


def _held(rows: int, step: float) -> Measurement:
    return _judged(
        name="rows between two values of q",
        place="q",
        value=rows,
        expected="1",
        bad=True,
        text=f"q is held at {1 / (rows * step):.3g} Hz: all columns repeat for {rows} rows; add "
        "the steps below to the data set, and check it again: the equation of motion is not yet "
        "checked",
    )


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


def _inputs_measured(
    source: logs.LogSource,
    data: Averages,
    delays: Sequence[DelayCurve],
    clear: Sequence[float],
) -> list[Measurement]:
    """Measure the share of the motion that the inputs explain, and their delays."""
    if not delays:
        return []
    data = replace(data, u=data.u[:, : len(delays)])
    lags = [(curve.delay or 0.0) - lag for curve, lag in zip(delays, clear, strict=True)]
    share = numbers.explained_share(data.delayed(lags))
    of_motion = _judged(
        name="share of the motion that inputs add to (1, q, v)",
        place="inputs",
        value=share,
        expected=f"at least {_EXPLAINED}",
        bad=share < _EXPLAINED,
        text=f"the inputs explain {100 * share:.2g} % of the motion, at any delay: are these the "
        "inputs of this robot, on the same clock?",
        verdict="stop",
    )
    of_delays = [
        _judged(
            name="delay [ms]",
            place=name,
            value=np.nan if curve.delay is None else 1e3 * curve.delay,
            expected="no clear delay",
            bad=lag > 0,
            text=f"input {name!r} acts {1e3 * lag:.3g} ms after it is logged: add the delay below "
            "to the data set",
        )
        for name, curve, lag in zip(source.u.columns, delays, clear, strict=True)
    ]
    return [of_motion, *of_delays]


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
    return _judged(
        name=f"condition number of {excitation.count} base parameters",
        place="training",
        value=excitation.condition,
        expected=f"below {MOST:g}",
        bad=excitation.condition > MOST,
        text=f"the rigid-body regressor has the condition number {excitation.condition:.3g}: these "
        f"motions do not determine constants of {', '.join(excitation.open_joints)}; use more "
        "frequencies, poses and speeds",
    )


def _inputs_table(
    source: logs.LogSource, training: list[logs.Recording], delays: Sequence[DelayCurve]
) -> pd.DataFrame:
    u = np.vstack([item.u[:, : len(delays)] for item in training])
    return pd.DataFrame(
        {
            "input": source.input_labels[: len(delays)],
            "min": u.min(axis=0),
            "max": u.max(axis=0),
            "delay [ms]": [np.nan if x.delay is None else 1e3 * x.delay for x in delays],
            "± [ms]": [np.nan if x.delay is None else 1e3 * INTERVAL * x.spread for x in delays],
            "dry friction": [x.friction for x in delays],
            "method": [x.reason or x.form for x in delays],
        }
    )


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
    return pd.DataFrame(
        {
            "coordinate": source.labels,
            "min": low,
            "max": high,
            "fastest [/s]": np.abs(v).max(axis=0),
            "noise of q": noise,
            "noise / range": noise / (high - low).clip(min=1e-300),
            "test outside": np.where(all_poses, 0.0, outside.mean(axis=0)),
        }
    )


def _limited(coordinates: pd.DataFrame) -> list[Measurement]:
    return [
        _judged(
            name=name,
            place=label,
            value=value,
            expected=f"below {limit}",
            bad=value > limit,
            text=f"{label}: {text.format(100 * value)}",
        )
        for name, limit, text in _LIMITS
        for label, value in zip(coordinates["coordinate"], coordinates[name], strict=True)
    ]


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
