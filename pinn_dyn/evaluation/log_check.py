"""The check of a log before a training: measurements, each with a verdict."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from pydantic import PositiveFloat

from pinn_dyn.data.logs import (
    Butterworth,
    Cleaned,
    DelayCurve,
    LogError,
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
    independent_share,
    regressor_columns,
    share_at_rest,
    white_noise,
)
from pinn_dyn.evaluation.rigid_excitation import MOST, RigidExcitation, rigid_excitation
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.known import Structure

# A training makes no sense beyond these limits.
_LEAST_SAMPLES = 200
_LEAST_EXPLAINED = 0.1
_MOST_REST = 0.98
_STILL = 0.25  # noise of q as a share of its range
# A warning.
_NOISE = 0.02
_CONDITION = 1e3
_INDEPENDENT = 0.01
_FAR = 3.0
_OUTSIDE = 0.05
_ROWS = 20  # lines of a table in the terminal

_RANK = {"stop": 0, "warning": 1, "ok": 2}


@dataclass(frozen=True)
class LogCheck:
    """Measurements of a log, and the numbers behind them.

    Attributes:
        source: the log.
        measurements: the measurements, each with its verdict.
        runs: one row per stretch: split, duration, rows, sample time, jitter, longest gap.
        coordinates: one row per coordinate: range, noise, share of the acceleration that
            identifies its inertia.
        inputs: one row per input: range, delay and its spread, or why there is no delay.
        delays: delay curve of each input.
        distance: distance of the test samples from the nearest training sample, ``(S,)``; 1 is the
            distance between tenths of the training.
        rigid: excitation of the base parameters of a rigid robot; None without a structure.
        steps: cleaning steps for the YAML of the data set that follow from measurements.
    """

    source: LogSource
    measurements: list[Measurement]
    runs: pd.DataFrame
    coordinates: pd.DataFrame
    inputs: pd.DataFrame
    delays: list[DelayCurve]
    distance: np.ndarray
    rigid: RigidExcitation | None = None
    steps: list[str] = field(default_factory=list)

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
        rows = sorted(self.measurements, key=lambda x: _RANK[x.verdict])
        return pd.DataFrame(
            [[x.verdict, x.name, x.place, x.value, x.expected, x.text, x.section] for x in rows],
            columns=["verdict", "measurement", "of", "value", "expected", "explanation", "docs"],
        )

    def __str__(self) -> str:
        table = self.table()
        many = len(self.runs) > _ROWS
        parts = {
            "Runs": self.runs.head(_ROWS),
            f"{len(self.runs) - _ROWS} more runs are in the page" if many else "": None,
            "Coordinates": self.coordinates,
            "Inputs": self.inputs,
            **({} if self.rigid is None else {"Rigid bodies": self.rigid.joints}),
            "Measurements": table[["verdict", "measurement", "of", "value", "expected"]].head(50),
        }
        lines = [f"{self.source.name}: check of the log"]
        for title, frame in parts.items():
            lines += ["", title] if title else []
            if frame is not None:
                lines.append(frame.to_string(index=False, na_rep="", float_format="{:.3g}".format))
        if self.rigid is not None:
            lines.append(f"not determined: {self.rigid.summary(_ROWS)}")
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
    rigid = None if structure is None else functools.partial(_regressor, structure)
    delays, common = agreed_delays(training, longest=longest_delay, rigid=rigid)
    coordinates, condition = _coordinates(source, training, splits.test, step)
    noise = coordinates["noise of q"].to_numpy()
    highest = bandwidth(training, step, noise)
    distance = distance_from(training, splits.test)
    measurements = [
        *source.measurements,
        *_amount(training, explained_share(training, delays, step)),
        *_motion(coordinates, condition),
        *_coverage(coordinates, distance),
        *_delay_measurements(source, delays, step),
    ]
    excitation = None
    if structure is not None:
        longest = max(item.duration for item in splits.train)
        # At least three periods of the cutoff are in the longest motion.
        cutoff = min(max(4 * highest, 1.0, 3.01 / longest), 0.4 / step)
        still = (coordinates["noise / range"] > _STILL).tolist()
        try:
            excitation = rigid_excitation(structure, splits.train, cutoff=cutoff, still=still)
        except ValueError as error:
            raise LogError(f"the rigid-body regressor: {error}") from error
        measurements.append(_excitation(excitation))
    u = np.vstack([item.u for item in training])
    return LogCheck(
        source,
        measurements,
        pd.DataFrame([_run(part) for part in source.cleaned]),
        coordinates,
        pd.DataFrame(
            {
                "input": source.input_labels[:inputs],
                "min": u.min(axis=0),
                "max": u.max(axis=0),
                "delay [ms]": [np.nan if x.delay is None else 1e3 * x.delay for x in delays],
                "spread [ms]": [np.nan if x.delay is None else 1e3 * x.spread for x in delays],
                "method": [x.reason or f"{x.form}{', common' * common}" for x in delays],
            }
        ),
        delays,
        distance,
        excitation,
        [*_filter(source, training, step, noise, highest), *_delay(delays, step)],
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
) -> tuple[pd.DataFrame, float]:
    """Return one row per coordinate, and the condition number of (1, q, v, a)."""
    q = np.vstack([item.q for item in training])
    v = np.vstack([item.v for item in training if item.v is not None])
    raw = [x.raw for x in source.cleaned if x.split == "train" and len(x.raw) > 10]
    noise = np.median([white_noise(item.q) for item in raw], axis=0)
    # The noise of a derived velocity is not white.
    noise_of_v = [white_noise(item.v) for item in raw if item.v is not None]
    tested = np.vstack([item.q.numpy() for item in test])
    low, high = q.min(axis=0), q.max(axis=0)
    regressor = regressor_columns(training, step)
    size = q.shape[1]
    frame = pd.DataFrame(
        {
            "coordinate": source.labels,
            "min": low,
            "max": high,
            "fastest [/s]": np.abs(v).max(axis=0),
            "noise of q": noise,
            "noise / range": noise / np.ptp(q, axis=0).clip(min=1e-300),
            **({"noise of v": np.median(noise_of_v, axis=0)} if noise_of_v else {}),
            "test outside": ((tested < low) | (tested > high)).mean(axis=0),
            "independent share of a": [independent_share(regressor, k, size) for k in range(size)],
        }
    )
    scaled = regressor / np.linalg.norm(regressor, axis=0).clip(min=1e-300)
    return frame, float(np.linalg.cond(scaled))


def _regressor(structure: Structure, *motion: np.ndarray) -> np.ndarray:
    """Return Y ``(R, N, 10 N)`` of the bodies at q, v, a ``(R, N)``."""
    return structure.regressor(*map(torch.from_numpy, motion)).numpy()


_judged = functools.partial(judged, section="bags_and_other_logs.md#is-the-log-good-enough")


def _amount(training: list[Recording], explained: float) -> list[Measurement]:
    """Measure whether the training has enough samples, motion and input."""
    samples = sum(len(item) for item in training)
    at_rest = share_at_rest(training)
    stop = functools.partial(_judged, verdict="stop")
    text = f"the training has {samples} samples, expected at least {_LEAST_SAMPLES}"
    few = samples < _LEAST_SAMPLES
    results = [stop("samples", "training", samples, f"at least {_LEAST_SAMPLES}", few, text)]
    text = "the robot rests for nearly the whole training: cut the rest out"
    rests = at_rest > _MOST_REST
    results.append(stop("share at rest", "training", at_rest, f"below {_MOST_REST}", rests, text))
    text = (
        f"the inputs explain {100 * explained:.2g} % of the motion, at any delay: are these the "
        "inputs of this robot, on the same clock?"
    )
    name = "share of the motion that inputs add to (1, q, v)"
    bad = explained < _LEAST_EXPLAINED
    results.append(stop(name, "inputs", explained, f"at least {_LEAST_EXPLAINED}", bad, text))
    return results


def _motion(coordinates: pd.DataFrame, condition: float) -> list[Measurement]:
    """Measure noise, and the identifiability of inertias from the linear regressor."""
    results = []
    for row in coordinates.to_dict("records"):
        name, noise, share = (
            row[key] for key in ("coordinate", "noise / range", "independent share of a")
        )
        text = f"{name}: its noise is {100 * noise:.2g} % of its range"
        bad = noise > _NOISE
        results.append(_judged("noise of q / range", name, noise, f"below {_NOISE}", bad, text))
        text = (
            f"{name}: its q, v and the accelerations of the other coordinates explain its "
            f"acceleration but for {100 * share:.2g} %, so its inertia cannot be told from "
            "stiffness, damping or the inertia of another joint; excite it with more frequencies"
        )
        bad, expected = share < _INDEPENDENT, f"at least {_INDEPENDENT}"
        results.append(_judged("independent share of a", name, share, expected, bad, text))
    text = (
        "the regressor (1, q, v, a) of all joints is ill-conditioned: their motions share few "
        "frequencies, so choose a model of few parameters (known mechanics), or excite more"
    )
    bad, expected = condition > _CONDITION, f"below {_CONDITION:g}"
    name = "condition number of (1, q, v, a)"
    results.append(_judged(name, "training", condition, expected, bad, text))
    if (coordinates["noise / range"] > _STILL).all():
        text = "no coordinate moves by more than its noise"
        results.append(_judged("motion", "training", 0.0, "", True, text, verdict="stop"))
    return results


def _coverage(coordinates: pd.DataFrame, distance: np.ndarray) -> list[Measurement]:
    """Measure how far the test is from the training."""
    results = []
    expected = f"below {_OUTSIDE}"
    for name, share in zip(coordinates["coordinate"], coordinates["test outside"], strict=True):
        text = f"{name}: {100 * share:.0f} % of the test is outside the range of the training"
        title = "share of the test outside the range"
        results.append(_judged(title, name, share, expected, share > _OUTSIDE, text))
    far = float((distance > _FAR).mean())
    text = (
        f"{100 * far:.0f} % of the test is {_FAR:g} times further from the training than tenths of "
        "it are from each other"
    )
    results.append(_judged("share of the test far away", "", far, expected, far > _OUTSIDE, text))
    return results


def _delay_measurements(
    source: LogSource, delays: Sequence[DelayCurve], step: float
) -> list[Measurement]:
    """Return the delay of each input; a delay of a sample or more is a warning."""
    results = []
    for name, curve in zip(source.u.columns, delays, strict=True):
        delay = np.nan if curve.delay is None else 1e3 * curve.delay
        late = delay > 750 * step
        text = (
            f"input {name!r} acts {delay:.0f} ms after it is logged: add the InputDelay step "
            "below, or learn the delay with the model (model/delay=learned)"
        )
        results.append(_judged("delay [ms]", name, delay, "below a sample", late, text))
    return results


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
    if share < _NOISE or not 0 < cutoff < 0.4 / step:
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
    return [
        f"delay: {{_target_: pinn_dyn.data.logs.InputDelay, delay: {value}}} # s, the delay of "
        "the inputs"
    ]
