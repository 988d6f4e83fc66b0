"""Which runs, or which parts of a run, are for training, validation and test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from pinn_dyn.data.logs.columns import ShortForm
from pinn_dyn.data.logs.errors import LogError, listed
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.source import SPLITS
from pinn_dyn.spelling import did_you_mean

WHOLE: Literal["whole"] = "whole"
"""As a piece: one roll-out of each stretch, as long as it is."""


_WHOLE_RUNS = 5  # from this number of runs on, the default split keeps some of them whole
_SHARE = 0.15  # of the runs, or of each run, for the test, and again for the validation
_PIECE = 5.0  # s, longest piece of the default split
_GUARD = 0.5  # s, longest guard of the default split


class Part(ShortForm):
    """What is kept from training: whole runs, or seconds at the end of the others or along them.

    Args:
        piece: length of the roll-outs that it is cut into, s; ``"whole"``: each stretch is one,
            as long as it is; an evaluation takes those that last as long as its horizon.
        runs: number of runs, drawn by the seed, or the names of the runs.
        seconds: the last so many seconds of every run that is not named elsewhere.
        blocks: with ``seconds``, so many blocks of that length spread evenly along every such run,
            in place of its end.

    Raises:
        LogError: unless just one of ``runs`` and ``seconds`` is given, and all are above 0.
    """

    form = "{runs: ... or seconds: ..., piece: ...}"
    needed = ("piece",)

    def __init__(
        self,
        piece: float | Literal["whole"],
        *,
        runs: int | Sequence[str | int] | None = None,
        seconds: float | None = None,
        blocks: int | None = None,
    ):
        if (runs is None) == (seconds is None):
            raise LogError(
                f"runs is {runs} and seconds is {seconds}, expected one of them: a number or list "
                "of whole runs, or the seconds at the end of each run"
            )
        self.names = None if runs is None or isinstance(runs, int) else [str(run) for run in runs]
        self.count = runs if isinstance(runs, int) else len(self.names or [])
        if blocks is not None and (seconds is None or not blocks >= 1):
            raise LogError(
                f"blocks is {blocks} and seconds is {seconds}, expected at least one block and "
                "with it seconds, the length of each"
            )
        self.seconds = seconds
        self.blocks = blocks
        self.piece = piece
        if (runs is not None and self.count < 1) or not (seconds is None or seconds > 0):
            raise LogError(f"runs is {runs} and seconds is {seconds}, expected more than 0")
        if isinstance(piece, str):
            if piece != WHOLE:
                raise LogError(f"piece is {piece!r}, expected a time in s, or 'whole'")
        elif not piece > 0 or (seconds is not None and piece > seconds):
            raise LogError(f"piece is {piece} s, expected more than 0 and at most seconds")


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
    """Assign whole runs, and cut parts out of the others, before any filter sees them.

    Along a run that is cut at its end: training, guard, validation, guard, test. Blocks lie in the
    middles of as many equal parts of what is left of the run, those of validation and test taking
    turns, a guard on both sides of each, and training between them.

    Raises:
        LogError: on unknown or doubly used runs, or too few or too short ones.
    """
    by_name = {recording.run: recording for recording in recordings}
    taken: dict[str, str] = {}
    for name, part in (("validation", validation), ("test", test)):
        for run in part.names or []:
            if run not in by_name:
                hint = did_you_mean(run, by_name) or "."
                raise LogError(
                    f"{name}.runs: there is no run {run!r}{hint} The runs are {listed(by_name)}"
                )
            if run in taken:
                raise LogError(f"run {run!r} is in {taken[run]} and in {name}, expected in one")
            taken[run] = name
    counted = {
        name: part.count
        for name, part in (("test", test), ("validation", validation))
        if part.names is None and part.seconds is None
    }
    free = [run for run in by_name if run not in taken]
    if sum(counted.values()) >= len(free):
        wanted = " and ".join(f"{count} for {name}" for name, count in counted.items())
        raise LogError(
            f"there are {len(free)} runs to choose from, but {wanted or 'none'} were asked for, "
            "and one must be left for training: with a single run, split by 'seconds'"
        )
    order = np.random.default_rng(seed).permutation(len(free))
    for name, count in counted.items():
        taken |= {free[k]: name for k in order[:count]}
        order = order[count:]

    parts: dict[str, list[Recording]] = {name: [] for name in SPLITS}
    for recording in recordings:
        if recording.run in taken:
            parts[taken[recording.run]].append(recording)
        else:
            for name, stretch in _cut(recording, validation, test, guard):
                parts[name].append(stretch)
    return parts


def _cut(
    recording: Recording, validation: Part, test: Part, guard: float
) -> list[tuple[str, Recording]]:
    """Training, validation and test stretches of one run."""
    if validation.seconds is None and test.seconds is None:
        return [("train", recording)]
    t = recording.t
    if not (np.diff(t) >= 0).all():
        raise LogError(
            f"{recording.run}: the time goes backwards, so its last seconds cannot be cut off: "
            "give a trajectory column, or split by 'runs'"
        )
    stretches = []
    end, last = t[-1], len(t)
    for name, part in (("test", test), ("validation", validation)):
        if part.seconds is None or part.blocks:
            continue
        # From the row at or before the border, so that the stretch is not a row too short.
        first = int(np.searchsorted(t, end - part.seconds, side="right")) - 1
        border = end - part.seconds - guard
        left = int(np.searchsorted(t, border, side="right")) + 1
        if first < 0 or left < 2 or border <= t[0]:
            raise LogError(
                f"{recording.place}: too short to keep {part.seconds} s for {name} and a guard of "
                f"{guard} s from training"
            )
        stretches.append((name, recording.rows(slice(first, last))))
        end, last = border, min(left, first)
    # The row after the border only completes a stretch that is measured from its end.
    rest = recording.rows(slice(0, max(last - 1, 1))) if stretches else recording
    return [*stretches, *_blocks(rest, {"validation": validation, "test": test}, guard)]


def _blocks(
    recording: Recording, parts: Mapping[str, Part], guard: float
) -> list[tuple[str, Recording]]:
    """The blocks of one run, in turns, and the training before, between and after them."""
    order = sorted(
        ((k + 0.5) / part.blocks, name)
        for name, part in parts.items()
        for k in range(part.blocks or 0)
        if part.blocks
    )
    t, stretches, free = recording.t, [], 0
    for number, (_, name) in enumerate(order):
        seconds = parts[name].seconds
        assert seconds is not None
        if recording.duration / len(order) < seconds + 2 * guard:
            raise LogError(
                f"{recording.place}: too short for {len(order)} blocks, of which {name} has "
                f"{seconds} s each, with a guard of {guard} s on both sides"
            )
        middle = t[0] + (number + 0.5) * recording.duration / len(order)
        first = int(np.searchsorted(t, middle - seconds / 2, side="right")) - 1
        # To the row at or after the end, so that the block is not a row too short.
        last = int(np.searchsorted(t, t[first] + seconds - 1e-9)) + 1
        before = int(np.searchsorted(t, t[first] - guard))
        stretches.append((name, recording.rows(slice(first, last))))
        if before > free:
            stretches.append(("train", recording.rows(slice(free, before))))
        free = int(np.searchsorted(t, t[min(last, len(t)) - 1] + guard, side="right"))
    if free < len(t):
        stretches.append(("train", recording.rows(slice(free, None))))
    return stretches
