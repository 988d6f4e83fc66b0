"""Simulated data sets: a mechanical system under random inputs from random initial states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
import torch
from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from pinn_dyn.data.cache import Arrays, load_or_make
from pinn_dyn.data.excitation import Excitation, Joined
from pinn_dyn.data.excitation import Signal as InputSignal
from pinn_dyn.data.fingerprint import describe
from pinn_dyn.data.initial_states import InitialStates
from pinn_dyn.data.limits import Limits
from pinn_dyn.data.simulation import SimulationError, momentum, simulate
from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.mechanics import MechanicalSystem, Signal, Trajectory
from pinn_dyn.systems import HasDomain

# Part of the cache key: raise it when the same settings give different numbers.
_VERSION = 3
# Within limits: largest number of draws of a motion, and draws that are simulated at once.
_DRAWS = 40
_AT_ONCE = 3


class SimulatedSource(DataSource):
    """Trajectories of a known system, simulated once and cached on disk.

    Training trajectories combine every initial state with every input, or pair them one to one;
    validation and test trajectories each have an initial state and an input of their own, which
    no training trajectory has. A motion that leaves ``q_limits`` is drawn anew, both its initial
    state and its input: the k-th motion of a split is the first within them of a sequence of draws.

    Args:
        name: short name of the data set.
        system: the truth.
        excitation: family of input signals.
        initial_states: box of initial states.
        duration: length of each training trajectory, s.
        test_duration: length of each validation and test trajectory, s; ``duration`` if None.
        step: sample time of the simulation, s.
        keep_every: keep every n-th sample, for a lower rate from the same simulation.
        train_initial_states: number of initial states for training.
        train_inputs: number of inputs for training.
        pairing: ``"product"`` trains on every combination of these, ``"matched"`` gives each
            initial state an input of its own.
        q_limits: lower and upper limits of the configuration, ``(2, N)``, which no motion leaves;
            they take ``pairing="matched"``. None: no limits.
        validation: number of validation trajectories.
        test: number of test trajectories.
        seed: seed of all initial states and inputs.
        rtol, atol: tolerances of the solver.
        compile: compile the equation of motion for the simulation.
        cache: folder of the cache; ``~`` is the home folder.
        labels: name and unit of each coordinate, N of them.
        input_labels: name and unit of each input, M of them.
        configurations: named configurations at which learned terms are looked at, ``(N,)`` each.

    Raises:
        ValueError: on durations, counts or sizes that do not match, or ranges of q beyond the
            domain of the system's equation.
    """

    def __init__(
        self,
        *,
        name: str,
        system: MechanicalSystem,
        excitation: Excitation,
        initial_states: InitialStates,
        duration: PositiveFloat,
        test_duration: PositiveFloat | None = None,
        step: PositiveFloat,
        keep_every: PositiveInt = 1,
        train_initial_states: PositiveInt,
        train_inputs: PositiveInt,
        pairing: Literal["product", "matched"] = "product",
        q_limits: Sequence[Sequence[float]] | None = None,
        validation: PositiveInt,
        test: PositiveInt,
        seed: NonNegativeInt = 0,
        rtol: PositiveFloat = 1e-8,
        atol: PositiveFloat = 1e-9,
        compile: bool = False,
        cache: str = "~/.cache/pinn_dyn",
        labels: Sequence[str],
        input_labels: Sequence[str],
        configurations: Mapping[str, Sequence[float]] = MappingProxyType({}),
    ):
        self.test_duration = duration if test_duration is None else test_duration
        if not keep_every * step <= self.test_duration <= duration:
            raise ValueError(
                f"{name}: test_duration is {self.test_duration} s, expected from keep_every * step "
                f"= {keep_every * step:g} to duration = {duration} s"
            )
        if pairing == "matched" and train_initial_states != train_inputs:
            raise ValueError(
                f"{name}: pairing is 'matched' with {train_initial_states} initial states and "
                f"{train_inputs} inputs for training, expected as many of each"
            )
        for key, size, expected in (
            ("initial_states", len(initial_states.q_low), system.num_coordinates),
            ("labels", len(labels), system.num_coordinates),
            ("input_labels", len(input_labels), system.num_inputs),
            *(
                (f"configurations.{key}", len(q), system.num_coordinates)
                for key, q in configurations.items()
            ),
        ):
            if size != expected:
                raise ValueError(f"{name}: {key} has {size} entries, the system needs {expected}")
        ranges = {"initial_states": (initial_states.q_low, initial_states.q_high)}
        self.limits = None
        if q_limits is not None:
            if pairing != "matched":
                raise ValueError(
                    f"{name}: q_limits with pairing = {pairing!r}: a motion that leaves them is "
                    "drawn anew, which would break the combinations; expected 'matched'"
                )
            self.limits = Limits(f"{name}: q_limits", q_limits, around=ranges["initial_states"])
            ranges["q_limits"] = (q_limits[0], q_limits[1])
        if isinstance(system, HasDomain):
            for key, (low, high) in ranges.items():
                try:
                    system.check_domain(np.asarray(low), np.asarray(high))
                except ValueError as error:
                    raise ValueError(f"{name}: {key}: {error}") from error
        self.name = name
        self.system: MechanicalSystem = system
        self.angles = tuple(getattr(system, "angles", ()))
        self.configurations = {key: list(q) for key, q in configurations.items()}
        self.excitation = excitation
        self.initial_states = initial_states
        self.duration = duration
        self.step = step
        self.keep_every = keep_every
        self.pairing = pairing
        self.compile = compile
        self.counts = {
            "train": (train_initial_states, train_inputs),
            "validation": (validation, validation),
            "test": (test, test),
        }
        self.seed = seed
        self.rtol = rtol
        self.atol = atol
        self.cache = Path(cache).expanduser()
        self.labels = list(labels)
        self.input_labels = list(input_labels)

    def load(self) -> Splits:
        arrays = load_or_make(self.cache, self.name, self.describe(), self.simulate)
        t = torch.from_numpy(arrays["t"][:: self.keep_every])
        splits: dict[str, list[Trajectory]] = {}
        for split in SPLITS:
            q, v, u = (
                torch.from_numpy(arrays[f"{split}_{key}"][:, :: self.keep_every]) for key in "qvu"
            )
            splits[split] = [
                Trajectory(
                    q[k],
                    v[k],
                    Signal(t[: q.shape[1]], u[k]),
                    momentum=partial(momentum, self.system),
                )
                for k in range(q.shape[0])
            ]
        return Splits(**splits)

    def describe(self) -> dict[str, object]:
        """Return the settings that the simulation depends on: the key of the cache."""
        parts = {
            key: describe(getattr(self, key)) for key in ("system", "excitation", "initial_states")
        }
        limits = {} if self.limits is None else {"q_limits": describe(self.limits.bounds)}
        return {
            "version": _VERSION,
            **parts,
            **limits,
            "duration": self.duration,
            "test_duration": self.test_duration,
            "step": self.step,
            "counts": self.counts,
            "pairing": self.pairing,
            "seed": self.seed,
            "rtol": self.rtol,
            "atol": self.atol,
        }

    def simulate(self) -> Arrays:
        """Simulate all trajectories anew: arrays ``<split>_<q, v, u>``, each ``(K, T, .)``."""
        # Splits of one duration are one batch.
        if self.test_duration == self.duration:
            return self._simulate(SPLITS, self.duration, 0)
        # Two batches of one size: the compiled equation of motion serves both.
        size = max(self._size("train"), self._size("validation") + self._size("test"))
        return {
            **self._simulate(SPLITS[1:], self.test_duration, size),
            **self._simulate(SPLITS[:1], self.duration, size),  # the longer times, "t", last
        }

    def _simulate(self, splits: Sequence[str], duration: float, size: int) -> Arrays:
        """Simulate the trajectories of some splits in one batch, padded with copies to ``size``."""
        t = np.arange(round(duration / self.step) + 1) * self.step
        # One generator per split: more test trajectories do not change the training set.
        rngs = [np.random.default_rng([self.seed, SPLITS.index(split)]) for split in splits]
        first = self._draw(splits, rngs)
        count = len(first.q0)
        rows = np.arange(max(count, size)) % count
        q, v, u = (x[:count] for x in self._move([first], rows, t, count))
        if self.limits is not None:
            self._replace(self.limits, (q, v, u), splits, rngs, t)
        elif isinstance(self.system, HasDomain):
            for low, high in zip(q.min(1), q.max(1), strict=True):
                try:
                    self.system.check_domain(low, high)
                except ValueError as error:
                    raise SimulationError(
                        f"{self.name}: in a motion {error}; set q_limits, within which motions "
                        "are drawn anew, or reduce the excitation"
                    ) from error
        ends = np.cumsum([0, *(self._size(split) for split in splits)])
        arrays = {"t": t}
        for index, split in enumerate(splits):
            for key, values in (("q", q), ("v", v), ("u", u)):
                arrays[f"{split}_{key}"] = values[ends[index] : ends[index + 1]]
        return arrays

    def _size(self, split: str) -> int:
        states, inputs = self.counts[split]
        product = split == "train" and self.pairing == "product"
        return states * inputs if product else states

    def _draw(self, splits: Sequence[str], rngs: Sequence[np.random.Generator]) -> _Draw:
        """Draw an initial state and an input for each motion of some splits."""
        starts, signals, pick = [], [], []
        for split, rng in zip(splits, rngs, strict=True):
            states, inputs = self.counts[split]
            starts.append(self.initial_states.draw(states, rng))
            signals.append(self.excitation.draw(inputs, self.duration, rng))
            if split == "train" and self.pairing == "product":
                pick.append(np.array([(a, b) for a in range(states) for b in range(inputs)]))
            else:
                pick.append(np.array([(a, a) for a in range(states)]))

        q0, v0 = (
            np.concatenate([s[k][p[:, 0]] for s, p in zip(starts, pick, strict=True)])
            for k in range(2)
        )
        which = np.repeat(np.arange(len(pick)), [len(p) for p in pick])
        return _Draw(q0, v0, Joined(signals, which, np.concatenate(pick)[:, 1]))

    def _move(
        self, draws: Sequence[_Draw], rows: np.ndarray, t: np.ndarray, count: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulate q, v and u of some motions: ``rows`` of the concatenated draws."""
        size = len(draws[0].q0)
        signal = Joined([draw.signal for draw in draws], rows // size, rows % size)
        q, v = simulate(
            self.system,
            np.concatenate([draw.q0 for draw in draws])[rows],
            np.concatenate([draw.v0 for draw in draws])[rows],
            signal,
            t,
            rtol=self.rtol,
            atol=self.atol,
            compile=self.compile,
            q_limits=None if self.limits is None else self.limits.bounds,
            progress=f"simulating {count} trajectories of {self.name}",
        )
        return q, v, signal(t)

    def _replace(
        self,
        limits: Limits,
        motions: tuple[np.ndarray, np.ndarray, np.ndarray],
        splits: Sequence[str],
        rngs: Sequence[np.random.Generator],
        t: np.ndarray,
    ) -> None:
        """Replace the motions that leave the limits by new draws that stay within them.

        Raises:
            SimulationError: if some leave them in every draw.
        """
        q, drawn = motions[0], 1
        while (left := np.flatnonzero(limits.left_by(q))).size:
            if drawn >= _DRAWS:
                raise SimulationError(
                    f"{self.name}: {left.size} of {len(q)} motions leave q_limits in each of "
                    f"{drawn} draws: {limits.passed(q[left], self.labels)}; reduce the amplitude "
                    "of the excitation or the initial states, or widen q_limits"
                )
            draws = [self._draw(splits, rngs) for _ in range(_AT_ONCE)]
            drawn += _AT_ONCE
            rows = np.concatenate([left + k * len(q) for k in range(_AT_ONCE)])
            new = self._move(draws, rows, t, left.size)
            stays = ~limits.left_by(new[0]).reshape(_AT_ONCE, left.size)
            replaced = stays.any(0)
            first = (stays.argmax(0) * left.size + np.arange(left.size))[replaced]
            for old, values in zip(motions, new, strict=True):
                old[left[replaced]] = values[first]


@dataclass(frozen=True)
class _Draw:
    """Initial states ``(K, N)`` and inputs of K motions."""

    q0: np.ndarray
    v0: np.ndarray
    signal: InputSignal
