"""Modes of a linearized model: eigenfrequencies, damping ratios and shapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import pandas as pd
import torch
from torch import Tensor


@dataclass(frozen=True)
class Modes:
    r"""Modes of x_{k+1} = A x_k + B u_k, q_k = C x_k, in the order of decreasing strength.

    An eigenvalue e of A corresponds to the pole s = log(e) / h with the step h. A pair of conjugate
    poles is a single mode. A mode without oscillation has the damping ratio 1.

    Attributes:
        frequency: \|s\| / (2 pi), ``(P,)``, Hz.
        damping: damping ratio, -Re(s) / \|s\|, ``(P,)``.
        shapes: C times the eigenvectors, ``(P, N)``, complex, in the units of q. The largest entry
            in relation to the spread is real, and has the size of the spread.
        share: standard deviation of q due to a single mode under white noise at the inputs,
            relative to the strongest mode, ``(P,)``.
        spread: standard deviations of q in the training data, ``(N,)``.
    """

    frequency: Tensor
    damping: Tensor
    shapes: Tensor
    share: Tensor
    spread: Tensor

    @property
    def relative_shapes(self) -> Tensor:
        """Real parts of the shapes relative to the spreads, ``(P, N)``, between -1 and 1."""
        return self.shapes.real / self.spread

    def to_frame(self, labels: Sequence[str] | None = None) -> pd.DataFrame:
        """Return a table with a row per mode: amplitude and phase of the shape per coordinate."""
        names = list(labels or (f"q{k + 1}" for k in range(len(self.spread))))
        columns = {
            "frequency_Hz": self.frequency,
            "damping_ratio": self.damping,
            "share": self.share,
        }
        for name, values in zip(names, self.shapes.T, strict=True):
            columns[f"amplitude of {name}"] = values.abs()
            columns[f"phase of {name.partition(' [')[0]} [deg]"] = values.angle().rad2deg()
        frame = pd.DataFrame({key: value.numpy() for key, value in columns.items()})
        frame.insert(0, "mode", range(1, len(frame) + 1))
        return frame


def modes_of(A: Tensor, B: Tensor, C: Tensor, *, step: float, spread: Tensor) -> Modes:
    """Return the modes of a stable system in discrete time.

    Args:
        A, B, C: ``(S, S)``, ``(S, M)`` with inputs of equal importance, and ``(N, S)``.
        step: h, s.
        spread: standard deviations of q, ``(N,)``.
    """
    eigenvalues, vectors = torch.linalg.eig(A)
    excitation = torch.linalg.solve(vectors, B.to(vectors))
    shapes = (C.to(vectors) @ vectors).T
    relative = shapes / spread
    # After k steps, q is 2 Re(impulses e^k) for a complex pair, and half of it for a real e.
    impulses = relative.unsqueeze(-1) * excitation.unsqueeze(-2)
    power, square = impulses.abs().square().sum((1, 2)), impulses.square().sum((1, 2))
    variance = 2 * power / (1 - eigenvalues.abs().square())
    variance = variance + 2 * (square / (1 - eigenvalues.square())).real
    share = (variance / torch.where(eigenvalues.imag == 0, 4.0, 1.0)).clamp(min=0).sqrt()
    largest = relative.gather(1, relative.abs().argmax(dim=1, keepdim=True))
    order = (eigenvalues.imag >= 0).nonzero()[:, 0]
    order = order[share[order].argsort(descending=True)]
    poles = eigenvalues[order].log() / step
    return Modes(
        frequency=poles.abs() / (2 * math.pi),
        damping=-poles.real / poles.abs(),
        shapes=(shapes / largest)[order],
        share=share[order] / share[order].max(),
        spread=spread,
    )
