"""Random windows of one step, and the scales that go with them."""

from dataclasses import replace

import torch

from pinn_dyn.data import Windows
from pinn_dyn.mechanics import Signal
from tests.models.builders import STEP, make_statistics


def make_windows(count, size=1, interpolation="linear", seed=0):
    """Windows of one step, with an input that jumps within it."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return 0.3 * torch.randn(*shape, generator=generator, dtype=torch.float64)

    t = torch.linspace(0, STEP, 3, dtype=torch.float64)
    return Windows(
        t=torch.tensor([0.0, STEP], dtype=torch.float64),
        q=normal(count, size),
        v=normal(count, size),
        p=normal(count, size),
        dq=STEP * normal(count, 1, size),
        dv=STEP * normal(count, 1, size),
        dp=STEP * normal(count, 1, size),
        input=Signal(t, normal(count, 3, size), interpolation),
        past_q=torch.zeros(count, 0, size, dtype=torch.float64),
    )


def spread_out(windows):
    """The same windows, no number of which lies beside the next, as where longer ones are cut."""
    return windows._map(lambda values: torch.stack([values, -values], dim=-1)[..., 0])


def one_step(size=1):
    scales = make_statistics(size, size)
    return replace(
        scales,
        qv_increment_std=scales.qv_increment_std[:1],
        qp_increment_std=scales.qp_increment_std[:1],
    )
