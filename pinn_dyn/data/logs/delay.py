"""The delay between an input and the motion that it causes, found from the equation of motion.

Correlating q with u measures the robot, whose own lag is in it. Here a candidate d is judged by
what the equation of motion leaves unexplained. Three forms of it are tried:

    inverse dynamics    u_i(t - d_i) = f_i(q, v, a),    with at most as many inputs as q
    increments          v = f(q) + B(u(t - d)),         overdamped robots
    acceleration        a = f(q, v) + B(u(t - d))

f and B are linear in their parameters (least squares). All signals are averaged by one Gaussian
kernel g of width s, whose slopes give the derivatives: g * a = g'' * q. That keeps a linear
equation true, the delay included, and needs no derivative of noise. Of the forms and widths the one
counts whose estimate is the steadiest when tenths of the data are left out in turn (jackknife).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.step import sample_time

_WIDTHS = (0.005, 0.01, 0.02, 0.04, 0.08)  # of the kernel, s
_BLOCKS = 10
_FEW = 3  # inputs, of which products are terms too
_ROWS = 8_000  # of the regression, at most
_CUT = 4.0  # the kernel ends at so many widths
_CANDIDATES = 60  # at most: a parabola finds what is between them
# The residual must fall to this share of its usual value, and the spread of the estimate stay below
# this share of a sample, or of 10 ms.
_DEPTH = 0.97
_SPREAD = 0.6
_UNEXPLAINED = 0.5
_AS_WELL = 1.1  # times what delays of their own leave unexplained: a common one explains as well
_AFTER = "the input is logged after the motion: a filtered measurement, or another clock"
_ONE_LINE = 0.995  # of the power of a signal


@dataclass(frozen=True)
class DelayCurve:
    """What the equation of motion leaves unexplained with the input taken d earlier.

    Attributes:
        candidates: d, ``(D,)``, s.
        residual: unexplained share of the variance at each d, ``(D,)``.
        delay: the d of the least residual, s; None where the data do not tell.
        spread: standard deviation of the estimate by the jackknife, s.
        form: the equation that was used.
        reason: why there is no answer; "" where there is one.
    """

    candidates: np.ndarray
    residual: np.ndarray
    delay: float | None
    spread: float
    form: str
    reason: str = ""

    def __str__(self) -> str:
        if self.delay is None:
            return f"no delay found: {self.reason}"
        best = int(np.argmin(self.residual))
        return (
            f"{1e3 * self.delay:.1f} ± {1e3 * self.spread:.1f} ms ({self.form}: "
            f"{100 * self.residual[best]:.2g} % unexplained, "
            f"{100 * np.interp(0.0, self.candidates, self.residual):.2g} % without a delay)"
        )


def input_delays(
    recordings: Sequence[Recording], *, longest: float = 0.3, common: bool = False
) -> list[DelayCurve]:
    """The delay of each input, or one for all, from uniformly sampled stretches.

    Args:
        recordings: stretches of one sample time, q and u in them.
        longest: longest delay that is tried, s.
        common: whether all inputs share one delay.

    Returns:
        A curve per input; the same one for all where ``common``.

    Raises:
        LogError: if a clock is not uniform.
    """
    step = sample_time(recordings[0], "a delay")
    inputs = recordings[0].u.shape[1]
    stride = max(1, round(longest / step / _CANDIDATES))
    lags = stride * np.arange(-2, max(round(longest / step / stride), 3) + 1)
    widths = sorted({max(width, 1.5 * step) for width in _WIDTHS})
    forms: dict[str, list[list[DelayCurve]]] = {}
    for width in widths:
        data = _Smoothed.of(recordings, step, width, lags)
        if data is not None:
            for form, curves in _trials(data, lags * step, inputs, common).items():
                forms.setdefault(form, []).append(curves)
    if not forms:
        short = "the stretches are too short"
        return [DelayCurve(lags * step, np.ones(len(lags)), None, np.inf, "none", short)] * inputs
    best = [
        [min((curves[i] for curves in trials), key=_rank) for i in range(inputs)]
        for trials in forms.values()
    ]
    found = min(best, key=lambda curves: tuple(np.mean([_rank(c) for c in curves], axis=0)))
    lines = [_is_one_line([item.u[:, i] for item in recordings]) for i in range(inputs)]
    if all(lines) or (any(lines) and not common):
        reason = "the input is a single sine, whose delay looks like damping"
        found = [
            replace(curve, delay=None, reason=reason) if line or common else curve
            for curve, line in zip(found, lines, strict=True)
        ]
    return found


def agreed_delays(
    recordings: Sequence[Recording], *, longest: float = 0.3
) -> tuple[list[DelayCurve], bool]:
    """The delay of each input; one for all where they have no good answers of their own.

    Delays are mostly of a bus or a filter that all inputs share, and searched for together they
    have the data of all. So where an input has no answer, or where two lie more than a sample
    apart, a common one is tried, but not where one is logged after the motion. It counts if it
    is among those that were found, within a sample, and explains the motion about as well as all of
    them do.

    Arguments and errors are those of :func:`input_delays`.

    Returns:
        A curve per input, and whether they are one.
    """
    own = input_delays(recordings, longest=longest)
    found = [curve.delay for curve in own if curve.delay is not None]
    whole = len(found) == len(own)
    step = sample_time(recordings[0], "a delay")
    after = any(curve.reason == _AFTER for curve in own)
    if len(own) == 1 or not found or after or (whole and max(found) - min(found) <= step):
        return own, False
    common = input_delays(recordings, longest=longest, common=True)
    left, left_in_common = (np.mean([c.residual.min() for c in x]) for x in (own, common))
    among = common[0].delay is not None and (
        min(found) - step <= common[0].delay <= max(found) + step
    )
    if not among or (whole and left_in_common > _AS_WELL * left):
        return own, False
    return common, True


def _rank(curve: DelayCurve) -> tuple[bool, float]:
    return curve.delay is None, min(curve.spread, 1.0)


def _is_one_line(signals: Sequence[np.ndarray]) -> bool:
    """Whether nearly all power of every stretch of a signal is in one line of its spectrum."""
    for x in signals:
        power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(len(x)))) ** 2
        peak = int(power.argmax())
        if power[max(peak - 2, 0) : peak + 3].sum() < _ONE_LINE * power.sum():
            return False
    return True


@dataclass(frozen=True)
class _Smoothed:
    """Averages of q, v, a at the rows of the regression, and of u at every lag before them.

    Attributes:
        q, v, a: ``(R, N)``.
        u: of the inputs and of the products of them that ``powers`` names, ``(R, D, M)``.
        powers: of each input in each of these products.
        block: which tenth of the data a row is in, ``(R,)``.
    """

    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    u: np.ndarray
    powers: list[tuple[int, ...]]
    block: np.ndarray

    @classmethod
    def of(
        cls, recordings: Sequence[Recording], step: float, width: float, lags: np.ndarray
    ) -> _Smoothed | None:
        edge = int(np.ceil(_CUT * width / step))
        samples = width / step
        first, end = edge + int(lags[-1]), edge - int(lags[0])
        total = sum(max(len(item) - first - end, 0) for item in recordings)
        # Averages a quarter of a width apart are all but the same.
        stride = max(1, int(0.25 * samples), -(-total // _ROWS))
        rows = [np.arange(first, len(item) - end, stride) for item in recordings]
        kept = [(item, r) for item, r in zip(recordings, rows, strict=True) if len(r) > 1]
        count = sum(len(r) for _, r in kept)
        if count < 20 * _BLOCKS:
            return None

        def smooth(x: np.ndarray, order: int) -> np.ndarray:
            return gaussian_filter1d(x, samples, axis=0, order=order, truncate=_CUT) / step**order

        q, v, a = (np.vstack([smooth(item.q, order)[r] for item, r in kept]) for order in range(3))
        powers = _powers(recordings[0].u.shape[1])
        centre = np.concatenate([item.u for item in recordings])
        mean, spread = centre.mean(axis=0), centre.std(axis=0).clip(min=1e-300)
        u = np.concatenate(
            [
                smooth(_monomials((item.u - mean) / spread, powers), 0)[r[:, None] - lags]
                for item, r in kept
            ]
        )
        return cls(q, v, a, u, powers, np.arange(count) * _BLOCKS // count)


def _trials(
    data: _Smoothed, candidates: np.ndarray, inputs: int, common: bool
) -> dict[str, list[DelayCurve]]:
    """A curve per input for every form of the equation, at one width."""
    found = {}
    if inputs <= data.q.shape[1]:
        known = _terms(data, inverse=True)
        shares = _Remainder.of(known, data, data.a[:, :0]).of_targets()[..., :inputs]
        if common:
            shares = np.repeat(shares.mean(axis=-1, keepdims=True), inputs, axis=-1)
        form = "inverse dynamics"
        found[form] = [_curve(candidates, shares[..., i], form) for i in range(inputs)]
    for form, target in (("increments", data.v), ("acceleration", data.a)):
        known = _terms(data, inverse=False, first_order=form == "increments")
        rest = _Remainder.of(known, data, target)
        lag = np.zeros(data.u.shape[2], dtype=int)
        shares = rest.of_inputs(lag, range(len(lag)))
        curves = [_curve(candidates, shares, form)] * inputs
        lag[:] = shares[0].argmin()
        for _ in range(0 if common or inputs == 1 else 2):
            for i in range(inputs):
                mine = [k for k, p in enumerate(data.powers) if p[i] == sum(p)]
                shares = rest.of_inputs(lag, mine)
                lag[mine] = shares[0].argmin()
                curves[i] = _curve(candidates, shares, form)
        found[form] = curves
    return found


def _terms(data: _Smoothed, *, inverse: bool, first_order: bool = False) -> np.ndarray:
    """What a linear combination of explains the motion apart from the input, ``(R, P)``.

    1, q, sin q, cos q, v and friction; v_i v_j and (for inverse dynamics) a, times 1, sin q and
    cos q as far as the data are enough for so many.
    """
    q, v, a = data.q, data.v, data.a
    size = q.shape[1]
    ones = np.ones((len(q), 1))
    trig = np.hstack([ones, np.sin(q), np.cos(q)])
    speed = v.std(axis=0).clip(min=1e-300)
    parts = [trig, q, q**2]
    if not first_order:
        i, j = np.triu_indices(size)
        squares = v[:, i] * v[:, j]
        parts += [v, np.tanh(10 * v / speed)]
        inertial = [squares, a] if inverse else [squares]
        several = [_products(trig, x) for x in [*inertial, trig[:, 1:]]]
        rich = sum(x.shape[1] for x in several)
        parts += several if 12 * rich < len(q) else inertial
    return _whitened(np.hstack(parts))


def _powers(inputs: int) -> list[tuple[int, ...]]:
    """Powers of the inputs in B(u): each alone, and products up to the third of few inputs."""
    alone = [tuple(row) for row in np.eye(inputs, dtype=int)]
    if inputs > _FEW:
        return alone
    every = itertools.product(range(4), repeat=inputs)
    return alone + [p for p in every if 2 <= sum(p) <= 3]


def _monomials(u: np.ndarray, powers: list[tuple[int, ...]]) -> np.ndarray:
    return np.column_stack([np.prod(u ** np.array(p), axis=1) for p in powers])


def _products(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (x[:, :, None] * y[:, None, :]).reshape(len(x), -1)


def _whitened(x: np.ndarray) -> np.ndarray:
    """Columns of unit size, without those that the others give."""
    x = x / np.sqrt((x**2).mean(axis=0)).clip(min=1e-300)
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    keep = values > 1e-9 * values[-1]
    return x @ (vectors[:, keep] / np.sqrt(values[keep]))


@dataclass(frozen=True)
class _Remainder:
    """What the known terms leave of the inputs at every lag and of the motion, as inner products.

    The first of the B + 1 entries is of all data, each other one leaves a tenth of them out.

    Attributes:
        inner: of the inputs, ``(B + 1, D M, D M)``.
        with_motion: of inputs and motion, ``(B + 1, D M, N)``.
        motion: squares of the motion's remainder, ``(B + 1, N)``.
        squares: of the whole inputs, ``(B + 1, D M)``, and of the whole motion, ``(B + 1, N)``.
        inputs: M.
    """

    inner: np.ndarray
    with_motion: np.ndarray
    motion: np.ndarray
    squares: tuple[np.ndarray, np.ndarray]
    inputs: int

    @classmethod
    def of(cls, known: np.ndarray, data: _Smoothed, target: np.ndarray) -> _Remainder:
        u = _standard(data.u.reshape(len(data.u), -1))
        y = _standard(target)
        both = np.hstack([known, u, y])
        blocks = np.stack([x.T @ x for x in (both[data.block == b] for b in range(_BLOCKS))])
        grams = np.concatenate([blocks.sum(axis=0)[None], blocks.sum(axis=0) - blocks])
        k, e = known.shape[1], known.shape[1] + u.shape[1]
        ridge = 1e-9 * np.trace(grams[0, :k, :k]) / k * np.eye(k)
        left = grams[:, k:, k:] - grams[:, k:, :k] @ np.linalg.solve(
            grams[:, :k, :k] + ridge, grams[:, :k, k:]
        )
        squares = np.diagonal(grams, axis1=1, axis2=2)
        m = e - k
        return cls(
            left[:, :m, :m],
            left[:, :m, m:],
            np.diagonal(left[:, m:, m:], axis1=1, axis2=2),
            (squares[:, k:e], squares[:, e:]),
            data.u.shape[2],
        )

    def of_targets(self) -> np.ndarray:
        """Share of each input that the known terms leave, ``(B + 1, D, M)``."""
        left = np.diagonal(self.inner, axis1=1, axis2=2)
        share = left / self.squares[0].clip(min=1e-300)
        return share.reshape(len(share), -1, self.inputs).clip(1e-12, 1)

    def of_inputs(self, lag: np.ndarray, moved: Sequence[int]) -> np.ndarray:
        """Share of the motion that known terms and inputs leave, ``(B + 1, D)``.

        Args:
            lag: number of the candidate that each of the M inputs has, ``(M,)``.
            moved: the inputs that take every candidate in turn instead.
        """
        lags = self.inner.shape[1] // self.inputs
        shares = []
        for d in range(lags):
            at = lag.copy()
            at[list(moved)] = d
            rows = at * self.inputs + np.arange(self.inputs)
            gram = self.inner[:, rows[:, None], rows] + 1e-6 * self.squares[0][
                :, :1, None
            ] * np.eye(len(rows))
            product = self.with_motion[:, rows]
            explained = (product * np.linalg.solve(gram, product)).sum(axis=1)
            shares.append(
                ((self.motion - explained) / self.squares[1].clip(min=1e-300)).mean(axis=1)
            )
        return np.stack(shares, axis=1).clip(1e-12, 1)


def _standard(x: np.ndarray) -> np.ndarray:
    return (x - x.mean(axis=0)) / x.std(axis=0).clip(min=1e-300)


def _curve(candidates: np.ndarray, shares: np.ndarray, form: str) -> DelayCurve:
    """The verdict on the shares that each delay leaves, ``(B + 1, D)``."""
    gap = candidates[1] - candidates[0]
    whole, best = shares[0], int(shares[0].argmin())
    each = np.array([_minimum(candidates, share) for share in shares[1:]])
    spread = float(np.sqrt((_BLOCKS - 1) * each.var()))
    reason = ""
    if whole[best] > _UNEXPLAINED:
        reason = f"the equation of motion leaves {100 * whole[best]:.0f} % unexplained at any delay"
    elif not whole[best] < _DEPTH * np.median(whole):
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
    delay = max(_minimum(candidates, whole), 0.0)
    return DelayCurve(candidates, whole, None if reason else delay, spread, form, reason)


def _minimum(candidates: np.ndarray, residual: np.ndarray) -> float:
    """Where a parabola through the least value and its neighbours is least."""
    k = int(np.clip(np.argmin(residual), 1, len(residual) - 2))
    before, at, after = residual[k - 1 : k + 2]
    bend = before - 2 * at + after
    shift = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(candidates[k] + np.clip(shift, -1, 1) * (candidates[1] - candidates[0]))
