"""Whether a log suffices for a training: what is in it, and what its data determine."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch

from pinn_dyn.data.logs import (
    Cleaned,
    DelayCurve,
    LogError,
    LogSource,
    Recording,
    agreed_delays,
    repeat_floor,
)
from pinn_dyn.evaluation.log_advice import Measured, advice
from pinn_dyn.evaluation.log_numbers import (
    distance_from,
    explained_shares,
    own_share,
    regressor_columns,
    share_at_rest,
    white_noise,
)
from pinn_dyn.evaluation.rigid_excitation import MOST, RigidExcitation, rigid_excitation
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.known import Structure

# What a training cannot do without.
_LEAST_SAMPLES = 200
_LEAST_EXPLAINED = 0.1
_MOST_REST = 0.98
# What is warned of.
_NOISE = 0.02
_CONDITION = 1e3
_OWN = 0.01
_FAR = 3.0
_OUTSIDE = 0.05
_STILL = 0.25  # noise of q, of the range, above which a coordinate does not move
_MOST_REPEATS = 20  # stretches of the training that are looked for in the others
_SHOWN = 20  # lines of a table in the terminal
_LINEAR = "condition number of the linear regressor (1, q, v, a), not of rigid bodies"


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
        unidentified: the coordinates whose inertia the motion does not tell.
        rigid: what the motion tells of the constants of a rigid robot; None without a structure.
        suggestion: lines of YAML and commands to copy, each with its reason.
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
    unidentified: list[str]
    rigid: RigidExcitation | None
    suggestion: str

    def __str__(self) -> str:
        tables = {
            "Runs": self.runs.head(_SHOWN),
            "Coordinates": self.coordinates,
            "Inputs": self.inputs,
        }
        if self.rigid is not None:
            tables["Rigid bodies"] = self.rigid.joints
        lines = [f"{self.name}: what is in the log, and whether it suffices"]
        for title, frame in tables.items():
            lines += ["", title, frame.to_string(index=False, float_format=lambda x: f"{x:.3g}")]
        if len(self.runs) > _SHOWN:
            lines.append(f"... {len(self.runs) - _SHOWN} more runs in the page")
        lines += ["", *(f"{name}: {value:.3g}" for name, value in self.figures.items())]
        lines.append(f"inertia not identified: {', '.join(self.unidentified) or 'none'}")
        if self.rigid is not None:
            lines.append(f"rigid-body constants not determined: {self.rigid.words(_SHOWN)}")
        lines += ["", "Warnings", *(f"- {text}" for text in self.warnings or ["none"])]
        lines += ["", "To copy into the configuration, and to run", self.suggestion]
        verdict = "a training makes sense" if not self.problems else "a training makes no sense:"
        return "\n".join([*lines, "", f"Verdict: {verdict}", *(f"- {x}" for x in self.problems)])


def check_log(
    source: LogSource, *, longest_delay: float = 0.3, structure: Structure | None = None
) -> LogCheck:
    """Look at a log as its configuration reads, splits and cleans it.

    Args:
        source: the log.
        longest_delay: the longest delay of an input that is tried, s.
        structure: the kinematics, whose joints are the coordinates of the log, if they are known.

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
    rigid = None if structure is None else functools.partial(_regressor, structure)
    delays, common = agreed_delays(training, longest=longest_delay, rigid=rigid)
    step = float(np.median(np.diff(training[0].t)))
    coordinates, condition = _coordinates(source, training, test, step)
    repeats = _add_repeats(coordinates, source, training)
    explained, follows = explained_shares(training, delays, step)
    distance = distance_from(training, test)
    samples = sum(len(item) for item in training)
    figures = {
        "training samples": float(samples),
        "training time [s]": sum(item.duration for item in training),
        "sample time [s]": step,
        "share of the training at rest": share_at_rest(training),
        _LINEAR: condition,
        "motions that repeat one of the training": float(repeats),
        "share of the motion that the inputs add to what (1, q, v) explains": explained,
        "median distance of the test from the training [of a tenth of it from the rest]": float(
            np.median(distance)
        ),
    }
    problems = _problems(samples, figures, coordinates, explained)
    measured = Measured(
        source,
        training,
        step,
        delays,
        noise=coordinates["noise of q"].to_numpy(),
        rest=figures["share of the training at rest"],
        outside=max(float((distance > _FAR).mean()), float(coordinates["test outside"].max())),
        condition=condition,
        follows=follows,
    )
    excited = None
    if structure is not None:
        excited = _excitation(structure, splits.train, coordinates, measured)
        figures[
            f"condition number of the rigid-body regressor ({excited.count} base parameters, "
            "friction included, columns of unit norm)"
        ] = excited.condition
    frame = pd.DataFrame(
        {
            "input": source.input_labels[:inputs],
            "least": np.vstack([item.u for item in training]).min(axis=0),
            "most": np.vstack([item.u for item in training]).max(axis=0),
            "delay [ms]": [np.nan if c.delay is None else 1e3 * c.delay for c in delays],
            "spread [ms]": [
                np.nan if c.delay is None else 1e3 * min(c.spread, 9.999) for c in delays
            ],
            "how": [c.reason or f"{c.form}{', common' * common}" for c in delays],
        }
    )
    warnings = [*source.warnings, *_warnings(coordinates, figures, delays, distance, step)]
    if excited is not None and excited.condition > MOST:
        warnings.append(
            f"the rigid-body regressor has the condition number {excited.condition:.3g}, expected "
            f"less than {MOST:g}: these motions do not determine constants of "
            f"{', '.join(excited.open_joints)}; excite them by more frequencies, poses and speeds"
        )
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
        # Their acceleration follows from q, v and the other accelerations.
        coordinates.loc[coordinates["own share of a"] < _OWN, "coordinate"].tolist(),
        excited,
        advice(measured),
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


