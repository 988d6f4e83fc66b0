"""Simulated data sets: a mechanical system under random inputs from random initial states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from pinn_dyn.data.cache import Arrays, load_or_make
from pinn_dyn.data.excitation import Excitation
from pinn_dyn.data.fingerprint import describe
from pinn_dyn.data.simulation import simulate
from pinn_dyn.data.source import DataSource, Splits
from pinn_dyn.mechanics import MechanicalSystem, Signal, Trajectory

# Part of the cache key: raise it when the same description would give other numbers.
_VERSION = 3
_SPLITS = ("train", "validation", "test")


@dataclass(frozen=True)
class InitialStates:
    """A box from which initial states are drawn uniformly.

    Args:
        q_low, q_high: bounds of the configuration, ``(N,)``.
        v_max: bound of the speed of each coordinate, ``(N,)``.

    Raises:
        ValueError: if the lengths differ, a bound is not finite, or a lower one exceeds the upper.
    """

    q_low: Sequence[float]
    q_high: Sequence[float]
    v_max: Sequence[float]

    def __post_init__(self) -> None:
        if not len(self.q_low) == len(self.q_high) == len(self.v_max):
            raise ValueError(
                f"InitialStates: q_low, q_high and v_max have {len(self.q_low)}, "
                f"{len(self.q_high)} and {len(self.v_max)} entries, expected the same number"
            )
        bounds = np.array([self.q_low, self.q_high, self.v_max], dtype=float)
        if not np.isfinite(bounds).all():
            raise ValueError(
                f"InitialStates: bounds are {bounds.tolist()}, expected finite numbers"
            )
        if (bounds[0] > bounds[1]).any() or (bounds[2] < 0).any():
            raise ValueError(
                f"InitialStates: q_low = {list(self.q_low)}, q_high = {list(self.q_high)}, v_max = "
                f"{list(self.v_max)}: expected q_low <= q_high and v_max >= 0"
            )

    def draw(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """``count`` initial configurations and velocities, both ``(count, N)``."""
        v_max = np.asarray(self.v_max, dtype=float)
        shape = (count, len(v_max))
        return rng.uniform(self.q_low, self.q_high, shape), rng.uniform(-v_max, v_max, shape)


class SimulatedSource(DataSource):
    """Trajectories of a known system, simulated once and cached on disk.

    Training trajectories combine every initial state with every input, or pair them one to one;
    validation and test trajectories each have an initial state and an input of their own, which
    no training trajectory has.

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
        ValueError: on a step longer than the duration, a count below 1, an unknown pairing or one
            of unequal counts, or sizes that do not match the system.
    """

    def __init__(
        self,
        *,
        name: str,
        system: MechanicalSystem,
        excitation: Excitation,
        initial_states: InitialStates,
        duration: float,
        test_duration: float | None = None,
        step: float,
        keep_every: int = 1,
        train_initial_states: int,
        train_inputs: int,
        pairing: Literal["product", "matched"] = "product",
        validation: int,
        test: int,
        seed: int = 0,
        rtol: float = 1e-8,
        atol: float = 1e-9,
        compile: bool = False,
        cache: str,
        labels: Sequence[str],
        input_labels: Sequence[str],
        configurations: Mapping[str, Sequence[float]],
    ):
        if not 0 < step <= duration:
            raise ValueError(
                f"{name}: step is {step} s and duration {duration} s, expected 0 < step <= duration"
            )
        self.test_duration = duration if test_duration is None else test_duration
        if not step <= self.test_duration <= duration:
            raise ValueError(
                f"{name}: test_duration is {test_duration} s, expected from step = {step} to "
                f"duration = {duration} s"
            )
        for key, value in (
            ("keep_every", keep_every),
            ("train_initial_states", train_initial_states),
            ("train_inputs", train_inputs),
            ("validation", validation),
            ("test", test),
        ):
            if value < 1:
                raise ValueError(f"{name}: {key} is {value}, expected at least 1")
        if pairing not in ("product", "matched"):
            raise ValueError(f"{name}: pairing is {pairing!r}, expected 'product' or 'matched'")
        if pairing == "matched" and train_initial_states != train_inputs:
            raise ValueError(
                f"{name}: pairing is 'matched' with {train_initial_states} initial states and "
                f"{train_inputs} inputs for training, expected as many of each"
            )
        for key, found, expected in (
            ("initial_states", len(initial_states.q_low), system.num_coordinates),
            ("labels", len(labels), system.num_coordinates),
            ("input_labels", len(input_labels), system.num_inputs),
            *(
                (f"configurations.{key}", len(q), system.num_coordinates)
                for key, q in configurations.items()
            ),
        ):
            if found != expected:
                raise ValueError(f"{name}: {key} has {found} entries, the system needs {expected}")
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
        """The trajectories, from the cache or newly simulated."""
        arrays = load_or_make(self.cache, self.name, self.describe(), self.simulate)
        t = torch.from_numpy(arrays["t"][:: self.keep_every])
        splits: dict[str, list[Trajectory]] = {}
        for split in _SPLITS:
            q, v, u = (
                torch.from_numpy(arrays[f"{split}_{key}"][:, :: self.keep_every]) for key in "qvu"
            )
            splits[split] = [
                Trajectory(q[k], v[k], Signal(t[: q.shape[1]], u[k]), momentum=self._momentum)
                for k in range(q.shape[0])
            ]
        return Splits(splits["train"], splits["validation"], splits["test"])

    def describe(self) -> dict[str, object]:
        """What the simulation depends on, the code of the system included: the key of the cache."""
        parts = {
            key: describe(getattr(self, key)) for key in ("system", "excitation", "initial_states")
        }
        return {
            "version": _VERSION,
            **parts,
            "duration": self.duration,
            "test_duration": self.test_duration,
            "step": self.step,
            "counts": self.counts,
            "pairing": self.pairing,
            "seed": self.seed,
            "rtol": self.rtol,
            "atol": self.atol,
        }

    def fingerprint(self) -> dict[str, object]:
        """What the trajectories depend on; the key of the cache where every sample is kept."""
        kept = {} if self.keep_every == 1 else {"keep_every": self.keep_every}
        return {**self.describe(), **kept}

    def simulate(self) -> Arrays:
        """Simulate all trajectories anew: arrays ``<split>_<q, v, u>``, each ``(K, T, .)``."""
        # Splits of one duration are one batch.
        if self.test_duration == self.duration:
            return self._simulate(_SPLITS, self.duration, 0)
        # Two batches of one size: the compiled equation of motion serves both.
        states, inputs = self.counts["train"]
        train = states * inputs if self.pairing == "product" else states
        size = max(train, self.counts["validation"][0] + self.counts["test"][0])
        return {
            **self._simulate(_SPLITS[1:], self.test_duration, size),
            **self._simulate(_SPLITS[:1], self.duration, size),  # the longer times, "t", last
        }

    def _simulate(self, splits: Sequence[str], duration: float, size: int) -> Arrays:
        """Trajectories of some splits in one batch, filled up with copies to ``size``."""
        t = np.arange(round(duration / self.step) + 1) * self.step
        starts, signals, pick = [], [], []
        for split in splits:
            # One generator per split: more test trajectories do not change the training set.
            rng = np.random.default_rng([self.seed, _SPLITS.index(split)])
            states, inputs = self.counts[split]
            starts.append(self.initial_states.draw(states, rng))
            signals.append(self.excitation.draw(inputs, self.duration, rng))
            if split == "train" and self.pairing == "product":
                pick.append(np.array([(a, b) for a in range(states) for b in range(inputs)]))
            else:
                pick.append(np.array([(a, a) for a in range(states)]))

        count = sum(map(len, pick))
        rows = np.arange(max(count, size)) % count

        def signal(time: np.ndarray) -> np.ndarray:
            drawn = [part(time) for part in signals]
            return np.concatenate([d[p[:, 1]] for d, p in zip(drawn, pick, strict=True)])[rows]

        q0 = np.concatenate([s[0][p[:, 0]] for s, p in zip(starts, pick, strict=True)])[rows]
        v0 = np.concatenate([s[1][p[:, 0]] for s, p in zip(starts, pick, strict=True)])[rows]
        q, v = simulate(
            self.system,
            q0,
            v0,
            signal,
            t,
            rtol=self.rtol,
            atol=self.atol,
            compile=self.compile,
            progress=f"simulating {count} trajectories of {self.name}",
        )
        ends = np.cumsum([0, *(len(p) for p in pick)])
        arrays = {"t": t}
        for index, split in enumerate(splits):
            part = slice(ends[index], ends[index + 1])
            arrays[f"{split}_q"], arrays[f"{split}_v"] = q[part], v[part]
            arrays[f"{split}_u"] = signals[index](t)[pick[index][:, 1]]
        return arrays

    def _momentum(self, q: Tensor, v: Tensor) -> Tensor:
        """p = M(q) v, in pieces that fit the processor's cache."""
        size = q.shape[-1]
        pieces = zip(q.reshape(-1, size).split(2048), v.reshape(-1, size).split(2048), strict=True)
        with torch.no_grad():
            return torch.cat([self.system.momentum(a, b) for a, b in pieces]).reshape(q.shape)
