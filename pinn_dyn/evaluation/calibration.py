"""Whether the intervals of predictions hold what they promise, on motions that nobody fitted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from scipy.stats import t as student
from torch import Tensor

from pinn_dyn.evaluation.metrics import diverged_trajectories
from pinn_dyn.evaluation.plots import model_style
from pinn_dyn.evaluation.prediction import Prediction

LEVEL = 0.95
"""What an interval is said to hold, where one number is wanted."""

_LEVELS = np.array([0.05, *np.arange(0.1, 0.91, 0.1), LEVEL, 0.99])
_AT = -2  # of LEVEL among them


@dataclass(frozen=True)
class Calibration:
    """How much of held-out errors the intervals of some levels contain.

    Attributes:
        level: what the intervals promise, ``(L,)``.
        share: what they contain, ``(L,)``: as wide as the members say.
        corrected: the same once their width is that which the validation motions needed, ``(L,)``;
            None without any.
        factor: corrected width over that of the members at 95 %; None as well.
    """

    level: np.ndarray
    share: np.ndarray
    corrected: np.ndarray | None
    factor: float | None

    @property
    def within(self) -> float:
        """``share`` of the 95 % interval."""
        return float(self.share[_AT])

    @property
    def within_corrected(self) -> float | None:
        """``corrected`` of the 95 % interval."""
        return None if self.corrected is None else float(self.corrected[_AT])


def half_widths(members: int, level: float | np.ndarray = LEVEL) -> np.ndarray:
    """Half the width of an interval in standard deviations sqrt(1 + 1/E) s of E members.

    Student's t with E - 1 degrees of freedom: what a further member, and so the truth if it is like
    one, lies within.
    """
    return np.asarray(student.ppf(0.5 + 0.5 * np.asarray(level), members - 1))


def standardized_errors(prediction: Prediction) -> Tensor:
    """|q - q_hat| / (sqrt(1 + 1/E) s), ``(K, T - 1, N)``, with s the spread of the E members.

    Without the start, where there is neither error nor spread. Infinite where a roll-out diverged
    and where the members agree on something else than the truth.

    Raises:
        ValueError: on the prediction of a single model.
    """
    deviation = prediction.deviation()[:, 1:]
    assert prediction.members is not None
    deviation = deviation * (1 + 1 / len(prediction.members)) ** 0.5
    error = (prediction.q - prediction.q_hat).abs()[:, 1:]
    ratio = torch.where(error > 0, error / deviation, 0.0).nan_to_num(torch.inf, posinf=torch.inf)
    lost = diverged_trajectories(prediction)
    return torch.where(lost[:, None, None], torch.inf, ratio)


def calibration(held_out: Prediction, validation: Prediction | None) -> Calibration:
    """Nominal levels of intervals against what they contain, over all coordinates and times.

    The interval of level p is q_hat +- c_p sqrt(1 + 1/E) s. As the members say, c_p is the quantile
    of :func:`half_widths`. Corrected, it is what contains the share p of the validation errors:
    members know nothing of the noise of the measured start, nor of what no model of theirs can
    say. Source: Lei et al. 2018, "Distribution-free predictive inference for regression", sec. 5.2
    (locally weighted conformal inference).

    Args:
        held_out: roll-outs of motions that took no part in training, with members.
        validation: roll-outs of the validation motions over the same time, if there are any.
    """
    assert held_out.members is not None
    found = standardized_errors(held_out).flatten().numpy()
    width = half_widths(len(held_out.members), _LEVELS)
    share = _within(found, width)
    if validation is None:
        return Calibration(_LEVELS, share, None, None)
    seen = standardized_errors(validation).flatten().numpy()
    needed = np.quantile(seen, _LEVELS, method="higher")
    factor = float(needed[_AT] / width[_AT])
    return Calibration(_LEVELS, share, _within(found, needed), factor)


def calibration_table(found: Mapping[str, Mapping[float, Calibration]]) -> pd.DataFrame:
    """One row per run, window and level: ``share``, ``corrected`` and ``factor``."""
    rows = [
        {
            "run": run,
            "window": window,
            "level": float(level),
            "share": float(item.share[k]),
            "corrected": None if item.corrected is None else float(item.corrected[k]),
            "factor": item.factor,
        }
        for run, windows in found.items()
        for window, item in windows.items()
        for k, level in enumerate(item.level)
    ]
    return pd.DataFrame(rows)


def interval_lines(found: Mapping[str, Mapping[float, Calibration]]) -> list[str]:
    """What the 95 % intervals of each run hold, in a line for each."""
    lines = []
    for run, windows in found.items():
        parts = []
        for window, item in windows.items():
            text = f"{100 * item.within:.0f} % after {window:g} s"
            if item.within_corrected is not None:
                corrected = f"{100 * item.within_corrected:.0f} %"
                text += f" ({corrected} with {item.factor:.3g} times the width)"
            parts.append(text)
        if parts:
            lines.append(f"{run}: its 95 % intervals hold {', '.join(parts)} of the errors")
    return lines


def calibration_figure(found: Mapping[str, Mapping[float, Calibration]], *, title: str) -> Figure:
    """Levels of intervals against what they contain, a panel for each window.

    On the diagonal an interval holds what it promises; below, it is too narrow.

    Args:
        found: names of runs, and their calibration for each window in s.
        title: data set.
    """
    windows = sorted({window for item in found.values() for window in item})
    size = (max(3.6 * len(windows) + 0.6, 6.0), 4.2 + 0.25 * len(found))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, len(windows), sharey=True, squeeze=False)[0]
    for ax, window in zip(axes, windows, strict=True):
        honest = "what is promised; below: too narrow"
        ax.plot([0, 100], [0, 100], color="black", linewidth=0.8, label=honest)
        for index, (run, item) in enumerate(found.items()):
            if window not in item:
                continue
            one, colour = item[window], model_style(index)["color"]
            ax.plot(100 * one.level, 100 * one.share, "o-", color=colour, markersize=4, label=run)
            if one.corrected is not None:
                label = f"{run}, width from validation"
                ax.plot(100 * one.level, 100 * one.corrected, "--", color=colour, label=label)
        ax.set_title(f"re-set every {window:g} s", fontsize="medium")
        ax.set_xlabel("promised by the interval [%]")
        ax.set_xlim(0, 100)
        ax.set_ylim(0, 101)
        ax.grid(True, alpha=0.3)
    axes[0].set_ylabel("errors within [%]")
    named = dict(zip(*axes[0].get_legend_handles_labels()[::-1], strict=True))
    figure.legend(named.values(), named, loc="outside lower center", ncols=2, fontsize="small")
    figure.suptitle(title)
    return figure


def _within(errors: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Shares of errors up to each width, those that are infinite never among them."""
    finite = np.sort(errors[np.isfinite(errors)])
    return np.searchsorted(finite, width, side="right") / max(len(errors), 1)
