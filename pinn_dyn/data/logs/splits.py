"""The assignment of runs, or of parts of a run, to training, validation and test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import PositiveFloat, PositiveInt
from pydantic.dataclasses import dataclass

from pinn_dyn.data.logs.columns import STRICT
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.source import SPLITS
from pinn_dyn.spelling import did_you_mean

_WHOLE_RUNS = 5  # from this number of runs on, the default split keeps some of them whole
_SHARE = 0.15  # of the runs, or of each run, for the test, and again for the validation
_PIECE = 5.0  # s, longest piece of the default split
_GUARD = 0.5  # s, longest guard of the default split


@dataclass(config=STRICT)
class Part:
    """Validation or test data: whole runs, or seconds of the other runs.

    Args:
        piece: length of the roll-outs that it is cut into, s; ``"whole"``: each stretch is one
            roll-out, and an evaluation takes the roll-outs that last as long as its horizon.
        runs: number of runs, drawn by the seed, or the names of the runs.
        seconds: the last so many seconds of every run that is not named elsewhere.

    Raises:
        LogError: unless exactly one of ``runs`` and ``seconds`` is given.
    """

    piece: PositiveFloat | Literal["whole"]
    runs: PositiveInt | Sequence[str | int] | None = None
    seconds: PositiveFloat | None = None

    def __post_init__(self) -> None:
        if (self.runs is None) == (self.seconds is None):
            raise LogError(
                f"runs is {self.runs} and seconds is {self.seconds}, expected one of them"
            )
        if self.seconds is not None and self.piece != "whole" and self.piece > self.seconds:
            raise LogError(f"piece is {self.piece} s, expected at most seconds, {self.seconds} s")

    @property
    def names(self) -> list[str]:
        """Names of the runs, where they are named."""
        return [] if self.runs is None or isinstance(self.runs, int) else [*map(str, self.runs)]


def default_split(runs: Mapping[str, np.ndarray], seed: int) -> tuple[Part, Part, float]:
    """Choose validation, test and guard of a log for which the user chose none.

    Of five runs or more, 15 % are the test and as many the validation: whole runs, drawn among
    the runs of at least the median length. Of fewer runs, the last 15 % of each are the test and
    the 15 % before them the validation. Both are cut into pieces of at most 5 s.

    Args:
        runs: times of each run, s.
        seed: seed of the choice of runs.

    Returns:
        Validation, test, and the guard between the parts of one run, s.
    """
    spacing = np.concatenate([np.diff(t) for t in runs.values()])
    step = float(np.median(spacing[spacing > 0])) if (spacing > 0).any() else 1.0
    lengths = {name: float(np.ptp(t)) for name, t in runs.items()}

    def piece(longest: float) -> float:
        """Return the longest piece that is a multiple of the sample time."""
        return round(max(int(min(_PIECE, longest) / step + 1e-6), 1) * step, 9)

    if len(runs) >= _WHOLE_RUNS:
        median = float(np.median([*lengths.values()]))
        long = [name for name, length in lengths.items() if length >= median - 0.5 * step]
        count = max(round(_SHARE * len(runs)), 1)
        drawn = [long[k] for k in np.random.default_rng(seed).permutation(len(long))]
        test, validation = sorted(drawn[:count]), sorted(drawn[count : 2 * count])
        size = piece(median)
        return Part(size, runs=validation), Part(size, runs=test), _GUARD
    shortest = min(lengths.values())
    size = piece(_SHARE * shortest)
    seconds = max(_SHARE * shortest, size)
    guard = min(_GUARD, 0.02 * shortest)
    return Part(size, seconds=seconds), Part(size, seconds=seconds), guard


def split(
    recordings: list[Recording], validation: Part, test: Part, *, guard: float, seed: int
) -> dict[str, list[Recording]]:
    """Assign whole runs, and cut parts out of the other runs, before any filter sees them.

    A run that is cut at its end consists of training, guard, validation, guard, test.

    Raises:
        LogError: on unknown or doubly used runs, or too few or too short ones.
    """
    names = [recording.run for recording in recordings]
    splits: dict[str, str] = {}
    for name, part in (("validation", validation), ("test", test)):
        for run in part.names:
            if run not in names:
                hint = did_you_mean(run, names) or "."
                raise LogError(f"{name}.runs: no run {run!r}{hint} The runs are {listed(names)}")
            if run in splits:
                raise LogError(f"run {run!r} is in {splits[run]} and in {name}, expected in one")
            splits[run] = name
    counts = {
        name: part.runs
        for name, part in (("test", test), ("validation", validation))
        if isinstance(part.runs, int)
    }
    free = [run for run in dict.fromkeys(names) if run not in splits]
    if sum(counts.values()) >= len(free):
        raise LogError(
            f"{len(free)} runs to choose from, expected more than {sum(counts.values())}, so that "
            "one is left for training; with a single run, split by 'seconds'"
        )
    order = np.random.default_rng(seed).permutation(len(free))
    for name, count in counts.items():
        splits |= {free[k]: name for k in order[:count]}
        order = order[count:]

    parts: dict[str, list[Recording]] = {name: [] for name in SPLITS}
    for recording in recordings:
        if recording.run in splits:
            parts[splits[recording.run]].append(recording)
        else:
            for name, stretch in _cut(recording, validation, test, guard):
                parts[name].append(stretch)
    return parts


def _cut(
    recording: Recording, validation: Part, test: Part, guard: float
) -> list[tuple[str, Recording]]:
    """Return training, validation and test stretches of one run."""
    if validation.seconds is None and test.seconds is None:
        return [("train", recording)]
    t = recording.t
    if not (np.diff(t) >= 0).all():
        raise LogError(f"{recording.run}: the time goes backwards: split by 'runs'")
    stretches = []
    end, last = t[-1], len(t)
    for name, part in (("test", test), ("validation", validation)):
        if part.seconds is None:
            continue
        # From the row at or before the border, so that the stretch is not a row too short.
        first = int(np.searchsorted(t, end - part.seconds, side="right")) - 1
        border = end - part.seconds - guard
        left = int(np.searchsorted(t, border, side="right")) + 1
        if first < 0 or left < 2 or border <= t[0]:
            raise LogError(f"{recording.place}: too short to keep {part.seconds} s for {name}")
        stretches.append((name, recording.rows(slice(first, last))))
        end, last = border, min(left, first)
    # The row after the border only completes a stretch that is measured from its end.
    return [*stretches, ("train", recording.rows(slice(0, max(last - 1, 1))))]
