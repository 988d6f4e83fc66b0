"""Many copies of a stiff closed loop in continuous time, solved together by an implicit method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from scipy.integrate import BDF
from scipy.sparse import bsr_matrix, csc_matrix
from torch import Tensor
from tqdm import tqdm

from pinn_dyn.control.contracts import Motion, Reference


class StiffLoop:
    """dx/dt = field(t, x, *motion) for K copies, by BDF; losing one does not harm the others.

    All copies share the steps of one solver, so that a call of the field serves all of them: a
    solver for each takes 6.5 times as long for 6 copies of the soft arm, and longer for more.

    Attributes:
        states: solution at the samples, ``(K, T, 2N)``; NaN once a copy is lost.
        ends: for each copy, when in s it was lost, infinity if never, and why.
    """

    def __init__(
        self,
        field: Callable[..., Tensor],
        reference: Reference,
        x0: Tensor,
        t: Tensor,
        q_bound: float,
    ):
        self._field, self._reference, self._t, self._q_bound = field, reference, t, q_bound
        self.states = x0.new_full((len(x0), len(t), x0.shape[-1]), torch.nan)
        self.states[:, 0] = x0
        self.ends = [(np.inf, "")] * len(x0)

    def solve(self, rtol: float, atol: float, progress: str | None) -> None:
        """Solve all copies together; where that fails, each half of them on its own."""
        everyone = torch.arange(len(self.states))
        pending = [(everyone, 0.0, self.states[:, 0])]
        with tqdm(
            total=len(everyone) * float(self._t[-1]),
            desc=progress,
            disable=progress is None or None,  # None: unless on a terminal
            bar_format="{l_bar}{bar}| {n:.2f}/{total:.2f} s simulated [{elapsed}<{remaining}]",
        ) as bar:
            while pending:
                who, time, x = pending.pop()
                time, x, lost = self._solve_together(who, time, x, rtol, atol, bar)
                if time == float(self._t[-1]) or lost.all():
                    continue
                if lost.any():
                    pending.append((who[~lost], time, x[~lost]))
                else:
                    halves = zip(who.tensor_split(2), x.tensor_split(2), strict=True)
                    pending += [(part, time, states) for part, states in halves]

    def _solve_together(
        self, who: Tensor, time: float, x: Tensor, rtol: float, atol: float, bar: tqdm
    ) -> tuple[float, Tensor, Tensor]:
        """Solve some copies as far as it goes; returns the time, their states and who is lost."""
        end = float(self._t[-1])
        lost = ~finite_rows(self._rows(who, time, x))
        if lost.any():
            return self._lose(who, time, x, lost, "the acceleration is not finite")
        # SciPy takes the root mean square over all copies: this keeps each one within rtol, atol.
        share = len(who) ** -0.5
        solver = BDF(
            lambda t, flat: self._rows(who, t, self._unflatten(who, flat)).numpy().ravel(),
            time,
            x.numpy().ravel(),
            end,
            rtol=share * rtol,
            atol=share * atol,
            jac=lambda t, flat: self._jacobian(who, t, self._unflatten(who, flat)),
        )
        while solver.status == "running":
            solver.step()
            if solver.status == "failed":
                lost = torch.full((len(who),), len(who) == 1)
                return self._lose(who, time, x, lost, "the solver cannot follow the motion")
            samples = (self._t > time) & (self._t <= solver.t)
            bar.update(len(who) * (solver.t - time))
            time, x = float(solver.t), self._unflatten(who, solver.y)
            if samples.any():
                dense = torch.from_numpy(solver.dense_output()(self._t[samples].numpy()))
                self.states[who[:, None], samples.nonzero()[:, 0]] = dense.unflatten(
                    0, (len(who), -1)
                ).transpose(1, 2)
            lost = (x.chunk(2, dim=-1)[0].abs() > self._q_bound).any(-1)
            if lost.any():
                return self._lose(who, time, x, lost, f"|q| is beyond {self._q_bound:g}")
        return end, x, lost

    def _lose(
        self, who: Tensor, time: float, x: Tensor, lost: Tensor, reason: str
    ) -> tuple[float, Tensor, Tensor]:
        for copy in who[lost].tolist():
            self.ends[copy] = (time, f"the plant diverged: {reason}")
        return time, x, lost

    def _rows(self, who: Tensor, time: float, x: Tensor) -> Tensor:
        """dx/dt of states ``(*batch, k, 2N)``; a row that cannot be solved is NaN."""
        motion = motion_of_copies(self._reference, time, self.states[:, 0].chunk(2, dim=-1)[0])
        rows = [y[who].expand(*x.shape[:-1], -1).flatten(0, -2) for y in motion]
        return self._field(time, x.flatten(0, -2), *rows).reshape(x.shape)

    def _jacobian(self, who: Tensor, time: float, x: Tensor) -> csc_matrix:
        """Forward differences of all copies at once: a block of 2N x 2N for each."""
        size = x.shape[-1]
        step = torch.finfo(x.dtype).eps ** 0.5 * x.abs().clamp_min(1.0)
        shifted = (x[:, None] + torch.diag_embed(step)).transpose(0, 1)
        values = self._rows(who, time, torch.cat([x[None], shifted]))
        blocks = (values[1:] - values[:1]).permute(1, 2, 0) / step[:, None]
        # One entry that is not finite would spoil the factors of every copy.
        blocks = blocks.nan_to_num(0.0, 0.0, 0.0)
        index = np.arange(len(who) + 1)
        shape = (len(who) * size,) * 2
        return bsr_matrix((blocks.numpy(), index[:-1], index), shape=shape).tocsc()

    def _unflatten(self, who: Tensor, flat: np.ndarray) -> Tensor:
        return torch.from_numpy(np.array(flat)).reshape(len(who), -1)


def finite_rows(x: Tensor) -> Tensor:
    """Which rows of ``(*batch, n)`` hold finite numbers only, ``(*batch,)``."""
    return x.isfinite().all(-1)


def motion_of_copies(reference: Reference, time: float, like: Tensor) -> Motion:
    """The reference at one time, for each copy: ``(K, N)`` like another tensor.

    Raises:
        ValueError: if it is neither one motion for all copies nor one for each.
    """
    motion = reference(time)
    for name, value in zip(Motion._fields, motion, strict=True):
        if value.shape not in (like.shape, like.shape[1:]):
            raise ValueError(
                f"the reference's {name} has shape {tuple(value.shape)}, expected "
                f"{tuple(like.shape[1:])} or {tuple(like.shape)}: one motion for all copies, or "
                "one for each"
            )
    return Motion(*(value.to(like).expand_as(like) for value in motion))
