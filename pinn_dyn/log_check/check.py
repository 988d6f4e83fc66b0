"""The check of a log before a training: measurements, each with a verdict."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from pydantic import PositiveFloat

from pinn_dyn import wording
from pinn_dyn.data import logs
from pinn_dyn.data.bandwidth import bandwidth
from pinn_dyn.data.logs.check.checks import held_rows
from pinn_dyn.data.logs.check.plausibility import STATE
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.data.logs.recording import round_rate
from pinn_dyn.identification.rigid_excitation import MOST, RigidExcitation, rigid_excitation
from pinn_dyn.log_check.answers import OF_MOTORS, SECTION, Answers, Log, ask
from pinn_dyn.log_check.averages import compared, white_noise
from pinn_dyn.log_check.delay import INTERVAL, DelayCurve, are_held
from pinn_dyn.log_check.figures import residuals
from pinn_dyn.log_check.page import LogCheck, store, stored
from pinn_dyn.log_check.runs import equation_of_motion
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.structure import Structure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NOISE, _STILL = 0.02, 0.25  # noise of q as a share of its range; the same of a joint at rest
_OUTSIDE = 0.05  # share of the test outside the range of the training
_FORCES = {"Nm", "N", "A", "V"}
_TURNED = np.pi / 2  # rad per sample, above which no step fits
# Column of the table of coordinates, its upper limit, and the text beyond it.
_LIMITS = (
    ("noise / range", _NOISE, "its noise is {:.2g} % of its range"),
    ("test outside", _OUTSIDE, "{:.3g} % of the test is outside the training range"),
)
_judged = partial(judged, section=SECTION)


def verdict(source: logs.LogSource, structure: Structure | None = None) -> list[str]:
    """Return what is wrong with a log: of the last check of the same data and robot.

    Without a check, a log with a structure is checked now; the result is empty for others.
    """
    rigid = Log(source, structure).rigid
    if stored(source, rigid) is None and structure is not None:
        check(source, structure=structure)
    return stored(source, rigid) or []


def residual_figure(source: logs.LogSource, structure: Structure) -> Figure | None:
    """Draw what the rigid bodies leave of the forces over q and over v, per joint.

    The result is None with another number of inputs than joints, or with too few rows.
    """
    log = Log(source, structure)
    widths = [] if log.rigid is None else log.of_training(log.widths)
    if not widths:
        return None
    data = widths[compared(widths)[0]]
    motion = equation_of_motion(data, source.q, source.u, data.width, log.rigid)
    return None if motion is None else residuals(motion, source.q, source.v, source.u)


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
    log = Log(source, structure, longest_delay)
    training, step, inputs = log.training, log.step, len(source.u.columns)
    coordinates = _coordinates(source, training, splits.test)
    noise = coordinates["noise of q"].to_numpy()
    highest = bandwidth([item.q for item in training], step, noise)
    rows = max(held_rows(item.q) for x in source.cleaned for item in x.clean)
    if rows > 1:  # the acceleration of held values means nothing
        answers = Answers([], [0.0] * inputs, [rows] * inputs, [_held(rows, step)])
    elif any(x.name == STATE and x.verdict == "stop" for x in source.measurements):
        answers = Answers([], [0.0] * inputs, [1] * inputs, [])
    else:
        answers = ask(log)
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
    if structure is None and units and units <= OF_MOTORS:
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
            "delay [ms]": 1e3 * np.array([x.delay for x in delays], dtype=float),
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
