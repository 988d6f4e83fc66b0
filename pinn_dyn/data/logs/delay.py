"""Delay between an input and its motion, estimated from the equation of motion.

A correlation of q with u includes the lag of the robot itself. Here a candidate d is judged by the
share that the equation of motion leaves unexplained. Three forms of it are tried, and a fourth for
rigid robots:

    inverse dynamics    u_i(t - d_i) = f_i(q, v, a),    with at most as many inputs as q
    increments          v = f(q) + B(u(t - d)),         overdamped robots
    acceleration        a = f(q, v) + B(u(t - d))
    rigid bodies        u_i(t - d_i) = Y_i(q, v, a) pi + friction,    if the kinematics are known
                                                                      and no other form answers

f and B are linear in their parameters (least squares). All signals are averaged by one Gaussian
kernel g of width s, whose slopes give the derivatives: g * a = g'' * q. A linear equation then
stays true, the delay included, without a derivative of noise. The form and width count whose
estimate varies least when tenths of the data are left out in turn (jackknife).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pinn_dyn.data.logs.delay_regression import (
    BLOCKS,
    Regressor,
    Remainder,
    Smoothed,
    rigid_shares,
    terms,
)
from pinn_dyn.data.logs.recording import Recording

_WIDTHS = (0.005, 0.01, 0.02, 0.04, 0.08)  # of the kernel, s
_CANDIDATES = 60  # at most: a parabola finds what is between them
# The residual must fall to this share of its usual value, and the spread of the estimate stay below
# this share of a sample, or of 10 ms.
_DEPTH = 0.9
_SPREAD = 0.6
_UNEXPLAINED = 0.4
_AS_WELL = 1.1  # factor between residuals up to which a common delay explains as well
_AFTER = "the input is logged after the motion: a filtered measurement, or another clock"
_RIGID = "rigid bodies"
_ONE_LINE = 0.995  # of the power of a signal


@dataclass(frozen=True)
class DelayCurve:
    """Share of the motion that its equation leaves unexplained, over the delay of an input.

    Attributes:
        candidates: d, ``(D,)``, s.
        residual: unexplained share of the variance at each d, ``(D,)``.
        delay: the d of the smallest residual, s; None if the data do not determine it.
        spread: standard deviation of the estimate by the jackknife, s.
        form: equation of motion.
        reason: reason why there is no delay, "" otherwise.
    """

    candidates: np.ndarray
    residual: np.ndarray
    delay: float | None
    spread: float
    form: str
    reason: str = ""

    def __str__(self) -> str:
        if self.delay is None:
            return f"no delay: {self.reason}"
        best = int(np.argmin(self.residual))
        return (
            f"{1e3 * self.delay:.1f} ± {1e3 * self.spread:.1f} ms ({self.form}: "
            f"{100 * self.residual[best]:.2g} % unexplained, "
            f"{100 * np.interp(0.0, self.candidates, self.residual):.2g} % without a delay)"
        )


def input_delays(
    recordings: Sequence[Recording],
    *,
    longest: float = 0.3,
    common: bool = False,
    rigid: Regressor | None = None,
) -> list[DelayCurve]:
    """Estimate the delay of each input, or one for all, from uniformly sampled stretches.

    Args:
        recordings: stretches of one sample time, q and u in them.
        longest: longest delay that is tried, s.
        common: estimate one delay for all inputs.
        rigid: regressor Y of a rigid robot with one input per joint, or None. Without it, seven
            joints have more terms than minutes of data determine.

    Returns:
        A curve per input; the same curve for all if ``common``.

    Raises:
        LogError: if a clock is not uniform.
    """
    step = recordings[0].sample_time("a delay")
    inputs = recordings[0].u.shape[1]
    stride = max(1, round(longest / step / _CANDIDATES))
    lags = stride * np.arange(-2, max(round(longest / step / stride), 3) + 1)
    widths = sorted({max(width, 1.5 * step) for width in _WIDTHS})
    forms: dict[str, list[list[DelayCurve]]] = {}
    for width in widths:
        data = Smoothed.average(recordings, step, width, lags)
        if data is not None:
            for form, trial in _trials(data, lags * step, inputs, common, rigid).items():
                forms.setdefault(form, []).append(trial)
    if not forms:
        short = "the stretches are too short"
        return [DelayCurve(lags * step, np.ones(len(lags)), None, np.inf, "none", short)] * inputs
    best = {
        form: [min((trial[i] for trial in trials), key=_rank) for i in range(inputs)]
        for form, trials in forms.items()
    }
    bodies = best.pop(_RIGID, None)
    curves = min(best.values(), key=lambda x: tuple(np.mean([_rank(c) for c in x], axis=0)))
    if bodies is not None:  # its friction is simpler than in the other forms, so it comes last
        curves = [
            of_bodies if of_bodies.delay is not None and _is_open(curve) else curve
            for curve, of_bodies in zip(curves, bodies, strict=True)
        ]
    lines = [_is_one_line([item.u[:, i] for item in recordings]) for i in range(inputs)]
    if all(lines) or (any(lines) and not common):
        reason = "the input is a single sine, whose delay looks like damping"
        curves = [
            replace(curve, delay=None, reason=reason) if line or common else curve
            for curve, line in zip(curves, lines, strict=True)
        ]
    return curves


def agreed_delays(
    recordings: Sequence[Recording], *, longest: float = 0.3, rigid: Regressor | None = None
) -> tuple[list[DelayCurve], bool]:
    """Estimate the delay of each input, or one for all where single answers are not good.

    Most delays are those of a bus or a filter that all inputs share, and a common estimate uses the
    data of all inputs. If an input has no answer, or two answers differ by more than a sample, a
    common delay is tried, unless an input is logged after the motion. It counts if it lies within
    a sample of the range of the single answers and explains the motion about as well.

    Arguments and errors are those of :func:`input_delays`.

    Returns:
        A curve per input, and true if they are the common curve.
    """
    single = input_delays(recordings, longest=longest, rigid=rigid)
    delays = [curve.delay for curve in single if curve.delay is not None]
    complete = len(delays) == len(single)
    step = recordings[0].sample_time("a delay")
    after = any(curve.reason == _AFTER for curve in single)
    agree = complete and max(delays) - min(delays) <= step
    if len(single) == 1 or not delays or after or agree:
        return single, False
    common = input_delays(recordings, longest=longest, common=True, rigid=rigid)
    left, left_in_common = (np.mean([c.residual.min() for c in x]) for x in (single, common))
    among = common[0].delay is not None and (
        min(delays) - step <= common[0].delay <= max(delays) + step
    )
    if not among or (complete and left_in_common > _AS_WELL * left):
        return single, False
    return common, True


def _rank(curve: DelayCurve) -> tuple[bool, float]:
    return curve.delay is None, min(curve.spread, 1.0)


def _is_open(curve: DelayCurve) -> bool:
    """Tell whether there is no answer, not even that the input comes after the motion."""
    return curve.delay is None and curve.reason != _AFTER


def _is_one_line(signals: Sequence[np.ndarray]) -> bool:
    """Tell whether nearly all power of every stretch of a signal is in one spectral line."""
    for x in signals:
        power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(len(x)))) ** 2
        peak = int(power.argmax())
        if power[max(peak - 2, 0) : peak + 3].sum() < _ONE_LINE * power.sum():
            return False
    return True


def _trials(
    data: Smoothed,
    candidates: np.ndarray,
    inputs: int,
    common: bool,
    rigid: Regressor | None,
) -> dict[str, list[DelayCurve]]:
    """Return a curve per input for every form of the equation, at one width."""
    results = {}
    torques = {}
    if inputs <= data.q.shape[1]:
        known = terms(data, inverse=True)
        torques["inverse dynamics"] = Remainder.fit(known, data, data.a[:, :0]).of_targets()
    if rigid is not None and inputs == data.q.shape[1]:
        torques[_RIGID] = rigid_shares(data, rigid)
    for form, shares in torques.items():
        if common:
            shares = np.repeat(shares[..., :inputs].mean(axis=-1, keepdims=True), inputs, axis=-1)
        results[form] = [_curve(candidates, shares[..., i], form) for i in range(inputs)]
    for form, target in (("increments", data.v), ("acceleration", data.a)):
        known = terms(data, inverse=False, first_order=form == "increments")
        remainder = Remainder.fit(known, data, target)
        lag = np.zeros(data.u.shape[2], dtype=int)
        shares = remainder.of_inputs(lag, range(len(lag)))
        curves = [_curve(candidates, shares, form)] * inputs
        lag[:] = shares[0].argmin()
        for _ in range(0 if common or inputs == 1 else 2):
            for i in range(inputs):
                columns = [k for k, p in enumerate(data.powers) if p[i] == sum(p)]
                shares = remainder.of_inputs(lag, columns)
                lag[columns] = shares[0].argmin()
                curves[i] = _curve(candidates, shares, form)
        results[form] = curves
    return results


def _curve(candidates: np.ndarray, shares: np.ndarray, form: str) -> DelayCurve:
    """Return the curve of the shares that each delay leaves, ``(B + 1, D)``, with its verdict."""
    gap = candidates[1] - candidates[0]
    residual, best = shares[0], int(shares[0].argmin())
    minima = np.array([_minimum(candidates, share) for share in shares[1:]])
    spread = float(np.sqrt((BLOCKS - 1) * minima.var()))
    reason = ""
    if residual[best] > _UNEXPLAINED:
        share = 100 * residual[best]
        reason = f"the equation of motion leaves {share:.0f} % unexplained at any delay"
    elif not residual[best] < _DEPTH * np.median(residual):
        reason = "the residual is all but the same at every delay"
    elif spread > _SPREAD * max(gap, 0.01):
        reason = (
            f"parts of the data disagree by {1e3 * spread:.0f} ms: the motion is too slow, too "
            "regular or too noisy"
        )
    elif best >= len(candidates) - 2:
        reason = f"the residual still falls at the longest delay, {candidates[-1]:.3g} s"
    elif best == 0:
        reason = _AFTER
    delay = max(_minimum(candidates, residual), 0.0)
    return DelayCurve(candidates, residual, None if reason else delay, spread, form, reason)


def _minimum(candidates: np.ndarray, residual: np.ndarray) -> float:
    """Return the minimum of a parabola through the smallest value and its neighbors."""
    k = int(np.clip(np.argmin(residual), 1, len(residual) - 2))
    before, at, after = residual[k - 1 : k + 2]
    bend = before - 2 * at + after
    shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(candidates[k] + np.clip(shift, -1, 1) * (candidates[1] - candidates[0]))
