"""Training windows of a data source, and whole trajectories for validation and test."""

from __future__ import annotations

import functools
import logging
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from pinn_dyn.data.bandwidth import samples_in_step
from pinn_dyn.data.lengths import seconds_of
from pinn_dyn.data.source import DataSource, Splits
from pinn_dyn.data.windows import Windows, draw_windows
from pinn_dyn.mechanics import samples_of
from pinn_dyn.models.statistics import Statistics

_LONGEST_WINDOW = 40  # steps, of steps="auto"
_FEWEST_WINDOWS, _MOST_WINDOWS = 150, 600  # of pairs="auto"

log = logging.getLogger(__name__)


class DynamicsData:
    """Training windows from the training trajectories of a data source.

    Args:
        source: the source of the trajectories.
        pairs: number of training windows, or ``"all"`` windows of the trajectories. All windows are
            also used if there are fewer than the number. ``"auto"`` covers the trajectories once,
            with 150 to 600 windows at equal distances.
        steps: steps H of a window; 1 gives the paper's transition pairs. ``"auto"`` is 40, or half
            of the longest trajectory if that is shorter.
        stride: samples of the data in a step, or the length of a step as a time, such as
            ``"20 ms"`` or, rounded to whole samples, ``"about 20 ms"``. ``"auto"`` is about a tenth
            of a period of the fastest input, or of the fastest motion if it is slower. Noise and
            holds of the inputs are ignored.
        batch_size: windows in a batch.
        batches_per_epoch: batches in an epoch of the trainer.
        seed: seed of the windows and their order.
        coverage: evenness of the windows over the configurations, see :func:`draw_windows`.
        history: time before a window for which q and u are stored, for models with a delay or a
            memory, s.
    """

    def __init__(
        self,
        source: DataSource,
        *,
        pairs: PositiveInt | Literal["all", "auto"] = 8000,
        steps: PositiveInt | Literal["auto"] = 1,
        stride: PositiveInt | str = 10,
        batch_size: PositiveInt = 256,
        batches_per_epoch: PositiveInt,
        seed: NonNegativeInt,
        coverage: Annotated[float, Field(ge=0, le=1)] = 0.0,
        history: NonNegativeFloat = 0.0,
    ):
        self.source, self.pairs, self.steps, self.stride = source, pairs, steps, stride
        self.batch_size, self.batches_per_epoch, self.seed = batch_size, batches_per_epoch, seed
        self.coverage, self.history = coverage, history

    @functools.cached_property
    def splits(self) -> Splits:
        """Trajectories of all splits."""
        return self.source.load()

    @property
    def step(self) -> float:
        """Length of a step of a window, s."""
        t = self.splits.train[0].t
        return self._samples * float(t[1] - t[0])

    @functools.cached_property
    def _samples(self) -> int:
        if not isinstance(self.stride, str):
            return self.stride
        runs, t = self.splits.train, self.splits.train[0].t
        sample_time = float(t[1] - t[0])
        if self.stride == "auto":
            inputs, motions = [x.u.numpy() for x in runs], [x.q.numpy() for x in runs]
            count = samples_in_step([inputs, motions], sample_time)
            log.info("data.stride=auto is %.4g ms", 1e3 * count * sample_time)
            return count
        length = seconds_of("stride", self.stride.removeprefix("about "), "'auto', ")
        if self.stride.startswith("about "):
            return max(1, round(length / sample_time))
        return samples_of("stride", length, t)

    @property
    def _window_steps(self) -> int:
        if self.steps != "auto":
            return self.steps
        longest = max(item.duration for item in self.splits.train)
        return max(1, min(_LONGEST_WINDOW, int(longest / 2 / self.step)))

    @functools.cached_property
    def windows(self) -> Windows:
        """Training windows. The batch size is limited to their number."""
        runs, stride, steps = self.splits.train, self._samples, self._window_steps
        starts = sum(max(len(x.t) - steps * stride, 0) for x in runs)
        count = None if self.pairs == "all" else self.pairs
        if count == "auto":
            samples = sum(len(x.t) for x in runs)
            count = min(max(samples // (steps * stride), _FEWEST_WINDOWS), _MOST_WINDOWS)
        if count is not None and 0 < starts < count:
            log.info("data.pairs is %d, all %d windows of the short data are used", count, starts)
            count = starts
        windows = draw_windows(
            runs,
            count=count,
            steps=steps,
            stride=stride,
            seed=None if self.pairs == "auto" else self.seed,
            coverage=self.coverage,
            history=self.history,
        )
        self.batch_size = min(self.batch_size, len(windows))
        return windows

    @property
    def statistics(self) -> Statistics:
        """Scales of the training windows."""
        return self.windows.statistics()
