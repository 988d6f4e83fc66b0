"""Assign runs, or parts of runs, to training, validation and test."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import PositiveFloat, PositiveInt
from pydantic.dataclasses import dataclass

from pinn_dyn.data.logs.columns import STRICT
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.recording import Recording, Report
from pinn_dyn.data.source import SPLITS
from pinn_dyn.wording import did_you_mean

# The default split assigns whole runs from this number of runs on.
_WHOLE_RUNS = 5
_SHARE = 0.15  # share of the runs, or of each run, for the test and for the validation
_PIECE, _GUARD = 5.0, 0.5  # largest lengths, s


@dataclass(config=STRICT)
class Part:
    """Validation or test data: whole runs, or the ends of runs.

    Args:
        piece: length of the rollouts, s; ``"whole"`` if each stretch is a rollout; None for 5 s, or
            the median stretch if it is shorter.
        runs: number of runs, drawn by the seed, or the names of the runs.
        seconds: duration at the end of each run that is not assigned as a whole, s. Exactly one of
            ``runs`` and ``seconds`` is required.
    """

    piece: PositiveFloat | Literal["whole"] | None = None
    runs: PositiveInt | Sequence[str | int] | None = None
    seconds: PositiveFloat | None = None

    def __post_init__(self) -> None:
        if (self.runs is None) == (self.seconds is None):
            raise LogError(
                f"expected either runs or seconds, not runs={self.runs} and seconds={self.seconds}"
            )

    @property
    def names(self) -> list[str]:
        """Names of the runs, if ``runs`` has names."""
        return [] if self.runs is None or isinstance(self.runs, int) else [*map(str, self.runs)]


def default_split(
    runs: Mapping[str, np.ndarray], seed: int, lost: float = 0.0
) -> tuple[Part, Part, float]:
    """Choose validation, test and guard (s) of a log from the times of its runs, s.

    With five or more runs, 15 % of the runs are the test, and 15 % the validation. The seed draws
    them from the runs of at least the median length. With fewer runs, the last 15 % of each run are
    the test, and the 15 % before are the validation. Both are cut into pieces of at most 5 s, short
    enough for stretches from which the cleaning drops ``lost`` s.
    """
    step = _usual_step([*runs.values()])
    lengths = {name: float(np.ptp(t)) for name, t in runs.items()}
    whole_runs = len(runs) >= _WHOLE_RUNS
    median, shortest = float(np.median([*lengths.values()])), min(lengths.values())
    longest = min(_PIECE, (median if whole_runs else _SHARE * shortest) - lost)
    piece = max(_whole_steps(longest, step), round(step, 9))
    if whole_runs:
        long = [name for name, length in lengths.items() if length >= median - 0.5 * step]
        count = max(round(_SHARE * len(runs)), 1)
        drawn = [long[k] for k in np.random.default_rng(seed).permutation(len(long))]
        test, validation = sorted(drawn[:count]), sorted(drawn[count : 2 * count])
        return Part(piece, runs=validation), Part(piece, runs=test), _GUARD
    part = Part(piece, seconds=max(_SHARE * shortest, piece))
    return part, part, min(_GUARD, 0.02 * shortest)


def fitting(part: Part, stretches: Sequence[Recording], lead: float, report: Report) -> Part:
    """Choose the length of the pieces if it is None, or shorten it if the runs are too short.

    A shift of the inputs drops ``lead`` s at the beginning of each run.
    """
    if part.piece == "whole":
        return part
    durations = [item.duration for item in stretches]
    step = _usual_step([item.t for item in stretches])
    usual = min(float(np.median(durations)) - lead, _PIECE)
    if part.piece is None:
        return replace(part, piece=_whole_steps(usual, step))
    longest = max(durations)
    piece = _whole_steps(longest - lead, step)
    if not lead or longest - lead >= part.piece or longest < part.piece - 0.5 * step or piece <= 0:
        return part
    text = f"pieces of {piece:g} s instead of {part.piece:g} s, as the input delay drops {lead:g} s"
    report.add("Splits", stretches[durations.index(longest)].place, text)
    return replace(part, piece=piece)


def _usual_step(times: Sequence[np.ndarray]) -> float:
    """Return the median time between samples that are not at the same time, s."""
    spacing = np.concatenate([np.diff(t) for t in times])
    return float(np.median(spacing[spacing > 0]))


def _whole_steps(duration: float, step: float) -> float:
    """Return the largest multiple of the sample time up to a duration, s."""
    return round(int(duration / step + 1e-6) * step, 9)


def split(
    recordings: list[Recording],
    validation: Part,
    test: Part,
    *,
    guard: float,
    seed: int,
    lead: float = 0.0,
) -> dict[str, list[Recording]]:
    """Assign whole runs, and cut the other runs into training, guard, validation, guard, test.

    Cut stretches for validation and test begin ``lead`` s earlier, since a shift of the inputs
    drops ``lead`` s.

    Raises:
        LogError: if a run is unknown or assigned twice, or runs are too few or too short.
    """
    names = list(dict.fromkeys(recording.run for recording in recordings))
    splits: dict[str, str] = {}
    for name, part in (("validation", validation), ("test", test)):
        for run in part.names:
            if run not in names:
                hint = did_you_mean(run, names) or "."
                raise LogError(f"{name}.runs: no run {run!r}{hint} The runs are {listed(names)}")
            if run in splits:
                raise LogError(
                    f"run {run!r} is in {splits[run]} and in {name}, expected in only one of them"
                )
            splits[run] = name
    free = [run for run in names if run not in splits]
    drawn_parts = {"test": test.runs, "validation": validation.runs}
    counts = {name: runs for name, runs in drawn_parts.items() if isinstance(runs, int)}
    if (count := sum(counts.values())) >= len(free):
        raise LogError(
            f"{len(free)} runs to choose from, expected more than {count}, or a split by 'seconds'"
        )
    drawn = iter(np.random.default_rng(seed).permutation(len(free)))
    for name, count in counts.items():
        splits |= {free[k]: name for k in itertools.islice(drawn, count)}

    parts: dict[str, list[Recording]] = {name: [] for name in SPLITS}
    for recording in recordings:
        if recording.run in splits:
            parts[splits[recording.run]].append(recording)
        else:
            for name, stretch in _cut(recording, validation, test, guard, lead):
                parts[name].append(stretch)
    return parts


def _cut(
    recording: Recording, validation: Part, test: Part, guard: float, lead: float
) -> list[tuple[str, Recording]]:
    t, stretches = recording.t, []
    end, last = t[-1], len(t)
    parts = {"test": test.seconds, "validation": validation.seconds}
    for name, seconds in parts.items():
        if seconds is None:
            continue
        # Start at or before the border, so that the stretch is not a row too short.
        first = int(np.searchsorted(t, end - seconds - lead, side="right")) - 1
        border = end - seconds - guard
        if border <= t[0]:
            raise LogError(f"{recording.place}: the run is too short for {seconds} s of {name}")
        stretches.append((name, recording.rows(slice(max(first, 0), last))))
        before = int(np.searchsorted(t, end - seconds, side="right")) - 1
        end, last = border, min(int(np.searchsorted(t, border, side="right")) + 1, before)
    # Training ends before the border; the row after it only completes a stretch of the other parts.
    train = recording.rows(slice(0, max(last - 1, 1))) if stretches else recording
    return [*stretches, ("train", train)]
