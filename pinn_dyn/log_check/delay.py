"""Delay between an input and its motion, estimated from the equation of motion.

A candidate d is judged by the share that an equation of motion leaves unexplained:

    inverse dynamics    u_i(t - d_i) = f_i(q, v, a),    with at most as many inputs as q
    rigid bodies        u_i(t - d_i) = Y_i(q, v, a) pi + friction,    if there is a structure
    motion of motors    v = f(q, u(t - d)) - T(q) a,    if motors move the robot

Motors move a robot with more inputs than q, or with positions or pressures as inputs. f is a
polynomial, of third order if the data are enough for it. An inertia acts like a delay, and makes up
for errors of f like a delay: if T explains more, the delay is between those without and with T.

Noise of the acceleration makes inertias too small, and a delay would make up for it: kernels that
leave too much noise are not used. The form and width count whose estimate varies least when parts
of the data are left out in turn (jackknife).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from pinn_dyn.data.logs import Recording
from pinn_dyn.log_check.averages import Averages, averages_of_widths
from pinn_dyn.log_check.equation import (
    GROUPS,
    RICH,
    EquationOfMotionRegression,
    Regressor,
    force_columns,
    tenths,
)

_CANDIDATES = 60  # at most: a parabola finds what is between them
_DEPTH = 0.8  # largest residual as a share of its median
_SPREAD = 0.6  # largest spread of an estimate as a share of a sample, or of 10 ms
_UNEXPLAINED = 0.4  # largest residual
_WORSE = 2.0  # residual over that of the best equation of motion, beyond which it is left out
_LITTLE = 0.7  # residual with inertia over that without, from which inertia explains little
FEWEST = 20 * GROUPS
"""Smallest number of rows of a regression."""
_AFTER = "the input is logged after the motion: a filtered measurement, or another clock"
_INVERSE, _RIGID = "inverse dynamics", "rigid bodies"
_LIGHT, _HEAVY = "motion without inertia", "motion with inertia"
_ONE_LINE = 0.995  # of the power of a signal
INTERVAL = 2.26
"""Half width of a 95 % interval in units of the jackknife's spread (Student, 9 degrees)."""
_FRICTION = 0.025  # smallest dry friction as a share of the spread of the input


@dataclass(frozen=True)
class DelayCurve:
    """Share of the motion that its equation leaves unexplained, over the delay of an input.

    Attributes:
        candidates: d, ``(D,)``, s.
        residual: unexplained share of the variance at each d, ``(D,)``.
        delay: the d of the smallest residual, s; None if the data do not determine it.
        spread: standard deviation of the estimate by the jackknife and over kernels, s.
        friction: dry friction over the spread of the input; NaN if it is not determined.
        friction_spread: standard deviation of ``friction`` by the jackknife.
        other: curve of the other equation of motion, if its smallest residual is elsewhere.
        form: equation of motion.
        reason: reason why there is no delay, "" otherwise.
    """

    candidates: np.ndarray
    residual: np.ndarray
    delay: float | None
    spread: float
    form: str
    reason: str = ""
    friction: float = np.nan
    friction_spread: float = np.nan
    other: DelayCurve | None = None

    @property
    def of_bodies(self) -> bool:
        """True if the equation is that of rigid bodies."""
        return self.form == _RIGID

    def without(self, reason: str) -> DelayCurve:
        """Return the curve without a delay, for a reason."""
        return replace(self, delay=None, reason=reason)

    @property
    def dry(self) -> bool:
        """True if the joint clearly has dry friction."""
        return self.friction > max(_FRICTION, 3 * self.friction_spread)


def input_delays(
    recordings: Sequence[Recording],
    *,
    longest: float = 0.3,
    rigid: Regressor | None = None,
    widths: Sequence[Averages] | None = None,
    motors: bool = False,
) -> list[DelayCurve]:
    """Estimate the delay of each input, or one for all of a robot that motors move.

    Args:
        recordings: stretches of one uniform sample time.
        longest: longest delay that is tried, s.
        rigid: regressor Y of a rigid robot with one input per joint, or None.
        widths: averages of the recordings with several kernels; None computes them.
        motors: true if the inputs are positions or pressures of motors. More inputs than
            coordinates always are.

    Raises:
        LogError: if a clock is not uniform.
    """
    step = recordings[0].sample_time("a delay")
    inputs, size = recordings[0].u.shape[1], recordings[0].q.shape[1]
    if not inputs:
        return []
    motors = motors or inputs > size
    stride = max(1, round(longest / step / _CANDIDATES))
    candidates = stride * step * np.arange(-2, max(round(longest / step / stride), 3) + 1)
    if widths is None:
        widths = averages_of_widths(recordings, step)
    trials = [
        data.rows((data.since >= candidates[-1]) & (data.left >= -candidates[0])) for data in widths
    ]
    trials = [data for data in trials if len(data) >= FEWEST]
    if not trials:
        ones, short = np.ones(len(candidates)), "the stretches are too short"
        return [DelayCurve(candidates, ones, None, np.inf, "none", short)] * inputs
    if motors:
        pairs = [_motion_curves(data, inputs, candidates) for data in trials]
        light, heavy = map(_best, zip(*pairs, strict=True))
        curves = [_between(light, heavy)] * inputs
    else:
        bodies = []
        if rigid is not None and inputs == size:
            bodies = [rigid(data.q, data.v, data.a) for data in trials]
        curves = [_force_curve(trials, i, bodies, candidates) for i in range(inputs)]
    for i in range(inputs):
        signals = [item.u[:, i] for item in recordings]
        if all(_is_sine(x) for x in signals):
            reason = "the input is a single sine, whose delay looks like damping"
            curves[i] = curves[i].without(reason)
    return curves


