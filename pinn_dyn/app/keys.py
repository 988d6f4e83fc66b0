"""The keys of the commands: what each holds, the ranges of numbers, and what is not to be set."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple


class Part(NamedTuple):
    """Stands for an object that is built: a mapping with a ``_target_``."""


class Kind:
    """The classes that a part may be of, by dotted names, as rooms take seconds to import."""

    def __init__(self, *names: str):
        self.names = names

    def __str__(self) -> str:
        names = [name.rsplit(".", 1)[-1] for name in self.names]
        return f"that names {'an' if names[0][0] in 'AEIO' else 'a'} {' or '.join(names)}"


class Range(NamedTuple):
    """Numbers from ``low`` to ``high``, or above ``low`` alone."""

    low: float
    high: float = math.inf
    above: bool = False

    def __contains__(self, value: object) -> bool:
        assert isinstance(value, (int, float))
        return (value > self.low if self.above else value >= self.low) and value <= self.high

    def __str__(self) -> str:
        if self.high < math.inf:
            return f"{'above' if self.above else 'from'} {self.low:g} to {self.high:.10g}"
        return f"above {self.low:g}" if self.above else f"of at least {self.low:g}"


Count = Annotated[int, Range(1)]
Index = Annotated[int, Range(0)]
Positive = Annotated[float, Range(0, above=True)]
_GAIN = Range(0, 1e7, above=True)
Gain = Annotated[float, _GAIN]
Seed = Annotated[int, Range(0, 2**32 - 1)]
MOST_MEMBERS = 256
MOST_RUNS = 100_000
MOST_WEIGHTS = 250_000_000
"""Of all networks and members together: 4 GB with gradients and Adam's two moments."""
Threads = Annotated[int, Range(1, 512)]
Names = str | Sequence[str]
_Controller = Annotated[Part, Kind("pinn_dyn.control.Controller")]


class Section:
    """Stands for a mapping with the keys, and the defaults, of a dataclass that is never built."""


@dataclass
class Gains(Section):
    """Of the control laws: one number, or one for each coordinate."""

    position: Gain | Sequence[Gain]
    velocity: Gain | Sequence[Gain]


@dataclass
class Law(Section):
    """A controller: a law on the terms of the learned model or of the truth."""

    terms: Literal["learned", "truth"]
    law: _Controller
    observer: _Controller | None = None


@dataclass
class Guard(Section):
    """What is done about states far from the training data."""

    threshold: Positive | None = None
    fallback: bool = False


@dataclass
class Stability(Section):
    """A box of configurations in which the paper's conditions are looked at."""

    region: str
    q_low: Sequence[float]
    q_high: Sequence[float]
    samples: Annotated[int, Range(1, 100_000)]


@dataclass
class Kinematics(Section):
    """Of a log that is looked at: what is known before a model is chosen."""

    structure: Part | None = None


# Arguments of the trainer that may be set; the program decides on the others.
TRAINER: dict[str, Any] = {
    "steps": Annotated[int, Range(1, 10**9)],
    "validations": Annotated[int, Range(1, 10**6)],
    "accelerator": Literal["cpu", "gpu", "cuda", "auto"],
    "devices": Count | Sequence[Index] | Literal["auto"],
    "num_nodes": Count,
    "strategy": str,
    "precision": Literal["32-true", "32", 32, "bf16-mixed", "bf16"] | None,
    "gradient_clip_val": Annotated[float, Range(1e-9)] | None,
    "gradient_clip_algorithm": Literal["norm", "value"] | None,
    "enable_progress_bar": bool,
    "benchmark": bool | None,
    "deterministic": bool | Literal["warn"],
    "detect_anomaly": bool,
    "profiler": Literal["simple", "advanced"] | None,
}

_Source = Annotated[Part, Kind("pinn_dyn.data.DataSource")]

