"""Windows: short pieces of training trajectories, the training samples."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import islice, repeat
from typing import Any

import scipy
import torch
from torch import Tensor
from torch.utils.data import Sampler

from pinn_dyn.mechanics import Signal, State, Trajectory
from pinn_dyn.mechanics.signal import stacked
from pinn_dyn.models.statistics import Statistics

_ROWS = ("q", "v", "p", "dq", "dv", "dp", "past_q")
"""Fields with a row per window. The input has a row per window, too."""


@dataclass(frozen=True)
class Windows:
    """B windows of H steps. With H = 1, windows are the paper's transition pairs.

    A step spans ``stride`` samples of the data. The input keeps all samples.

    Attributes:
        t: times of the steps from the window's start, ``(H + 1,)``, s.
        q, v: state at the start, ``(B, N)``.
        p: momentum at the start, ``(B, N)``; empty ``(B, 0)`` where there is none.
        dq, dv, dp: increments from the start to each step, ``(B, H, N)``, of double precision.
        input: u, with samples ``(B, past + H * stride + 1, M)``.
        past_q: q at the steps before the start, the latest first, ``(B, past // stride, N)``.
        past: number of samples of the input before the start, for models with a delay or a memory.
    """

    t: Tensor
    q: Tensor
    v: Tensor
    p: Tensor
    dq: Tensor
    dv: Tensor
    dp: Tensor
    input: Signal
    past_q: Tensor
    past: int = field(default=0, kw_only=True)

    def __len__(self) -> int:
        return self.q.shape[0]

    def __getitem__(self, index: Tensor) -> Windows:
        """Return the windows at the positions ``index``."""
        rows, shape = index.flatten(), index.shape
        # Several times faster than value[index].
        return self._map(lambda x: x.index_select(0, rows).view(*shape, *x.shape[1:]))

    def unbind(self) -> Iterator[Windows]:
        """Iterate over the first of several batch dimensions, by views."""
        rows = zip(*(getattr(self, name).unbind() for name in _ROWS), strict=True)
        rate = self.input.rate
        rates = repeat(None) if rate is None else rate.unbind()
        for values, u, slope in zip(rows, self.input.u.unbind(), rates, strict=False):
            item = object.__new__(type(self))  # much faster than the constructor
            picked = zip(_ROWS, values, strict=True)
            item.__dict__.update(self.__dict__, input=self.input.with_samples(u, slope))
            item.__dict__.update(picked)
            yield item

    def split(self, size: int) -> list[Windows]:
        """Split the windows into equal parts (up to one window) of at least ``size`` windows."""
        number = len(self) // size
        if number < 2:
            return [self]
        return [self[index] for index in torch.arange(len(self)).tensor_split(number)]

    def to(self, device: torch.device, dtype: torch.dtype | None = None) -> Windows:
        """Move all tensors to a device and, optionally, a dtype."""
        moved = self._map(lambda value: value.to(device, dtype))
        return replace(moved, t=self.t.to(device, dtype), input=self.input.to(device, dtype))

    def _map(self, change: Callable[[Tensor], Tensor]) -> Windows:
        changed: dict[str, Any] = {name: change(getattr(self, name)) for name in _ROWS}
        return replace(self, **changed, input=self.input.mapped(change))

    @property
    def u(self) -> Tensor:
        """Samples of the input from the start on, ``(B, H * stride + 1, M)``."""
        return self.input.u[..., self.past :, :]

    def start(self, state: State, past: int = 0) -> Tensor:
        """Return (q, v) or (q, p) at the start and n = ``past`` earlier q, ``(B, 2N + nN)``."""
        earlier = [self.past_q[..., :past, :].flatten(-2)] if past else []
        return torch.cat([self.q, self.v if state == "qv" else self.p, *earlier], dim=-1)

    def increments(self, state: State) -> Tensor:
        """Return the increments of (q, v) or (q, p) to each step, ``(B, H, 2N)``."""
        return torch.cat([self.dq, self.dv if state == "qv" else self.dp], dim=-1)

    def first(self, steps: int) -> Windows:
        """Cut the windows after ``steps`` steps."""
        if steps == len(self.t) - 1:
            return self
        stride = (len(self.input.t) - 1 - self.past) // (len(self.t) - 1)
        samples = self.past + steps * stride + 1
        return replace(
            self,
            t=self.t[: steps + 1],
            input=self.input.part(slice(samples)),
            **{name: getattr(self, name)[..., :steps, :] for name in ("dq", "dv", "dp")},
        )

    def statistics(self) -> Statistics:
        """Return means, standard deviations and ranges over the windows."""

        def spread(values: Tensor) -> Tensor:
            if not values.numel():
                return values.new_ones(values.shape[1:])
            std = values.std(0, correction=0)
            return torch.where(std > 1e-12, std, torch.ones_like(std))

        qv_std = spread(self.increments("qv"))
        p_std, qp_std = torch.ones_like(self.q[0]), torch.ones_like(qv_std)
        if self.p.shape[-1] > 0:
            p_std, qp_std = spread(self.p), spread(self.increments("qp"))
        return Statistics(
            q_mean=self.q.mean(0),
            q_std=spread(self.q),
            q_low=self.q.amin(0),
            q_high=self.q.amax(0),
            v_std=spread(self.v),
            p_std=p_std,
            u_mean=self.u.mean((0, 1)),
            u_std=spread(self.u.flatten(0, 1)),
            qv_increment_std=qv_std,
            qp_increment_std=qp_std,
            step=float(self.t[1]),
        )


def draw_windows(
    trajectories: list[Trajectory],
    *,
    count: int | None,
    steps: int,
    stride: int,
    seed: int | None,
    coverage: float = 0.0,
    history: float = 0.0,
) -> Windows:
    """Draw windows at random or evenly spaced starts from all trajectories.

    With ``coverage`` c = 0, all starts are equally likely. With c > 0, their probabilities are
    ~ (d_k)^(c N), where d_k is the distance of q ``(N,)``, in units of the spread of q, from its
    tenth nearest neighbor. Since 1/d_k^N estimates the density (Loftsgaarden and Quesenberry 1965),
    c = 1 spreads the windows evenly over the configurations.

    Args:
        trajectories: the training trajectories, each ``(T, N)``, with one sample time.
        count: number of windows B; None for a window at each start.
        steps: steps H of a window.
        stride: samples in a step.
        seed: seed of the starts; None for evenly spaced starts.
        coverage: c, from 0 to 1.
        history: time before each start for which q and u are stored, s. Before the earliest sample,
            they are constant.

    Raises:
        ValueError: if sample times differ, or there are more windows than starts.
    """
    span = steps * stride
    sample = float(trajectories[0].t[1] - trajectories[0].t[0])
    for k, item in enumerate(trajectories):
        if (item.t.diff() - sample).abs().max() > 1e-6 * sample:
            raise ValueError(
                f"training trajectory {k} has sample times other than {sample:g} s: resample it"
            )
    past = math.ceil(history / sample - 1e-6)
    trajectories = [item.since(history) for item in trajectories]
    starts = torch.tensor([max(item.t.shape[0] - span - past, 0) for item in trajectories])
    total = int(starts.sum())
    count = max(total, 1) if count is None else count
    if total < count:
        raise ValueError(
            f"{count} windows of {span} samples do not fit, the training trajectories have "
            f"only {total} starts: take fewer pairs, a shorter window or more data"
        )
    generator = torch.Generator().manual_seed(seed or 0)
    if seed is None:
        flat = ((torch.arange(count, dtype=torch.float64) + 0.5) * (total / count)).long()
    elif coverage > 0:
        flat = _distinct(total, min(max(10 * count, 400_000), total), generator)
        parts = [item.q[past:][:n] for item, n in zip(trajectories, starts, strict=True)]
        q = torch.cat(parts)[flat]
        z = (q / q.std(0).clamp(min=1e-12)).numpy()
        # The nearest neighbor of a row is the row itself.
        distances, _ = scipy.spatial.cKDTree(z).query(z, k=min(11, len(z)))
        distance = torch.from_numpy(distances[:, -1])
        # Sample with weights: the largest log(uniform)/weight (Efraimidis and Spirakis 2006).
        uniform = torch.rand(len(z), generator=generator, dtype=torch.float64)
        weight = distance.clamp(min=1e-12) ** (coverage * q.shape[-1])
        flat = flat[torch.topk(uniform.log() / weight, count).indices]
    else:
        flat = _distinct(total, count, generator)
    ends = starts.cumsum(0)
    number = torch.searchsorted(ends, flat, right=True)
    offset = past + flat - (ends - starts)[number]

    knots = torch.arange(steps + 1) * stride
    origins = [(trajectories[i], k) for i, k in zip(number, offset, strict=True)]
    q = torch.stack([x.q[k + knots] for x, k in origins])
    v = torch.stack([x.v[k + knots] for x, k in origins])
    inputs = [x.input.part(slice(k - past, k + span + 1)) for x, k in origins]
    t = torch.arange(-past, span + 1, dtype=torch.float64) * sample
    momentum = trajectories[0].momentum
    p = q.new_zeros((count, steps + 1, 0)) if momentum is None else momentum(q, v)
    return Windows(
        t=knots.double() * sample,
        q=q[:, 0],
        v=v[:, 0],
        p=p[:, 0],
        dq=q[:, 1:] - q[:, :1],
        dv=v[:, 1:] - v[:, :1],
        dp=p[:, 1:] - p[:, :1],
        input=stacked(inputs, t),
        past_q=torch.stack([x.q[k - past : k].flip(0)[stride - 1 :: stride] for x, k in origins]),
        past=past,
    )


def _distinct(total: int, count: int, generator: torch.Generator) -> Tensor:
    # The total may be too large for a permutation.
    numbers = torch.unique(torch.randint(total, (count,), generator=generator))
    while numbers.shape[0] < count:
        more = torch.randint(total, (count,), generator=generator)
        numbers = torch.unique(torch.cat([numbers, more]))
    return numbers[torch.randperm(numbers.shape[0], generator=generator)[:count]]


PICKED = 16_384
"""Approximate number of windows that a single operation gathers, for many small batches."""


@dataclass(eq=False)
class WindowLoader:
    """Loader of batches from windows in the memory of a device.

    Attributes:
        windows: all windows, on the training device.
        sampler: indices of the windows of each batch, ``(B,)``.
    """

    windows: Windows
    sampler: Sampler[Tensor]

    def __len__(self) -> int:
        return len(self.sampler)  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Windows]:
        device = self.windows.q.device
        indices = iter(self.sampler)
        for first in indices:
            following = islice(indices, max(PICKED // first.numel(), 1) - 1)
            index = torch.stack([first, *following]).to(device, non_blocking=True)
            yield from self.windows[index].unbind()


@dataclass(eq=False)
class BatchSampler(Sampler[Tensor]):
    """Batches of an epoch. Their order depends only on the seed and the epoch.

    Attributes:
        size: number of windows.
        batch_size: windows in a batch.
        batches: batches in an epoch.
        seed: seed of the order.
        rank, processes: index of this process and number of processes, which share each batch.
    """

    size: int
    _: KW_ONLY
    batch_size: int
    batches: int
    seed: int
    rank: int = 0
    processes: int = 1
    epoch: int = field(default=0, init=False)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch. The trainer calls this method at the start of each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[Tensor]:
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + self.epoch)
        per_pass = max(self.size // self.batch_size, 1)
        for first in range(0, self.batches, per_pass):
            order = torch.randperm(self.size, generator=generator)[: per_pass * self.batch_size]
            rows = order.view(per_pass, -1)[:, self.rank :: self.processes]
            yield from rows[: self.batches - first].unbind()