def clear_delays(curves: Sequence[DelayCurve], step: float) -> list[float]:
    """Return the delay of each input in s, or 0 where the data agree with no delay or do not tell.

    A delay is clear from one sample on, if its 95 % interval excludes half a sample: the hold of a
    sampled input is no delay. Delays that agree within their intervals are one delay.
    """
    values = np.array([np.nan if x.delay is None else x.delay for x in curves])
    usable = np.isfinite(values)
    if not usable.any():
        return [0.0] * len(curves)
    # The shape of the input between samples is worth a quarter of a sample.
    widths = INTERVAL * np.hypot([x.spread for x in curves], step / 4)
    weights = usable / widths**2
    mean = float(np.nansum(weights * values) / weights.sum())
    if (np.abs(values - mean) <= widths)[usable].all():
        values = np.where(usable, mean, np.nan)
        widths = np.full(len(curves), widths[usable].min())
    clear = (values >= step) & (values - widths > step / 2)
    return np.where(clear, values, 0.0).tolist()


def are_held(curves: Sequence[DelayCurve], step: float) -> bool:
    """Tell whether the inputs clearly act half a sample late, as values held between samples."""
    delays = np.array([x.delay for x in curves if x.delay is not None])
    widths = INTERVAL * np.array([x.spread for x in curves if x.delay is not None])
    return len(delays) > 0 and bool((np.abs(delays - step / 2) + widths < step / 4).all())


def _between(light: DelayCurve, heavy: DelayCurve) -> DelayCurve:
    """Return the delay without inertia if that explains little, or a delay that covers both."""
    if light.delay is None:
        return light
    other = max(minimum(heavy.candidates, heavy.residual), 0.0)
    mean, apart = (light.delay + other) / 2, abs(light.delay - other)
    if apart > mean:
        texts = [f"{1e3 * x:.0f} ms by {c.form}" for x, c in ((light.delay, light), (other, heavy))]
        return light.without(" and ".join(texts))
    if heavy.residual.min() > _LITTLE * light.residual.min():
        return light
    if heavy.delay is None:
        return light.without(heavy.reason)
    spread = np.hypot(max(light.spread, heavy.spread), apart / 2 / INTERVAL)
    return replace(light, delay=mean, spread=float(spread))


def _force_curve(
    widths: Sequence[Averages], i: int, bodies: Sequence[np.ndarray], candidates: np.ndarray
) -> DelayCurve:
    """Return the curve of input i: of rigid bodies if they have a delay, else a generic one."""
    generic = [_input_curve(data, i, None, candidates) for data in widths]
    best = _best(generic)
    if not bodies:
        return best
    rigid = [_input_curve(data, i, x, candidates) for data, x in zip(widths, bodies, strict=True)]
    # A delay would make up for a force that the bodies lack.
    pairs = zip(rigid, generic, strict=True)
    fitting = [x if x.residual.min() <= _WORSE * y.residual.min() else y for x, y in pairs]
    curves = sorted([_best(fitting), best], key=lambda x: x.delay is None)
    places = [minimum(candidates, x.residual) for x in curves]
    differ = abs(places[0] - places[1]) > candidates[1] - candidates[0]
    return replace(curves[0], other=curves[1] if differ else None)


def _best(curves: Sequence[DelayCurve]) -> DelayCurve:
    """Return the clearest curve; its spread includes kernels of other widths that are as clear."""
    best = min(curves, key=lambda x: (x.delay is None, x.spread))
    clear = [x for x in curves if x.spread <= 2 * best.spread]
    width = np.std([minimum(x.candidates, x.residual) for x in clear])
    return replace(best, spread=float(np.hypot(best.spread, width)))


def _is_sine(x: np.ndarray) -> bool:
    power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(len(x)))) ** 2
    peak = int(power.argmax())
    line = power[max(peak - 2, 0) : peak + 3].sum()
    return bool(np.ptp(x) > 0 and line >= _ONE_LINE * power.sum())


