"""Simulated data sets: a mechanical system under random inputs from random initial states."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from torch import Tensor

from pinn_dyn.data.cache import Arrays, describe, load_or_make
from pinn_dyn.data.excitation import Excitation, InputSignal, picked_signals
from pinn_dyn.data.simulation import SimulationError, momentum, simulate
from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.mechanics import MechanicalSystem, Signal, Trajectory
from pinn_dyn.systems import HasDomain

# Part of the cache key: raise it when the same settings give different numbers.
_VERSION = 4
# Samples at which a recording is compared with the present robot.
_SAMPLES = 20
# Within limits: largest number of further draws of a motion.
_REDRAWS = 39

Motions = Sequence[np.ndarray] | np.ndarray
"""q, v and u of K motions, ``(K, T, .)`` each."""


@dataclass(kw_only=True, eq=False)
class RecordedSource(DataSource):
    """Trajectories of a simulated system, recorded once and cached on disk.

    Args:
        name: short name of the data set.
        system: the simulated system, the ground truth.
        duration: length of each training trajectory, s.
        step: sample time of the simulation, s.
        validation, test: number of trajectories.
        seed: seed of all motions.
        cache: folder of the cache; ``~`` is the home folder.
    """

    name: str
    system: MechanicalSystem
    duration: PositiveFloat
    step: PositiveFloat
    validation: PositiveInt
    test: PositiveInt
    seed: NonNegativeInt = 0
    cache: str = "~/.cache/pinn_dyn"

    @abc.abstractmethod
    def describe(self) -> dict[str, object]:
        """Return the settings that determine the recordings, for the key of the cache."""

    @abc.abstractmethod
    def simulate(self) -> Arrays:
        """Record all motions: arrays ``t`` and ``<split>_<q, v, u>``, each ``(K, T, .)``."""

    @abc.abstractmethod
    def prove(self, arrays: Arrays) -> np.ndarray:
        """Return numbers that the current robot and excitation give for a recording, ``(n,)``.

        These are the motion of the robot at some recorded samples, and the first drawn motions.
        """

    @abc.abstractmethod
    def _samples(
        self, t: Tensor, q: Tensor, v: Tensor, u: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the samples t, q, v and u of trajectories from those of recorded motions."""

    def load(self) -> Splits:
        folder = Path(self.cache).expanduser()
        arrays = load_or_make(folder, self.name, self.describe(), self.simulate, self.prove)
        splits: dict[str, list[Trajectory]] = {}
        for split in SPLITS:
            keys = ("t", f"{split}_q", f"{split}_v", f"{split}_u")
            t, *motions = self._samples(*(torch.from_numpy(arrays[key]) for key in keys))
            splits[split] = [
                Trajectory(q, v, Signal(t, u), momentum=partial(momentum, self.system))
                for q, v, u in zip(*motions, strict=True)
            ]
        return Splits(**splits)

    def _draw_within_limits(
        self,
        motions: Motions,
        rows: np.ndarray,
        record: Callable[[np.ndarray], Motions],
        inside: Callable[[np.ndarray, np.ndarray], np.ndarray],
        *,
        draws: int,
        message: str,
    ) -> None:
        """Replace motions that leave the limits by new draws within the limits.

        Args:
            motions: all motions, changed in place.
            rows: numbers of the motions to check.
            record: function from numbers of motions to new motions.
            inside: function from q and v ``(K, T, N)`` to a mask ``(K, N)`` of coordinates that
                stay within their limits.
            draws: largest number of draws of a motion.
            message: format of the error, with fields for names of coordinates and number of draws.
        """
        q, v, _ = motions
        left = rows[~inside(q[rows], v[rows]).all(-1)]
        for _ in range(draws):
            if not left.size:
                return
            new = record(left)
            stays = inside(*new[:2]).all(-1)
            for old, values in zip(motions, new, strict=True):
                old[left[stays]] = values[stays]
            left = left[~stays]
        if left.size:
            names = np.array(getattr(self.system, "joint_names", self.labels))
            # Samples after a motion has left the limits are NaN.
            recorded = (np.where(np.isnan(x), x[:, :1], x) for x in new[:2])
            limited = message.format(", ".join(names[~inside(*recorded).all(0)]), draws)
            raise SimulationError(f"{self.name}: {left.size} {limited}")


def split_recordings(t: np.ndarray, motions: Motions, counts: Mapping[str, int]) -> Arrays:
    """Return the arrays ``t`` and ``<split>_<q, v, u>`` of motions that are ordered by split."""
    arrays, ends = {"t": t}, np.cumsum([*counts.values()])[:-1]
    for key, values in zip("qvu", motions, strict=True):
        for split, part in zip(counts, np.split(values, ends), strict=True):
            arrays[f"{split}_{key}"] = part
    return arrays