KEYS: dict[str, dict[str, Any]] = {
    "train": {
        "name": str,
        "model_name": str,
        "seed": Seed,
        "compile": bool | Literal["auto"],
        "ensemble": Annotated[int, Range(1, MOST_MEMBERS)],
        "threads": Threads,
        "start_from": str | None,
        "resume": str | None,
        "resume_from": Literal["last", "best"] | None,
        "trust": Names | None,
        "search": Part | Mapping[str, Any] | None,  # of a finished run its draw alone
        "dataset": _Source,
        "data": Annotated[Part, Kind("pinn_dyn.data.DynamicsData")],
        "model": Annotated[Part, Kind("pinn_dyn.mechanics.Predictor")],
        "loss": Annotated[Part, Kind("pinn_dyn.training.WindowLoss")],
        "optimizer": Annotated[
            Part, Kind("torch.optim.Optimizer", "pinn_dyn.training.LeastSquares")
        ],
        "scheduler": Annotated[Part, Kind("torch.optim.lr_scheduler.LRScheduler")],
        "validator": Annotated[Part, Kind("pinn_dyn.evaluation.RolloutValidator")],
        "trainer": Annotated[Part, Kind("lightning.Trainer")],
        # null leaves one out
        "callbacks": Mapping[str, Annotated[Part, Kind("lightning.Callback")] | None],
        "logger": Mapping[str, Annotated[Part, Kind("lightning.pytorch.loggers.Logger")]],
    },
    "evaluate": {
        "runs": Names,
        "checkpoint": Literal["best", "last"],
        "split": Literal["test", "validation"],
        "dataset": _Source | None,
        "horizon": Positive | None,
        "step": Positive | None,
        "windows": Sequence[Positive] | None,
        "thresholds": Mapping[str, Positive],
        "trajectory": Index,
        "threads": Threads,
        "trust": Names | None,
    },
    "control": {
        "run": str,
        "checkpoint": Literal["best", "last"],
        "member": Index,
        "gains": Gains,
        "duration": Positive,
        "rate": Positive | None,
        "samples_rate": Positive,
        "initial_states": Annotated[Part, Kind("pinn_dyn.data.InitialStates")] | None,
        "runs": Annotated[int, Range(1, MOST_RUNS)],
        "seed": Seed,
        "robot": Mapping[str, Any],
        "actuator": Annotated[Part, Kind("pinn_dyn.control.Actuator")],
        "sensor": Annotated[Part, Kind("pinn_dyn.control.Sensor")],
        "delay": Index,
        "guard": Guard,
        "stability": Stability | None,
        "export": str | None,
        "settle_fraction": Annotated[float, Range(0, 0.999, above=True)],
        "settled_after": Annotated[float, Range(0)],
        "trajectory": Index,
        "animate": bool,
        "threads": Threads,
        "trust": Names | None,
        "controllers": Mapping[str, Law],
        "reference": Annotated[Part, Kind("pinn_dyn.control.Reference")],
        "plant": Annotated[Part, Kind("pinn_dyn.control.Plant")],
    },
    "check": {
        "dataset": _Source,
        "model": Kinematics,
        "longest_delay": Annotated[float, Range(0, 100, above=True)],
    },
    "gather": {
        "runs": Names,
        "evaluations": Names | None,
        "filter": Mapping[str, Any] | None,
        "sort": str,
        "plot": str | None,
        "plot_column": str | None,
    },
}

# Of the numbers that constructors take under these names. Ends are far beyond what makes sense, but
# below what fills a machine or takes for ever.
RANGES = {
    **dict.fromkeys(("batch_size", "keep_every", "pairs", "steps", "stride"), Range(1, 10**9)),
    **dict.fromkeys(("test", "train", "train_initial_states"), Range(1, 10**5)),
    **dict.fromkeys(("train_inputs", "validation"), Range(1, 10**5)),
    **dict.fromkeys(("harmonics", "nodes", "substeps"), Range(1, 1000)),
    "hidden": Range(1, 20_000),
    "segments": Range(1, 100),
    "count": Range(1, MOST_RUNS),
    "workers": Range(1, 512),
    **dict.fromkeys(("every_n_validations", "precondition_frequency"), Range(1)),
    **dict.fromkeys(("duration", "horizon", "piece", "rate", "window"), Range(0, above=True)),
    **dict.fromkeys(("position_gain", "velocity_gain"), _GAIN),
    **dict.fromkeys(("huber", "velocity_weight"), Range(1e-6, 1e6)),
    **dict.fromkeys(("floor", "mass"), Range(0, 1e6)),
    "length": Range(1e-6, 1e6),
    "lr": Range(1e-9, 1e12),  # with less the weights keep their digits
    "weight_decay": Range(0, 1e6),
    **dict.fromkeys(("betas", "coverage", "momentum", "warm_up"), Range(0, 1)),
    **dict.fromkeys(("atol", "eps"), Range(0, 0.1, above=True)),
    "rtol": Range(1e-13, 0.1),
    "seed": Range(0, 2**32 - 1),
}

# Arguments that must be in the configuration, whatever default the constructor has.
NEEDED = {"trainer": ("steps", "validations", "accelerator"), "optimizer": ("lr",)}

# Arguments of a constructor that the program gives, and what to set instead.
_LENGTH = "trainer.steps and trainer.validations"
GIVEN = {
    "data.batches_per_epoch": _LENGTH,
    "data.source": "dataset",
    "optimizer.maximize": "its loss, which is minimized",
    "optimizer.params": "model",
    "scheduler.optimizer": "optimizer",
    "scheduler.total_steps": "trainer.steps",
    "plant.system": "robot",
    "trainer.accumulate_grad_batches": "data.batch_size",
    "trainer.callbacks": "callbacks",
    "trainer.default_root_dir": "hydra.run.dir",
    "trainer.inference_mode": "the validation, which needs derivatives",
    "trainer.limit_val_batches": "trainer.validations and validator",
    "trainer.logger": "logger",
    "trainer.plugins": "trainer.precision and trainer.strategy",
    **dict.fromkeys(
        (
            *("trainer.max_epochs", "trainer.max_steps", "trainer.max_time", "trainer.min_epochs"),
            *("trainer.min_steps", "trainer.limit_train_batches", "trainer.overfit_batches"),
            *("trainer.fast_dev_run", "trainer.check_val_every_n_epoch"),
            "trainer.val_check_interval",
        ),
        _LENGTH,
    ),
}


def places(value: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """A value of a configuration and all that is in it, at any depth, each with its place."""
    yield where, value
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from places(item, f"{where}.{key}" if where else str(key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from places(item, f"{where}[{index}]")