def _input_curve(
    data: Averages, i: int, regressor: np.ndarray | None, candidates: np.ndarray
) -> DelayCurve:
    """Return the curve of input i by inverse dynamics, generic or of rigid bodies."""
    moving = data.moving_rows(i)
    form = _INVERSE if regressor is None else _RIGID
    if moving.sum() < FEWEST:
        ones = np.ones(len(candidates))
        return DelayCurve(candidates, ones, None, np.inf, form, "the joint hardly moves")
    data = data.rows(moving)
    columns = force_columns(data, i, None if regressor is None else regressor[moving])
    u = data.input_at(i, data.t[:, None] - candidates)
    regression = EquationOfMotionRegression({**columns, "u": u - u.mean(axis=0)}, tenths(data))
    shares = regression.fit("u", list(columns)).shares
    # The level of the friction is that without its rise at low speed.
    level = regression.fit("u", ["terms", "sign"]).theta[:, columns["terms"].shape[1] :]
    own = i if columns["sign"].shape[1] > 1 else 0
    square = data.u.shape[1] == data.q.shape[1]
    friction = level[:, own] / data.spread[i] if square else np.nan * shares
    return _curve(candidates, shares, friction, form)


def _motion_curves(
    data: Averages, inputs: int, candidates: np.ndarray
) -> tuple[DelayCurve, DelayCurve]:
    """Return the curves of all inputs of a robot that motors move, without and with an inertia."""
    motion = (data.v - data.v.mean(axis=0)) / data.v.std(axis=0).clip(min=1e-300)
    inertia = np.hstack([data.a, *(data.a * q[:, None] for q in data.q.T)])
    rows, light, heavy = len(data.independent(1.0)), [], []
    for delay in candidates:
        u = [data.input_at(i, data.t - delay) for i in range(inputs)]
        f = _polynomial(np.column_stack([data.q, *u]), rows)
        columns = {"f": f, "inertia": inertia, "motion": motion}
        regression = EquationOfMotionRegression(columns, tenths(data))
        light.append(regression.fit("motion", ["f"]).shares.mean(axis=1))
        heavy.append(regression.fit("motion", ["f", "inertia"]).shares.mean(axis=1))
    friction = np.full_like(np.transpose(light), np.nan)
    return (
        _curve(candidates, np.transpose(light), friction, _LIGHT),
        _curve(candidates, np.transpose(heavy), friction, _HEAVY),
    )


def _polynomial(x: np.ndarray, rows: int) -> np.ndarray:
    """Return products of standardized columns up to order 3, or as far as rows determine them."""
    x = (x - x.mean(axis=0)) / x.std(axis=0).clip(min=1e-300)
    columns = [np.ones(len(x)), *x.T]
    for order in (2, 3):
        products = list(itertools.combinations_with_replacement(x.T, order))
        if RICH * (len(columns) + len(products)) > rows:
            break
        columns += [np.prod(factors, axis=0) for factors in products]
    return np.column_stack(columns)


def _curve(
    candidates: np.ndarray, shares: np.ndarray, friction: np.ndarray, form: str
) -> DelayCurve:
    """Return the curve of the shares that each delay leaves, ``(B + 1, D)``, with its verdict."""
    gap = candidates[1] - candidates[0]
    residual, best = shares[0], int(shares[0].argmin())
    minima = np.array([minimum(candidates, share) for share in shares[1:]])
    spread = float(np.sqrt((len(minima) - 1) * minima.var()))
    # Few parts leave the spread uncertain.
    spread *= float(scipy.stats.t.ppf(0.975, len(minima) - 1)) / INTERVAL
    reason = ""
    if residual[best] > _UNEXPLAINED:
        reason = f"the equation leaves {100 * residual[best]:.0f} % unexplained at any delay"
    elif not residual[best] < _DEPTH * np.median(residual):
        reason = "the residual is all but the same at every delay"
    elif spread > _SPREAD * max(gap, 0.01):
        reason = f"parts of the data disagree by {1e3 * spread:.0f} ms: too little or noisy motion"
    elif best >= len(candidates) - 2:
        reason = f"the residual still falls at the longest delay, {candidates[-1]:.3g} s"
    elif best == 0:
        reason = _AFTER
    delay = max(minimum(candidates, residual), 0.0)
    level, parts = friction[0, best], friction[1:, best]
    level_spread = float(np.sqrt((len(parts) - 1) * parts.var()))
    return DelayCurve(
        candidates, residual, None if reason else delay, spread, form, reason, level, level_spread
    )


def minimum(candidates: np.ndarray, residual: np.ndarray) -> float:
    """Return the position of the smallest residual, by a parabola through three candidates."""
    k = int(np.clip(np.argmin(residual), 1, len(residual) - 2))
    before, at, after = residual[k - 1 : k + 2]
    bend = before - 2 * at + after
    shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(candidates[k] + np.clip(shift, -1, 1) * (candidates[1] - candidates[0]))
