"""Whether a log suffices for a training: what is in it, and what its data determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from pinn_dyn.data.logs import Cleaned, DelayCurve, LogSource, Recording, input_delays
from pinn_dyn.mechanics import Trajectory

_SMOOTH = 0.03  # width of the kernel before a derivative, s
_POINTS = 4000  # of a figure or a search among neighbours
_STILL = 0.01  # of the fastest, a speed below which the robot rests
# What a training cannot do without.
_LEAST_SAMPLES = 200
_LEAST_EXPLAINED = 0.1
_MOST_REST = 0.98
# What is warned of.
_NOISE = 0.02
_CONDITION = 1e3
_OWN = 0.01
_FAR = 3.0
_NEAR = 0.05  # of the spread
_OUTSIDE = 0.05


@dataclass(frozen=True)
class LogCheck:
    """The findings on a log.

    Attributes:
        name: of the data set.
        runs: one row per stretch: split, duration, rows, sample time, jitter, longest gap.
        coordinates: one row per coordinate: range, noise, rest, and what identifies its inertia.
        inputs: one row per input: range, delay and its spread, or why there is none.
        delays: the curve of each input.
        figures: single numbers and what they mean, name to value.
        distance: of the test samples from the nearest training sample, 1 where they are as far as a
            tenth of the training is from the rest, ``(S,)``.
        problems: why a training makes no sense; empty where it does.
        warnings: what to look at before a training.
        suggestion: lines of YAML to copy, or "".
    """

    name: str
    runs: pd.DataFrame
    coordinates: pd.DataFrame
    inputs: pd.DataFrame
    delays: list[DelayCurve]
    figures: dict[str, float]
    distance: np.ndarray
    problems: list[str]
    warnings: list[str]
    suggestion: str

    def __str__(self) -> str:
        tables = {
            "Runs": self.runs.head(20),
            "Coordinates": self.coordinates,
            "Inputs": self.inputs,
        }
        lines = [f"{self.name}: what is in the log, and whether it suffices"]
        for title, frame in tables.items():
            lines += ["", title, frame.to_string(index=False, float_format=lambda x: f"{x:.3g}")]
        if len(self.runs) > 20:
            lines.append(f"... {len(self.runs) - 20} more in the page")
        lines += ["", *(f"{name}: {value:.3g}" for name, value in self.figures.items())]
        lines += ["", "Warnings", *(f"- {text}" for text in self.warnings or ["none"])]
        if self.suggestion:
            lines += ["", "To copy into the configuration", self.suggestion]
        verdict = "a training makes sense" if not self.problems else "a training makes no sense:"
        return "\n".join([*lines, "", f"Verdict: {verdict}", *(f"- {x}" for x in self.problems)])


def check_log(source: LogSource, *, longest_delay: float = 0.3) -> LogCheck:
    """Look at a log as its configuration reads, splits and cleans it.

    Args:
        source: the log.
        longest_delay: the longest delay of an input that is tried, s.

    Raises:
        LogError: where the log cannot be used at all.
    """
    splits = source.load()
    inputs = len(source.u.columns)
    training = [
        _with_inputs(item, inputs)
        for part in source.cleaned
        if part.split == "train"
        for item in part.clean
    ]
    test = splits.test
    delays = input_delays(training, longest=longest_delay)
    step = float(np.median(np.diff(training[0].t)))
    coordinates, condition = _coordinates(source, training, test, step)
    explained = _explained(training, delays, step)
    distance = _distance(training, test)
    samples = sum(len(item) for item in training)
    figures = {
        "training samples": float(samples),
        "training time [s]": sum(item.duration for item in training),
        "sample time [s]": step,
        "share of the training at rest": _rest(training),
        "condition number of the linear regressor (1, q, v, a)": condition,
        "share of the motion that the inputs add to what (1, q, v) explains": explained,
        "median distance of the test from the training [of a tenth of it from the rest]": float(
            np.median(distance)
        ),
    }
    problems = _problems(samples, figures, coordinates, explained)
    frame = pd.DataFrame(
        {
            "input": source.input_labels[:inputs],
            "least": np.vstack([item.u for item in training]).min(axis=0),
            "most": np.vstack([item.u for item in training]).max(axis=0),
            "delay [ms]": [np.nan if c.delay is None else 1e3 * c.delay for c in delays],
            "spread [ms]": [
                np.nan if c.delay is None else 1e3 * min(c.spread, 9.999) for c in delays
            ],
            "how": [c.reason or c.form for c in delays],
        }
    )
    warnings = [*source.warnings, *_warnings(coordinates, figures, delays, distance, step)]
    return LogCheck(
        source.name,
        pd.DataFrame([_run(part) for part in source.cleaned]),
        coordinates,
        frame,
        delays,
        figures,
        distance,
        problems,
        warnings,
        _suggestion(delays, figures, step),
    )


def _with_inputs(item: Recording, inputs: int) -> Recording:
    """Without the rates of inputs that a step may have added."""
    return Recording(item.run, item.t, item.q, item.v, item.u[:, :inputs])


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


def _noise(x: np.ndarray) -> np.ndarray:
    """Standard deviation of white noise: third differences leave nothing of a smooth motion."""
    third = np.diff(x, n=3, axis=0)
    return 1.4826 * np.median(np.abs(third), axis=0) / np.sqrt(20)


def _coordinates(
    source: LogSource, training: list[Recording], test: Sequence[Trajectory], step: float
) -> tuple[pd.DataFrame, float]:
    """One row per coordinate, and the condition number of (1, q, v, a)."""
    q = np.vstack([item.q for item in training])
    raw = [part.raw for part in source.cleaned if part.split == "train"]
    noise = np.median([_noise(item.q) for item in raw if len(item) > 10], axis=0)
    v = np.vstack([item.v for item in training if item.v is not None])
    seen = np.vstack([item.q.numpy() for item in test])
    low, high = q.min(axis=0), q.max(axis=0)
    regressor = _regressor(training, step)
    size = q.shape[1]
    own = [_own_share(regressor, k, size) for k in range(size)]
    scaled = regressor / np.linalg.norm(regressor, axis=0).clip(min=1e-300)
    frame = pd.DataFrame(
        {
            "coordinate": source.labels,
            "least": low,
            "most": high,
            "fastest [/s]": np.abs(v).max(axis=0),
            "noise of q": noise,
            "noise / range": noise / np.ptp(q, axis=0).clip(min=1e-300),
            "test outside": ((seen < low) | (seen > high)).mean(axis=0),
            "own share of a": own,
        }
    )
    return frame, float(np.linalg.cond(scaled))


def _regressor(training: list[Recording], step: float) -> np.ndarray:
    """Columns 1, q, v, a of averages by a Gaussian kernel, of unit spread."""
    width = max(_SMOOTH / step, 1.5)
    thin = max(1, int(width / 2))
    parts = []
    for item in training:
        if len(item) > 10 * width:
            smooth = [gaussian_filter1d(item.q, width, axis=0, order=k) for k in range(3)]
            inner = slice(int(4 * width), -int(4 * width), thin)
            parts.append(np.hstack([x[inner] for x in smooth]))
    x = np.vstack(parts) if parts else np.zeros((1, 3 * training[0].q.shape[1]))
    x = (x - x.mean(axis=0)) / x.std(axis=0).clip(min=1e-300)
    return np.hstack([np.ones((len(x), 1)), x])


def _own_share(x: np.ndarray, k: int, size: int) -> float:
    """Share of a_k that 1, q_k, v_k and the other accelerations do not explain."""
    accelerations = np.arange(1 + 2 * size, 1 + 3 * size)
    own = accelerations[k]
    others = x[:, [0, 1 + k, 1 + size + k, *accelerations[accelerations != own]]]
    rest = x[:, own] - others @ np.linalg.lstsq(others, x[:, own], rcond=None)[0]
    return float(rest.var() / max(x[:, own].var(), 1e-300))


def _explained(training: list[Recording], delays: list[DelayCurve], step: float) -> float:
    """The largest share that delayed inputs add to the explanation of v and of a by (1, q, v).

    Corrected for the number of terms; 1 where the rows are too few to tell.
    """
    width = max(_SMOOTH / step, 1.5)
    edge = int(4 * width) + 1
    lags = [round((curve.delay or 0.0) / step) for curve in delays]
    q: list[np.ndarray] = []
    v: list[np.ndarray] = []
    a: list[np.ndarray] = []
    u: list[np.ndarray] = []
    for item in training:
        first = edge + max(lags)
        # So far apart that their averages are independent.
        rows = np.arange(first, len(item) - edge, max(1, int(3.5 * width)))
        if not len(rows):
            continue
        for parts, order in ((q, 0), (v, 1), (a, 2)):
            parts.append(gaussian_filter1d(item.q, width, axis=0, order=order)[rows])
        smooth = gaussian_filter1d(item.u, width, axis=0)
        u.append(np.column_stack([smooth[rows - lag, i] for i, lag in enumerate(lags)]))
    if not q or sum(len(x) for x in q) < 6 * (3 * q[0].shape[1] + len(delays)):
        return 1.0
    position, speed, acceleration, inputs = (np.vstack(x) for x in (q, v, a, u))
    known = np.hstack([np.ones((len(position), 1)), position, np.sin(position), np.cos(position)])
    gains = [
        _rest_of(y, x) - _rest_of(y, np.hstack([x, inputs]))
        for y, x in ((speed, known), (acceleration, np.hstack([known, speed])))
    ]
    # A controlled robot's acceleration may follow from q and v; its torque then does too.
    gains.append(1 - _rest_of(inputs, np.hstack([known, speed, acceleration])))
    return max(gains)


def _rest_of(y: np.ndarray, x: np.ndarray) -> float:
    """Share of the variance of y that x leaves, per degree of freedom."""
    moving = y.std(axis=0) > 0
    if not moving.any():
        return 1.0
    left = len(x) - x.shape[1]
    y = (y[:, moving] - y[:, moving].mean(axis=0)) / y[:, moving].std(axis=0)
    x = x / np.abs(x).max(axis=0).clip(min=1e-300)
    rest = y - x @ np.linalg.lstsq(x, y, rcond=None)[0]
    return float((rest**2).mean()) * len(x) / left


def _rest(training: list[Recording]) -> float:
    speeds = np.vstack([np.abs(np.diff(item.q, axis=0)) for item in training])
    return float((speeds < _STILL * speeds.max(axis=0).clip(min=1e-300)).all(axis=1).mean())


def _distance(training: list[Recording], test: Sequence[Trajectory]) -> np.ndarray:
    """Of the test's (q, v) from the nearest of the training.

    The unit is the distance that a tenth of the training keeps from the nine others, so that it
    does not depend on the number of coordinates; at least a twentieth of the spread in each of
    them, which is near also where the training repeats one motion.
    """
    known = np.vstack([np.hstack([item.q, item.v]) for item in training if item.v is not None])
    asked = np.vstack([np.hstack([item.q.numpy(), item.v.numpy()]) for item in test])
    spread = known.std(axis=0).clip(min=1e-300)
    known = known[:: max(1, len(known) // _POINTS)] / spread
    asked = asked[:: max(1, len(asked) // _POINTS)] / spread
    tenth = np.arange(len(known)) * 10 // len(known)
    own = [cKDTree(known[tenth != k]).query(known[tenth == k])[0] for k in range(10)]
    unit = max(float(np.median(np.concatenate(own))), _NEAR * known.shape[1] ** 0.5)
    return cKDTree(known).query(asked)[0] / unit


def _problems(
    samples: int, figures: dict[str, float], coordinates: pd.DataFrame, explained: float
) -> list[str]:
    problems = []
    if samples < _LEAST_SAMPLES:
        problems.append(f"the training has {samples} samples, expected at least {_LEAST_SAMPLES}")
    if explained < _LEAST_EXPLAINED:
        problems.append(
            f"the inputs explain {100 * explained:.2g} % of the motion, at any delay: are these "
            "the inputs of this robot, on the same clock?"
        )
    if figures["share of the training at rest"] > _MOST_REST:
        problems.append("the robot rests for nearly the whole training: cut the rest out")
    if (coordinates["noise / range"] > 0.25).all():
        problems.append("no coordinate moves by more than its noise")
    return problems


def _warnings(
    coordinates: pd.DataFrame,
    figures: dict[str, float],
    delays: list[DelayCurve],
    distance: np.ndarray,
    step: float,
) -> list[str]:
    found = []
    for row in coordinates.to_dict("records"):
        name = row["coordinate"]
        if row["noise / range"] > _NOISE:
            found.append(f"{name}: its noise is {100 * row['noise / range']:.2g} % of its range")
        if row["own share of a"] < _OWN:
            found.append(
                f"{name}: its acceleration follows from its q and v and from other "
                f"accelerations, but for {100 * row['own share of a']:.2g} %: its inertia cannot "
                "be told from stiffness, damping or another joint's; excite it with more "
                "frequencies of its own"
            )
        if row["test outside"] > _OUTSIDE:
            found.append(
                f"{name}: {100 * row['test outside']:.0f} % of the test is outside the range of "
                "the training"
            )
    if figures["condition number of the linear regressor (1, q, v, a)"] > _CONDITION:
        found.append(
            "the regressor (1, q, v, a) of all joints is ill-conditioned: their motions share few "
            "frequencies, so take a model of few parameters (known mechanics), or excite more"
        )
    if (far := float((distance > _FAR).mean())) > _OUTSIDE:
        found.append(
            f"{100 * far:.0f} % of the test is {_FAR:g} times further from the training "
            "than tenths of it are from each other"
        )
    late = [c.delay for c in delays if c.delay is not None and c.delay > 0.75 * step]
    if late:
        shown = list(dict.fromkeys(f"{1e3 * delay:.0f}" for delay in (min(late), max(late))))
        found.append(
            f"inputs act {' to '.join(shown)} ms after they are logged: add the InputDelay step "
            "below, or learn the delay with the model"
        )
    return found


def _suggestion(delays: list[DelayCurve], figures: dict[str, float], step: float) -> str:
    lines = []
    shifts = [round(round((c.delay or 0.0) / step) * step, 6) for c in delays]
    if any(shifts):
        shown = shifts[0] if len(set(shifts)) == 1 else shifts
        lines += [
            "steps:",
            f"  delay: {{_target_: pinn_dyn.data.logs.InputDelay, delay: {shown}}}",
        ]
        if len(set(shifts)) == 1:
            longest = max(0.1, 2 * shifts[0])
            lines.append(
                "# or, learned with the model, on the command line: model/delay=learned "
                f"model.delay.initial={shifts[0]:g} model.delay.longest={longest:g}"
            )
    if figures["share of the training at rest"] > 0.5:
        lines.append("# on the command line: data.coverage=0.5, as the robot often rests")
    return "\n".join(lines)