def _noise_of_v(raw: list[Recording]) -> dict[str, np.ndarray]:
    """A column where the log has v; of a derived one the noise is not white any more."""
    long = [item.v for item in raw if item.v is not None and len(item) > 10]
    return {"noise of v": np.median([white_noise(v) for v in long], axis=0)} if long else {}


def _add_repeats(frame: pd.DataFrame, source: LogSource, training: list[Recording]) -> int:
    """The floors of q and v that repeated motions tell, as columns; returns their number."""
    splits = source.load()
    held = [
        Recording("", x.t.numpy(), x.q.numpy(), x.v.numpy(), x.u.numpy())
        for x in (*splits.validation, *splits.test)
    ]
    some = training[:: max(1, len(training) // _MOST_REPEATS)]
    middles = [item.rows(slice(len(item) // 4, 3 * len(item) // 4)) for item in some]
    repeats, q, v = repeat_floor([*held, *(x for x in middles if len(x) > 10)], training)
    if repeats:
        frame["floor of q"], frame["floor of v"] = q, v
    return repeats


def _coordinates(
    source: LogSource, training: list[Recording], test: Sequence[Trajectory], step: float
) -> tuple[pd.DataFrame, float]:
    """One row per coordinate, and the condition number of (1, q, v, a)."""
    q = np.vstack([item.q for item in training])
    raw = [part.raw for part in source.cleaned if part.split == "train"]
    noise = np.median([white_noise(item.q) for item in raw if len(item) > 10], axis=0)
    v = np.vstack([item.v for item in training if item.v is not None])
    seen = np.vstack([item.q.numpy() for item in test])
    low, high = q.min(axis=0), q.max(axis=0)
    regressor = regressor_columns(training, step)
    size = q.shape[1]
    own = [own_share(regressor, k, size) for k in range(size)]
    scaled = regressor / np.linalg.norm(regressor, axis=0).clip(min=1e-300)
    frame = pd.DataFrame(
        {
            "coordinate": source.labels,
            "least": low,
            "most": high,
            "fastest [/s]": np.abs(v).max(axis=0),
            "noise of q": noise,
            "noise / range": noise / np.ptp(q, axis=0).clip(min=1e-300),
            **_noise_of_v(raw),
            "test outside": ((seen < low) | (seen > high)).mean(axis=0),
            "own share of a": own,
        }
    )
    return frame, float(np.linalg.cond(scaled))


def _regressor(structure: Structure, *motion: np.ndarray) -> np.ndarray:
    """Y ``(R, N, 10 N)`` of the bodies at q, v, a ``(R, N)``."""
    return structure.regressor(*map(torch.from_numpy, motion)).numpy()


def _excitation(
    structure: Structure,
    trajectories: Sequence[Trajectory],
    coordinates: pd.DataFrame,
    measured: Measured,
) -> RigidExcitation:
    """What the motions tell of rigid bodies, after a filter between them and their noise."""
    longest = max(item.duration for item in trajectories)
    try:
        return rigid_excitation(
            structure,
            trajectories,
            # At least three of its periods are in the longest motion.
            cutoff=min(max(4 * measured.highest, 1.0, 3.01 / longest), 0.4 / measured.step),
            still=(coordinates["noise / range"] > _STILL).tolist(),
        )
    except ValueError as error:
        raise LogError(f"the rigid-body regressor: {error}") from error


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
    if (coordinates["noise / range"] > _STILL).all():
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
    if figures[_LINEAR] > _CONDITION:
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