def spread_samples(arrays: Arrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, v and u ``(20, .)`` at samples spread over all motions."""
    parts = []
    for key in "qvu":
        motions = [arrays[f"{split}_{key}"] for split in SPLITS]
        parts.append(np.concatenate([x.reshape(-1, x.shape[-1]) for x in motions]))
    rows = np.linspace(0, len(parts[0]) - 1, _SAMPLES).astype(int)
    q, v, u = (x[rows] for x in parts)
    return q, v, u


@dataclass(frozen=True)
class InitialStates:
    """A box for initial states, which are drawn uniformly.

    Args:
        q_low, q_high: bounds of the configuration, ``(N,)``.
        v_max: bound of the speed of each coordinate, ``(N,)``.
    """

    q_low: Sequence[float]
    q_high: Sequence[float]
    v_max: Sequence[NonNegativeFloat]

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw ``count`` initial configurations and velocities, both ``(count, N)``."""
        v_max = np.asarray(self.v_max, dtype=float)
        shape = (count, len(v_max))
        return rng.uniform(self.q_low, self.q_high, shape), rng.uniform(-v_max, v_max, shape)


@dataclass(kw_only=True, eq=False)
class SimulatedSource(RecordedSource):
    """Trajectories of a known system, simulated once and cached on disk.

    Validation and test trajectories share no initial state and no input with training
    trajectories. For a motion that leaves ``q_limits``, initial state and input are drawn again.

    Args:
        name: short name of the data set.
        system: the simulated system, the ground truth.
        excitation: family of input signals.
        initial_states: box of initial states.
        duration: length of each training trajectory, s.
        test_duration: length of each validation and test trajectory, s; ``duration`` if None.
        step: sample time of the simulation, s.
        dead_time: time after which the recorded input acts on the system, s.
        delay: known dead time, s, one number or M. As for a log, the trajectories hold the inputs
            at the times at which they act.
        keep_every: keep every n-th sample, for a lower rate from the same simulation.
        train_initial_states: number of initial states for training.
        train_inputs: number of inputs for training.
        pairing: ``"product"`` of initial states and inputs, or ``"matched"``: each initial state
            has its own input.
        q_limits: limits of q for all motions, ``(2, N)``, for matched pairs; None for no limits.
        validation, test: number of trajectories.
        seed: seed of all initial states and inputs.
        rtol, atol: tolerances of the solver.
        compile: compile the equation of motion in C for the simulation.
        cache: folder of the cache; ``~`` is the home folder.
        labels: name and unit of each coordinate, N of them.
        input_labels: name and unit of each input, M of them.
        configurations: named configurations at which learned terms are evaluated, ``(N,)`` each.

    Raises:
        ValueError: if settings do not match, or q leaves the domain of the system.
    """

    excitation: Excitation
    initial_states: InitialStates
    test_duration: PositiveFloat | None = None
    dead_time: NonNegativeFloat = 0.0
    delay: NonNegativeFloat | Sequence[NonNegativeFloat] = 0.0
    keep_every: PositiveInt = 1
    train_initial_states: PositiveInt
    train_inputs: PositiveInt
    pairing: Literal["product", "matched"] = "product"
    q_limits: Sequence[Sequence[float]] | None = None
    rtol: PositiveFloat = 1e-8
    atol: PositiveFloat = 1e-9
    compile: bool = False
    labels: Sequence[str]  # type: ignore[assignment]
    input_labels: Sequence[str]  # type: ignore[assignment]
    configurations: Mapping[str, Sequence[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.test_duration = self.test_duration or self.duration
        shortest = self.keep_every * self.step
        if not shortest <= self.test_duration <= self.duration:
            raise ValueError(
                f"{self.name}: test_duration is {self.test_duration} s, expected from keep_every * "
                f"step = {shortest:g} to duration = {self.duration} s"
            )
        matched = self.pairing == "matched" and self.train_initial_states == self.train_inputs
        if not matched and (self.pairing == "matched" or self.q_limits is not None):
            raise ValueError(
                f"{self.name}: pairing is {self.pairing!r} with {self.train_initial_states} initial"
                f" states and {self.train_inputs} inputs for training, expected 'matched' with as "
                "many of each, also for q_limits"
            )
        states, size = self.initial_states, self.system.num_coordinates
        for key, values, expected in (
            ("initial_states", states.q_low, size),
            ("labels", self.labels, size),
            ("input_labels", self.input_labels, self.system.num_inputs),
        ):
            if len(values) != expected:
                raise ValueError(
                    f"{self.name}: {key} has {len(values)} entries, expected {expected}"
                )
        if isinstance(self.system, HasDomain):
            self.system.check_domain(*np.array(self.q_limits or [states.q_low, states.q_high]))
        self.angles = tuple(getattr(self.system, "angles", ()))
        self.labels, self.input_labels = list(self.labels), list(self.input_labels)

    def _samples(
        self, t: Tensor, q: Tensor, v: Tensor, u: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        q, v, u = (x[:, :: self.keep_every] for x in (q, v, u))
        t = t[:: self.keep_every][: u.shape[1]].contiguous()
        acting = Signal(t, u).delayed(torch.from_numpy(self.input_delay)).at(t)
        return t, q, v, acting.movedim(0, 1).contiguous()

    @property
    def counts(self) -> dict[str, tuple[int, int]]:
        """Number of initial states and of inputs of each split."""
        train = (self.train_initial_states, self.train_inputs)
        return {"train": train, **{key: (getattr(self, key),) * 2 for key in SPLITS[1:]}}

    def describe(self) -> dict[str, object]:
        keys = "system excitation initial_states duration test_duration step counts pairing seed"
        keys += " rtol atol" if self.q_limits is None else " rtol atol q_limits"
        keys += " dead_time" if self.dead_time else ""
        return {"version": _VERSION} | {k: describe(getattr(self, k)) for k in keys.split()}

    def simulate(self) -> Arrays:
        if self.test_duration in (None, self.duration):
            return self._simulate(SPLITS, self.duration)
        short = self._simulate(SPLITS[1:], self.test_duration)
        # The second simulation has the longer "t".
        return {**short, **self._simulate(SPLITS[:1], self.duration)}

    def prove(self, arrays: Arrays) -> np.ndarray:
        q, v, u = (torch.from_numpy(x) for x in spread_samples(arrays))
        with torch.no_grad():
            rates = self.system.velocity_derivative(torch.cat([q, v], dim=-1), u)
        rngs = {s: np.random.default_rng([self.seed, SPLITS.index(s)]) for s in SPLITS}
        q0, v0, signal = self._draw(rngs)
        inputs = signal(np.linspace(0.0, self.duration, _SAMPLES))
        return np.concatenate([x.ravel() for x in (rates.numpy(), q0, v0, inputs)])

    def _simulate(self, splits: Sequence[str], duration: float) -> Arrays:
        """Simulate the trajectories of some splits in a batch."""
        t = np.arange(round(duration / self.step) + 1) * self.step
        # A generator per split, so that more test trajectories do not change the training set.
        rngs = {s: np.random.default_rng([self.seed, SPLITS.index(s)]) for s in splits}
        counts = {split: len(self._pairs(split)) for split in splits}
        rows = np.arange(sum(counts.values()))
        record = partial(self._record, rngs, t)
        motions = record(rows)
        if self.q_limits is not None:
            low, high = np.array(self.q_limits, dtype=float)
            self._draw_within_limits(
                motions,
                rows,
                record,
                lambda q, v: ((q >= low) & (q <= high)).all(1),
                draws=_REDRAWS,
                message=f"of {len(rows)} motions leave q_limits of {{}} in each of {{}} draws",
            )
        elif isinstance(self.system, HasDomain):
            for q in motions[0]:
                self.system.check_domain(q.min(0), q.max(0))
        return split_recordings(t, motions, counts)

    def _pairs(self, split: str) -> np.ndarray:
        """Return the indices of the initial state and the input of each motion, ``(K, 2)``."""
        states, inputs = self.counts[split]
        if split == "train" and self.pairing == "product":
            return np.indices((states, inputs)).reshape(2, -1).T
        return np.tile(np.arange(states)[:, None], 2)

    def _draw(
        self, rngs: Mapping[str, np.random.Generator]
    ) -> tuple[np.ndarray, np.ndarray, InputSignal]:
        """Draw the initial states ``(K, N)`` and inputs of all motions of some splits."""
        starts, signals, rows = [], [], []
        for index, (split, rng) in enumerate(rngs.items()):
            states, inputs = self.counts[split]
            pairs = self._pairs(split)
            starts.append(np.stack(self.initial_states.draw(states, rng))[:, pairs[:, 0]])
            signals.append(self.excitation.draw(inputs, self.duration, rng))
            rows += [(index, number) for number in pairs[:, 1]]
        q0, v0 = np.concatenate(starts, axis=1)
        return q0, v0, picked_signals(signals, *np.array(rows).T)

    def _record(
        self, rngs: Mapping[str, np.random.Generator], t: np.ndarray, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw and simulate the motions with the numbers ``rows``."""
        q0, v0, drawn = self._draw(rngs)
        signal = picked_signals([drawn], 0 * rows, rows)
        q, v = simulate(
            self.system,
            q0[rows],
            v0[rows],
            lambda times: signal(times - self.dead_time),
            t,
            rtol=self.rtol,
            atol=self.atol,
            compile=self.compile,
            q_limits=None if self.q_limits is None else np.array(self.q_limits, dtype=float),
            progress=f"simulating {len(rows)} trajectories of {self.name}",
        )
        return q, v, signal(t)
