"""The check of a log before a training: measurements, each with a verdict."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
from pydantic import PositiveFloat

from pinn_dyn import wording
from pinn_dyn.data import logs
from pinn_dyn.data.bandwidth import bandwidth
from pinn_dyn.data.logs.check.averages import white_noise
from pinn_dyn.data.logs.check.delay import INTERVAL
from pinn_dyn.data.logs.check.input_faults import input_faults
from pinn_dyn.data.logs.measurement import Measurement, judged
from pinn_dyn.identification.rigid_excitation import MOST, RigidExcitation, rigid_excitation
from pinn_dyn.log_check import numbers
from pinn_dyn.log_check.page import LogCheck
from pinn_dyn.log_check.structure import compare_structure, regressor
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.structure import Structure

_EXPLAINED = 0.1  # share of the motion that inputs explain, below which a training makes no sense
_NOISE, _STILL = 0.02, 0.25  # noise of q as a share of its range; the same of a joint at rest
_TARGET = 0.3  # part of the variance of q that the targets of servos leave
_OUTSIDE = 0.05  # share of the test outside the range of the training
_OF_MOTORS = {"rad", "m", "Pa"}  # units of motor angles, lengths of tendons, and pressures
# Settings that were the best on a real trunk, docs/what_we_tried.md.
_TURNED = np.pi / 2  # rad per sample, above which no step fits
# Column of the table of coordinates, its upper limit, and the text beyond it.
_LIMITS = (
    ("noise / range", _NOISE, "its noise is {:.2g} % of its range"),
    ("test outside", _OUTSIDE, "{:.3g} % of the test is outside the training range"),
)
_judged = partial(judged, section="docs/bags_and_other_logs.md#is-the-log-good-enough")


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
    training = [item for x in source.cleaned if x.split == "train" for item in x.clean]
    training = [replace(item, u=item.u[:, :inputs]) for item in training]  # no rates of inputs
    step = float(np.median(np.diff(training[0].t)))
    square = structure is not None and structure.num_coordinates == inputs
    rigid = regressor(structure) if structure is not None and square else None
    delays = logs.input_delays(training, longest=longest_delay, rigid=rigid)
    faults, delays = input_faults(training, delays, source.u, step, rigid)
    everything = [item for x in source.cleaned for item in x.clean]
    columns = source.q, source.u
    motion, equations = logs.equations_of_motion(
        everything, *columns, step, curves=delays, rigid=rigid
    )
    runs = logs.check_runs(everything, *columns, motion, equations, curves=delays, rigid=rigid)
    # A fault of an input explains runs that differ, and signs.
    runs = [] if any(x.verdict != "ok" for x in faults) else runs
    before = [x for x in source.measurements if x.name not in {logs.RESIDUAL, logs.INERTIA}]
    coordinates = _coordinates(source, training, splits.test)
    noise = coordinates["noise of q"].to_numpy()
    highest = bandwidth([item.q for item in training], step, noise)
    servo = _follows_targets(source, training, step, longest_delay)
    # The lag of a servo is no delay.
    clear = [0.0] * inputs if servo else logs.clear_delays(delays, step)
    measurements = [*before, *runs, *faults, *_limited(coordinates)]
    measurements += _inputs_measured(source, training, delays, clear, step)
    excitation = None
    if structure is not None:
        measurements += compare_structure(structure, training, delays, source.u, step)
        excitation = _excitation(structure, splits.train, coordinates, highest, step)
        measurements.append(_condition(excitation))
    dry = any(x.dry for x in delays)
    # A filter smears reversals of dry friction.
    filtered = not (dry and source.v is not None)
    angles = [unit == "rad" for unit in source.q.units]
    fast = (coordinates["fastest [/s]"] * step > _TURNED)[angles].any()
    options = ["model/input=servo", "model/integrator=rosenbrock"] * servo
    options += ["model/friction=coulomb"] * dry
    motors = structure is None and not servo and set(source.u.units[:inputs]) <= _OF_MOTORS
    if motors:
        options = ["experiment=oscillators"]
    return LogCheck(
        source=source,
        measurements=measurements,
        runs=pd.DataFrame([_run(part) for part in source.cleaned]),
        coordinates=coordinates,
        inputs=_inputs_table(source, training, delays),
        delays=delays,
        steps=_filter(source, training, step, coordinates, highest) if filtered else [],
        delay=_delay(source, clear),
        options=[] if fast else options,
        model="oscillators" if motors else "lnn",
        rigid=excitation,
        motion=motion,
        equations=equations,
    )


def _follows_targets(
    source: logs.LogSource, training: list[logs.Recording], step: float, longest: float
) -> bool:
    """Tell whether the inputs are targets that the coordinates follow."""
    same_units = source.u.units[: len(source.q.units)] == source.q.units
    return same_units and numbers.target_distance(training, step, longest) < _TARGET


def _inputs_measured(
    source: logs.LogSource,
    training: list[logs.Recording],
    delays: Sequence[logs.DelayCurve],
    clear: Sequence[float],
    step: float,
) -> list[Measurement]:
    """Measure the share of the motion that the inputs explain, and their delays."""
    if not delays:
        return []
    share = numbers.explained_share(training, delays, step)
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
    source: logs.LogSource, training: list[logs.Recording], delays: Sequence[logs.DelayCurve]
) -> pd.DataFrame:
    u = np.vstack([item.u for item in training])
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
    table = {
        "coordinate": source.labels,
        "min": low,
        "max": high,
        "fastest [/s]": np.abs(v).max(axis=0),
        "noise of q": noise,
        "noise / range": noise / (high - low).clip(min=1e-300),
        "test outside": ((tested < low) | (tested > high)).mean(axis=0),
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
