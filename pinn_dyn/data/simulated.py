"""Simulated data sets: a mechanical system under random inputs from random initial states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from pinn_dyn.data.cache import Arrays, load_or_make
from pinn_dyn.data.excitation import Excitation, joined
from pinn_dyn.data.excitation import Signal as InputSignal
from pinn_dyn.data.fingerprint import describe
from pinn_dyn.data.simulation import SimulationError, momentum, simulate
from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.mechanics import MechanicalSystem, Signal, Trajectory
from pinn_dyn.systems import HasDomain

# Part of the cache key: raise it when the same settings give different numbers.
_VERSION = 3
# Within limits: largest number of draws of a motion, and draws that are simulated at once.
_DRAWS = 40
_AT_ONCE = 3


@dataclass(frozen=True)
class InitialStates:
    """A box from which initial states are drawn uniformly.

    Args:
        q_low, q_high: bounds of the configuration, ``(N,)``.
        v_max: bound of the speed of each coordinate, ``(N,)``.
    """

    q_low: Sequence[float]
    q_high: Sequence[float]
    v_max: Sequence[NonNegativeFloat]

    def __post_init__(self) -> None:
        if (np.subtract(self.q_high, self.q_low) < 0).any():
            raise ValueError(f"q_low = {self.q_low} exceeds q_high = {self.q_high}")

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Draw ``count`` initial configurations and velocities, both ``(count, N)``."""
        v_max = np.asarray(self.v_max, dtype=float)
        shape = (count, len(v_max))
        return rng.uniform(self.q_low, self.q_high, shape), rng.uniform(-v_max, v_max, shape)


class _Draw(NamedTuple):
    """Initial states ``(K, N)`` and inputs of K motions."""

    q0: np.ndarray
    v0: np.ndarray
    signal: InputSignal


