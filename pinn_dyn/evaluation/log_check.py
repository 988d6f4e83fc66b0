"""The check of a log before a training: measurements, each with a verdict."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from pydantic import PositiveFloat

from pinn_dyn.data.logs import (
    Butterworth,
    Cleaned,
    DelayCurve,
    LogSource,
    Measurement,
    MovingAverage,
    Recording,
    agreed_delays,
)
from pinn_dyn.data.logs.measurement import judged
from pinn_dyn.data.whole import write_whole
from pinn_dyn.evaluation.log_numbers import (
    bandwidth,
    distance_from,
    explained_share,
    independent_shares,
    white_noise,
)
from pinn_dyn.evaluation.rigid_excitation import MOST, RigidExcitation, rigid_excitation
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.known import Structure

_EXPLAINED = 0.1  # share of the motion that inputs explain, below which a training makes no sense
_NOISE = 0.02  # noise of q as a share of its range
_STILL = 0.25  # the same of a joint at rest
_FAR = 3.0  # distance of a test sample from the training
_OUTSIDE = 0.05  # share of the test
_ROWS = 50  # of a table in the terminal
_RANK = {"stop": 0, "warning": 1, "ok": 2}
# Column of the table of coordinates, its limit, and the text beyond it.
_LIMITS = (
    ("noise / range", "below", _NOISE, "its noise is {:.2g} % of its range"),
    (
        *("independent share of a", "at least", 0.01),
        "its q, v and the accelerations of the other coordinates explain its acceleration but for "
        "{:.2g} %, so its inertia cannot be told from stiffness, damping or the inertia of another "
        "joint; excite it with more frequencies",
    ),
    ("test outside", "below", _OUTSIDE, "{:.3g} % of the test is outside the training range"),
)
_judged = functools.partial(judged, section="bags_and_other_logs.md#is-the-log-good-enough")


@dataclass(frozen=True)
class LogCheck:
    """Measurements of a log, and the numbers behind them.

    Attributes:
        source: the log.
        measurements: the measurements, each with its verdict.
        runs, coordinates, inputs: tables of stretches, coordinates and inputs.
        delays: delay curve of each input.
        distance: distance of the test samples from the nearest training sample, ``(S,)``; 1 is the
            distance between tenths of the training.
        steps: lines for the YAML of the data set: filter cutoff and delay, if needed.
        rigid: excitation of the base parameters of a rigid robot; None without a structure.
    """

    source: LogSource
    measurements: list[Measurement]
    runs: pd.DataFrame
    coordinates: pd.DataFrame
    inputs: pd.DataFrame
    delays: list[DelayCurve]
    distance: np.ndarray
    steps: list[str]
    rigid: RigidExcitation | None = None

    @property
    def problems(self) -> list[str]:
        """Reasons why a training makes no sense."""
        return [x.text for x in self.measurements if x.verdict == "stop"]

    @property
    def warnings(self) -> list[str]:
        """Texts of the warnings."""
        return [x.text for x in self.measurements if x.verdict == "warning"]

    def table(self) -> pd.DataFrame:
        """Return one row per measurement, stops and warnings first."""
        frame = pd.DataFrame(self.measurements).rename(
            columns={"name": "measurement", "place": "of", "text": "explanation", "section": "docs"}
        )
        frame.insert(0, "verdict", frame.pop("verdict"))
        return frame.sort_values("verdict", key=lambda x: x.map(_RANK), kind="stable")

    def __str__(self) -> str:
        tables = {
            "Runs": self.runs,
            "Coordinates": self.coordinates,
            "Inputs": self.inputs,
            "Measurements": self.table()[["verdict", "measurement", "of", "value", "expected"]],
        }
        if self.rigid is not None:
            tables[f"Rigid bodies, not determined: {self.rigid.summary}"] = self.rigid.joints
        lines = [f"{self.source.name}: check of the log"]
        for title, frame in tables.items():
            more = f" (the first {_ROWS} of {len(frame)})" if len(frame) > _ROWS else ""
            number = "{:.3g}".format
            text = frame.head(_ROWS).to_string(index=False, na_rep="", float_format=number)
            lines += ["", title + more, text]
        for x in self.measurements:
            if x.verdict != "ok":
                lines += ["", f"{x.verdict}: {x.text} (docs/{x.section})"]
        if self.steps:
            lines += ["", "steps:", *(f"  {line}" for line in self.steps)]
        verdict = "no sense" if self.problems else "sense"
        return "\n".join([*lines, "", f"Verdict: a training makes {verdict}"])

    def save(self, folder: str | Path, command: str = "") -> Path:
        """Write ``check.html``, ``measurements.csv`` and ``log_report.md``; return the page.

        Args:
            folder: the folder, made if missing.
            command: command line, for the page.
        """
        from pinn_dyn.evaluation.report.check_page import check_report

        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "check.html", check_report(self, command=command))
        write_whole(folder / "measurements.csv", self.table().to_csv(index=False))
        write_whole(folder / "log_report.md", self.source.report)
        return folder / "check.html"


def check(
    source: LogSource,
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
    training = [
        replace(item, u=item.u[:, :inputs])  # without rates of the inputs
        for part in source.cleaned
        if part.split == "train"
        for item in part.clean
    ]
    step = float(np.median(np.diff(training[0].t)))
    rigid = None
    if structure is not None:
        rigid = lambda *motion: structure.regressor(*map(torch.from_numpy, motion)).numpy()  # noqa: E731
    delays = agreed_delays(training, longest=longest_delay, rigid=rigid)
    coordinates = _coordinates(source, training, splits.test, step)
    noise = coordinates["noise of q"].to_numpy()
    highest = bandwidth(training, step, noise)
    distance = distance_from(training, splits.test)
    measurements = [
        *source.measurements,
        *_measured(coordinates, distance, explained_share(training, delays, step)),
        *(_lateness(name, x, step) for name, x in zip(source.u.columns, delays, strict=True)),
    ]
    excitation = None
    if structure is not None:
        longest = max(item.duration for item in splits.train)
        # At least three periods of the cutoff are in the longest motion.
        cutoff = min(max(4 * highest, 1.0, 3.01 / longest), 0.4 / step)
        still = (coordinates["noise / range"] > _STILL).tolist()
        excitation = rigid_excitation(structure, splits.train, cutoff=cutoff, still=still)
        measurements.append(_excitation(excitation))
    u = np.vstack([item.u for item in training])
    table = {
        "input": source.input_labels[:inputs],
        "min": u.min(axis=0),
        "max": u.max(axis=0),
        "delay [ms]": [np.nan if x.delay is None else 1e3 * x.delay for x in delays],
        "spread [ms]": [np.nan if x.delay is None else 1e3 * x.spread for x in delays],
        "method": [x.reason or x.form for x in delays],
    }
    return LogCheck(
        source,
        measurements,
        pd.DataFrame([_run(part) for part in source.cleaned]),
        coordinates,
        pd.DataFrame(table),
        delays,
        distance,
        [*_filter(source, training, step, noise, highest), *_delay(delays, step)],
        excitation,
    )


def _run(part: Cleaned) -> dict[str, object]:
    spacing = np.diff(part.raw.t)
    usual = float(np.median(spacing))
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
    source: LogSource, training: list[Recording], test: Sequence[Trajectory], step: float
) -> pd.DataFrame:
    q = np.vstack([item.q for item in training])
    v = np.vstack([item.v for item in training if item.v is not None])
    raw = [x.raw for x in source.cleaned if x.split == "train" and len(x.raw) > 10]
    noise = np.median([white_noise(item.q) for item in raw], axis=0)
    tested = np.vstack([item.q.numpy() for item in test])
    low, high = q.min(axis=0), q.max(axis=0)
    return pd.DataFrame(
        {
            "coordinate": source.labels,
            "min": low,
            "max": high,
            "fastest [/s]": np.abs(v).max(axis=0),
            "noise of q": noise,
            "noise / range": noise / np.ptp(q, axis=0).clip(min=1e-300),
            "test outside": ((tested < low) | (tested > high)).mean(axis=0),
            "independent share of a": independent_shares(training, step),
        }
    )


def _measured(
    coordinates: pd.DataFrame, distance: np.ndarray, explained: float
) -> list[Measurement]:
    """Measure noise, excitation, coverage of the test, and whether inputs explain the motion."""
    results = []
    for name, limit, bound, text in _LIMITS:
        for label, value in zip(coordinates["coordinate"], coordinates[name], strict=True):
            bad = value > bound if limit == "below" else value < bound
            message = f"{label}: {text.format(100 * value)}"
            results.append(_judged(name, label, value, f"{limit} {bound}", bad, message))
    far = float((distance > _FAR).mean())
    text = (
        f"{100 * far:.0f} % of the test is {_FAR:g} times further from the training than tenths of "
        "it are from each other"
    )
    measured = ("share of the test far away", "", far, f"below {_OUTSIDE}", far > _OUTSIDE)
    results.append(_judged(*measured, text))
    text = (
        f"the inputs explain {100 * explained:.2g} % of the motion, at any delay: are these the "
        "inputs of this robot, on the same clock?"
    )
    name, expected = "share of the motion that inputs add to (1, q, v)", f"at least {_EXPLAINED}"
    bad = explained < _EXPLAINED
    return [*results, _judged(name, "inputs", explained, expected, bad, text, "stop")]


def _lateness(name: str, curve: DelayCurve, step: float) -> Measurement:
    """Return the delay of an input; a delay of a sample or more is a warning."""
    delay = np.nan if curve.delay is None else 1e3 * curve.delay
    text = (
        f"input {name!r} acts {delay:.0f} ms after it is logged: add the InputDelay step below, or "
        "learn the delay with the model (model/delay=learned)"
    )
    return _judged("delay [ms]", name, delay, "below a sample", delay > 750 * step, text)


def _excitation(excitation: RigidExcitation) -> Measurement:
    """Measure whether the motion determines the base parameters of a rigid robot."""
    condition = excitation.condition
    text = (
        f"the rigid-body regressor has the condition number {condition:.3g}, expected less than "
        f"{MOST:g}: these motions do not determine constants of "
        f"{', '.join(excitation.open_joints)}; excite them by more frequencies, poses and speeds"
    )
    name = f"condition number of {excitation.count} base parameters"
    return _judged(name, "training", condition, f"below {MOST:g}", condition > MOST, text)


def _filter(
    source: LogSource, training: list[Recording], step: float, noise: np.ndarray, highest: float
) -> list[str]:
    """Return the low-pass between motion and noise, where noise matters and no step filters."""
    if any(isinstance(x, (Butterworth, MovingAverage)) for x in source.steps.values()):
        return []
    v = np.vstack([np.diff(item.q, axis=0) / step for item in training])
    share = float((2**0.5 * noise / step / v.std(axis=0).clip(min=1e-300)).max())
    cutoff = float(f"{max(4 * highest, 1.0):.2g}")
    if share < _NOISE or not cutoff < 0.4 / step:
        return []
    return [
        f"filter: {{_target_: pinn_dyn.data.logs.Butterworth, cutoff: {cutoff:g}}} # noise is "
        f"{100 * share:.2g} % of the steps of q, and the motion ends at {highest:.2g} Hz"
    ]


def _delay(delays: Sequence[DelayCurve], step: float) -> list[str]:
    """Return the step that shifts the inputs by their measured delays."""
    shifts = [round(round((curve.delay or 0.0) / step) * step, 6) for curve in delays]
    if not any(shifts):
        return []
    value = shifts[0] if len(set(shifts)) == 1 else shifts
    return [f"delay: {{_target_: pinn_dyn.data.logs.InputDelay, delay: {value}}} # s"]
