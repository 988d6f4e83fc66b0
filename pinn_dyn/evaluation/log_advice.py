"""What to write into the configuration of a log, each line with the measurement that it is from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.signal import welch

from pinn_dyn.data.logs import (
    Butterworth,
    DelayCurve,
    InputRates,
    LogSource,
    MovingAverage,
    PolynomialFit,
    Recording,
)

_SLOW = 0.02  # of the fastest speed, below which a coordinate rests
_FORCES = ("Nm", "N")
_POSITIONS = ("rad", "m")
_LOW_PASSES = (Butterworth, MovingAverage, PolynomialFit)


@dataclass(frozen=True)
class Measured:
    """What the rules go by.

    Attributes:
        source: the log.
        training: its stretches after the cleaning, of one sample time.
        step: sample time, s.
        delays: of the inputs, found; None where there is no answer.
        noise: of q before the cleaning, SI, ``(N,)``.
        rest: share of the training at rest.
        outside: share of the test that is outside the training, or far from it.
        condition: number of the regressor (1, q, v, a).
        follows: share of q that the inputs of the moment explain.
    """

    source: LogSource
    training: list[Recording]
    step: float
    delays: list[DelayCurve]
    noise: np.ndarray
    rest: float
    outside: float
    condition: float
    follows: float

    @property
    def seconds(self) -> float:
        """Length of the training, s."""
        return sum(item.duration for item in self.training)

    @cached_property
    def highest(self) -> float:
        """Where the motion ends, Hz."""
        return bandwidth(self.training, self.step, self.noise)

    @property
    def joints(self) -> bool:
        """Whether there is an input for each coordinate, as of an arm of joints."""
        units = self.source.q.units
        return set(units) <= set(_POSITIONS) and len(units) == len(self.source.u.units)

    @property
    def little(self) -> str:
        """Why the data are little for a network of an arm, "" where they are not."""
        size = len(self.source.q.units)
        if not self.joints or size < 2:
            return ""
        if self.seconds < 5 * size:
            return f"{self.seconds:.0f} s for {size} joints are little for networks"
        if self.condition > 1e3:
            return f"the regressor has the condition {self.condition:.2g}, much for networks"
        return ""

    @property
    def overdamped(self) -> bool:
        """Whether the robot follows the positions of its motors all but without inertia."""
        return self.follows > 0.5 and set(self.source.u.units) <= set(_POSITIONS)


@dataclass(frozen=True)
class Advice:
    """A line to copy.

    Attributes:
        place: ``steps`` or ``dataset`` of the YAML; of a command line ``model``, which is of the
            mechanical model alone, or ``training``.
        line: the line.
        reason: why, by what was measured.
    """

    place: str
    line: str
    reason: str


Rule = Callable[[Measured], "Advice | None"]


def advice(found: Measured) -> str:
    """YAML and commands to copy, "" where there is nothing to change and no model to prefer."""
    every = [one for one in (rule(found) for rule in RULES) if one is not None]
    lines = []
    for one in (one for one in every if one.place == "dataset"):
        lines.append(f"{one.line} # {one.reason}")
    steps = [one for one in every if one.place == "steps"]
    lines += ["steps:"] if steps else []
    lines += [f"  {one.line} # {one.reason}" for one in steps]
    words = [one for one in every if one.place in ("model", "training")]
    lines += [f"# {one.line}: {one.reason}" for one in words]
    common = [one.line for one in words if one.place == "training"]
    model = [one.line for one in words if one.place == "model"]
    for taken in ([*model, *common], ["model=acceleration", *common]):
        lines.append(f"# python train.py dataset={found.source.name} {' '.join(taken)}")
    return "\n".join(lines)


def bandwidth(training: Sequence[Recording], step: float, noise: np.ndarray) -> float:
    """The frequency in Hz below which 99 % of the power of v is, as far as q exceeds its noise."""
    best = 0.0
    size = min(round(8 / step), min(len(item) for item in training))
    for k in range(training[0].q.shape[1]):
        powers = [welch(item.q[:, k], 1 / step, nperseg=size)[1] for item in training]
        f = np.fft.rfftfreq(size, step)
        density = np.mean(powers, axis=0)
        # White noise has 2 s² h per Hz, single bad samples what is left at the highest frequencies;
        # four times that is no noise.
        level = max(2 * noise[k] ** 2 * step, float(np.median(density[len(f) // 2 :])))
        power = np.where(density > 4 * level, density, 0.0) * f**2
        if power.any():
            share = np.cumsum(power) / power.sum()
            best = max(best, float(f[int(np.searchsorted(share, 0.99))]))
    return best


def _delay(found: Measured) -> Advice | None:
    step = found.step
    shifts = [round(round((c.delay or 0.0) / step) * step, 6) for c in found.delays]
    if not any(shifts):
        return None
    shown = shifts[0] if len(set(shifts)) == 1 else shifts
    learned = ""
    if len(set(shifts)) == 1:
        learned = (
            f"; or learn it instead, model/delay=learned model.delay.initial={shifts[0]:g} "
            f"model.delay.longest={max(0.1, 2 * shifts[0]):g}"
        )
    return Advice(
        "steps",
        f"delay: {{_target_: pinn_dyn.data.logs.InputDelay, delay: {shown}}}",
        f"the inputs act so many seconds late{learned}",
    )


def _filter(found: Measured) -> Advice | None:
    if any(isinstance(step, _LOW_PASSES) for step in found.source.steps.values()):
        return None
    v = np.vstack([np.diff(item.q, axis=0) / found.step for item in found.training])
    share = float((2**0.5 * found.noise / found.step / v.std(axis=0).clip(min=1e-300)).max())
    cutoff = float(f"{max(4 * found.highest, 1.0):.2g}")
    if share < 0.02 or not 0 < cutoff < 0.4 / found.step:
        return None
    return Advice(
        "steps",
        f"filter: {{_target_: pinn_dyn.data.logs.Butterworth, cutoff: {cutoff:g}}}",
        f"noise is {100 * share:.2g} % of the steps of q from sample to sample, and the motion "
        f"ends at {found.highest:.2g} Hz",
    )


def _rates(found: Measured) -> Advice | None:
    rated = any(isinstance(step, InputRates) for step in found.source.steps.values())
    if rated or not found.overdamped:
        return None
    return Advice(
        "steps",
        "rates: {_target_: pinn_dyn.data.logs.InputRates}",
        "the inputs are positions; a tendon pulls like a spring and a damper. Put it last",
    )


def _split(found: Measured) -> Advice | None:
    part = found.source.test
    if found.outside <= 0.05 or part.seconds is None or part.blocks:
        return None
    # As many seconds in all as now, in blocks that hold a piece.
    pieces = 4 if isinstance(part.piece, str) else int(part.seconds / part.piece + 1e-9)
    blocks = min(4, pieces)
    return Advice(
        "dataset",
        f"test: {{seconds: {part.seconds / blocks:g}, blocks: {blocks}, piece: {part.piece}}}",
        f"{100 * found.outside:.0f} % of the test is not like the training, at the ends of the "
        "runs: blocks along them are; keep the ends if new motions are the question",
    )


def _model(found: Measured) -> Advice | None:
    q, u = found.source.q.units, found.source.u.units
    if found.little:
        return Advice(
            "model",
            "model=known model/structure=urdf model.structure.urdf=my_robot.urdf "
            "optimizer=least_squares data.pairs=150 data.batch_size=150",
            f"{found.little}: if it is rigid and has a URDF, its constants are fewer",
        )
    if found.overdamped:
        return Advice(
            "model",
            "model=lnn model/mass=constant model.mass.positivity.initial=0.3 "
            "model/input=nonlinear model/integrator=rosenbrock",
            f"the positions of the motors explain {100 * found.follows:.0f} % of q at once: "
            "damping outweighs inertia; see whether model=acceleration is as good",
        )
    if found.joints and set(u) <= set(_FORCES):
        return Advice(
            "model",
            "model=lnn model/input=fixed",
            f"{len(u)} inputs in {', '.join(dict.fromkeys(u))} for {len(q)} coordinates: A = I "
            "where each acts on one of them alone, else leave the last word out; a rigid robot "
            "with a URDF: model=known",
        )
    if found.joints:
        return Advice(
            "model",
            "model=lnn model/input=constant",
            f"{len(u)} inputs in {', '.join(dict.fromkeys(u))} for {len(q)} coordinates: drives of "
            "unknown gain; a rigid robot with a URDF: model=known",
        )
    return Advice(
        "model",
        "model=lnn",
        f"{len(u)} inputs for {len(q)} coordinates: their lever arms are learned",
    )


def _friction(found: Measured) -> Advice | None:
    """Joints that rest while their inputs move: only dry friction holds them."""
    if found.little:  # known mechanics has a friction of its own
        return None
    rest, moved = [], []
    fastest = np.max([np.abs(x.v).max(axis=0) for x in found.training if x.v is not None], 0)
    for item in found.training:
        assert item.v is not None
        rate = np.abs(np.gradient(item.u[:, : len(found.delays)], found.step, axis=0))
        usual = np.sqrt((rate**2).mean(axis=0)).clip(min=1e-300)
        moved.append((rate > 0.3 * usual).any(axis=1))
        rest.append((np.abs(item.v) < _SLOW * fastest).all(axis=1))
    still, acting = np.concatenate(rest), np.concatenate(moved)
    share = float(still[acting].mean()) if acting.any() else 0.0
    if share < 0.02:
        return None
    width = " model.friction.width=0.01" if found.overdamped else ""
    return Advice(
        "model",
        f"model/friction=coulomb{width}",
        f"the robot rests in {100 * share:.2g} % of the time in which its inputs move",
    )


def _turns(found: Measured) -> Advice | None:
    q = np.vstack([item.q for item in found.training])
    turning = [
        k
        for k, unit in enumerate(found.source.q.units)
        if unit == "rad" and np.ptp(q[:, k]) > 2 * np.pi
    ]
    if not turning or found.little:
        return None
    names = ", ".join(found.source.labels[k] for k in turning)
    shown = ",".join(map(str, turning))
    return Advice("model", f"'model.angles=[{shown}]'", f"{names} turns by more than 2 pi")


def _windows(found: Measured) -> Advice | None:
    if not found.highest:
        return None
    stride = max(1, round(1 / (20 * found.highest) / found.step))
    shortest = min(len(item) for item in found.training)
    steps = max(2, min(10, (shortest - 1) // (2 * stride)))
    return Advice(
        "training",
        f"data=multi_step data.stride={stride} data.steps={steps}",
        f"{1e3 * stride * found.step:.3g} ms a step, some twentieth of the period of "
        f"{found.highest:.2g} Hz, below which 99 % of the motion is; noise averages out over "
        "several",
    )


def _pairs(found: Measured) -> Advice | None:
    samples = sum(len(item) for item in found.training)
    if samples >= 10_000 or found.little:
        return None
    return Advice("training", "data.pairs=all", f"the training has {samples} samples, so take each")


def _coverage(found: Measured) -> Advice | None:
    if found.rest <= 0.5:
        return None
    return Advice("training", "data.coverage=0.5", f"the robot rests {100 * found.rest:.0f} %")


def _weight(found: Measured) -> Advice | None:
    if found.source.v is not None:
        return None
    return Advice("training", "loss.velocity_weight=0.1", "the log has no v, it is derived from q")


def _horizon(found: Measured) -> Advice | None:
    pieces = [float(item.t[-1]) for item in found.source.load().validation]
    shortest = min(pieces)
    if shortest >= 2.0:
        return None
    return Advice(
        "training",
        f"validator.horizon={shortest:.4g}",
        "the validation motions last no longer, and the default is 2 s",
    )


RULES: tuple[Rule, ...] = (
    *(_split, _filter, _rates, _delay),
    *(_model, _turns, _friction, _windows, _pairs, _coverage, _weight, _horizon),
)
"""Steps come in the order in which they are to be applied, after those that are there."""