@dataclass(kw_only=True, eq=False)
class SimulatedSource(DataSource):
    """Trajectories of a known system, simulated once and cached on disk.

    Validation and test trajectories have initial states and inputs that no training trajectory
    has. A motion that leaves ``q_limits`` is drawn anew, both its initial state and its input.

    Args:
        name: short name of the data set.
        system: the truth.
        excitation: family of input signals.
        initial_states: box of initial states.
        duration: length of each training trajectory, s.
        test_duration: length of each validation and test trajectory, s; ``duration`` if None.
        step: sample time of the simulation, s.
        dead_time: time after which the recorded input acts on the system, s.
        delay: dead time that is known, s, one or M; as for a log, the trajectories hold the inputs
            as they act.
        keep_every: keep every n-th sample, for a lower rate from the same simulation.
        train_initial_states: number of initial states for training.
        train_inputs: number of inputs for training.
        pairing: ``"product"`` of these, or ``"matched"``: each initial state has its own input.
        q_limits: limits of q, ``(2, N)``, which no motion leaves; for matched pairs. None: none.
        validation, test: number of trajectories.
        seed: seed of all initial states and inputs.
        rtol, atol: tolerances of the solver.
        compile: compile the equation of motion for the simulation.
        cache: folder of the cache; ``~`` is the home folder.
        labels: name and unit of each coordinate, N of them.
        input_labels: name and unit of each input, M of them.
        configurations: named configurations at which learned terms are looked at, ``(N,)`` each.

    Raises:
        ValueError: on settings that do not match, or ranges of q beyond the system's domain.
    """

    name: str
    system: MechanicalSystem
    excitation: Excitation
    initial_states: InitialStates
    duration: PositiveFloat
    test_duration: PositiveFloat | None = None
    step: PositiveFloat
    dead_time: NonNegativeFloat = 0.0
    delay: NonNegativeFloat | Sequence[NonNegativeFloat] = 0.0
    keep_every: PositiveInt = 1
    train_initial_states: PositiveInt
    train_inputs: PositiveInt
    pairing: Literal["product", "matched"] = "product"
    q_limits: Sequence[Sequence[float]] | None = None
    validation: PositiveInt
    test: PositiveInt
    seed: NonNegativeInt = 0
    rtol: PositiveFloat = 1e-8
    atol: PositiveFloat = 1e-9
    compile: bool = False
    cache: str = "~/.cache/pinn_dyn"
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
                raise ValueError(f"{self.name}: {key} has {len(values)} entries, not {expected}")
        if isinstance(self.system, HasDomain):
            self.system.check_domain(*np.array(self.q_limits or [states.q_low, states.q_high]))
        self.angles = tuple(getattr(self.system, "angles", ()))
        self.labels, self.input_labels = list(self.labels), list(self.input_labels)

    def load(self) -> Splits:
        folder = Path(self.cache).expanduser()
        arrays = load_or_make(folder, self.name, self.describe(), self.simulate)
        t = torch.from_numpy(arrays["t"][:: self.keep_every])
        splits: dict[str, list[Trajectory]] = {}
        for split in SPLITS:
            arrays_of_split = (arrays[f"{split}_{key}"][:, :: self.keep_every] for key in "qvu")
            q, v, u = map(torch.from_numpy, arrays_of_split)
            recorded = Signal(t[: u.shape[1]], u)
            acting = recorded.delayed(torch.from_numpy(self.input_delay)).at(recorded.t)
            splits[split] = [
                Trajectory(q, v, Signal(recorded.t, u), momentum=partial(momentum, self.system))
                for q, v, u in zip(q, v, acting.movedim(0, 1).contiguous(), strict=True)
            ]
        return Splits(**splits)

    @property
    def counts(self) -> dict[str, tuple[int, int]]:
        """Number of initial states and of inputs of each split."""
        train = (self.train_initial_states, self.train_inputs)
        return {"train": train, **{key: (getattr(self, key),) * 2 for key in SPLITS[1:]}}

    def describe(self) -> dict[str, object]:
        """Return the settings that the simulation depends on: the key of the cache."""
        keys = "system excitation initial_states duration test_duration step counts pairing seed"
        keys += " rtol atol" if self.q_limits is None else " rtol atol q_limits"
        keys += " dead_time" if self.dead_time else ""
        return {"version": _VERSION} | {k: describe(getattr(self, k)) for k in keys.split()}

    def simulate(self) -> Arrays:
        """Simulate all trajectories anew: arrays ``<split>_<q, v, u>``, each ``(K, T, .)``."""
        if self.test_duration in (None, self.duration):
            return self._simulate(SPLITS, self.duration, 0)
        # Two batches of one size: the compiled equation of motion serves both.
        size = max(len(self._pairs("train")), self.validation + self.test)
        short = self._simulate(SPLITS[1:], self.test_duration, size)
        return {**short, **self._simulate(SPLITS[:1], self.duration, size)}  # the longer "t"

    def _simulate(self, splits: Sequence[str], duration: float, size: int) -> Arrays:
        """Simulate the trajectories of some splits in one batch, padded with copies to ``size``."""
        t = np.arange(round(duration / self.step) + 1) * self.step
        # One generator per split: more test trajectories do not change the training set.
        rngs = {s: np.random.default_rng([self.seed, SPLITS.index(s)]) for s in splits}
        draw = self._draw(rngs)
        count = len(draw.q0)
        rows = np.arange(max(count, size)) % count
        motions = [x[:count] for x in self._move([draw], rows, t)]
        if self.q_limits is not None:
            self._replace(motions, rngs, t)
        elif isinstance(self.system, HasDomain):
            for q in motions[0]:
                self.system.check_domain(q.min(0), q.max(0))
        arrays = {"t": t}
        ends = np.cumsum([len(self._pairs(split)) for split in splits])[:-1]
        for key, values in zip("qvu", motions, strict=True):
            parts = zip(splits, np.split(values, ends), strict=True)
            arrays |= {f"{split}_{key}": part for split, part in parts}
        return arrays

    def _pairs(self, split: str) -> np.ndarray:
        """Return the numbers of the initial state and the input of each motion, ``(K, 2)``."""
        states, inputs = self.counts[split]
        if split == "train" and self.pairing == "product":
            return np.indices((states, inputs)).reshape(2, -1).T
        return np.tile(np.arange(states)[:, None], 2)

    def _draw(self, rngs: Mapping[str, np.random.Generator]) -> _Draw:
        starts, signals, rows = [], [], []
        for index, (split, rng) in enumerate(rngs.items()):
            states, inputs = self.counts[split]
            pairs = self._pairs(split)
            starts.append(np.stack(self.initial_states.draw(states, rng))[:, pairs[:, 0]])
            signals.append(self.excitation.draw(inputs, self.duration, rng))
            rows += [(index, number) for number in pairs[:, 1]]
        q0, v0 = np.concatenate(starts, axis=1)
        return _Draw(q0, v0, joined(signals, *np.array(rows).T))

    def _move(
        self, draws: Sequence[_Draw], rows: np.ndarray, t: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q0, v0, signals = zip(*draws, strict=True)
        size = len(q0[0])
        signal = joined(signals, rows // size, rows % size)

        def acting(times: np.ndarray) -> np.ndarray:
            return signal(times - self.dead_time)

        q, v = simulate(
            self.system,
            np.concatenate(q0)[rows],
            np.concatenate(v0)[rows],
            acting,
            t,
            rtol=self.rtol,
            atol=self.atol,
            compile=self.compile,
            q_limits=None if self.q_limits is None else np.array(self.q_limits, dtype=float),
            progress=f"simulating {len(rows)} trajectories of {self.name}",
        )
        return q, v, signal(t)

    def _replace(
        self, motions: Sequence[np.ndarray], rngs: Mapping[str, np.random.Generator], t: np.ndarray
    ) -> None:
        """Replace the motions that leave the limits by new draws that stay within them."""
        low, high = np.array(self.q_limits, dtype=float)

        def stays(q: np.ndarray) -> np.ndarray:
            return ((q >= low) & (q <= high)).all((1, 2))

        q, drawn = motions[0], 1
        while (left := np.flatnonzero(~stays(q))).size:
            if drawn >= _DRAWS:
                passed = ((q[left] < low) | (q[left] > high)).any((0, 1))
                raise SimulationError(
                    f"{self.name}: {left.size} of {len(q)} motions leave q_limits of "
                    f"{', '.join(np.array(self.labels)[passed])} in each of {drawn} draws"
                )
            draws = [self._draw(rngs) for _ in range(_AT_ONCE)]
            drawn += _AT_ONCE
            rows = np.concatenate([left + k * len(q) for k in range(_AT_ONCE)])
            new = self._move(draws, rows, t)
            inside = stays(new[0]).reshape(_AT_ONCE, left.size)
            replaced = inside.any(0)
            first = (inside.argmax(0) * left.size + np.arange(left.size))[replaced]
            for old, values in zip(motions, new, strict=True):
                old[left[replaced]] = values[first]
