"""Keys of the programs; ``X | Callable[..., X]`` takes further arguments from the program."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from pinn_dyn.run.configuration.signatures import STAND_INS
from pinn_dyn.run.configuration.validation import Seed

if TYPE_CHECKING:
    from lightning import Callback, Trainer
    from lightning.pytorch.loggers import Logger
    from torch.optim import Optimizer
    from torch.optim.lr_scheduler import LRScheduler

    from pinn_dyn.control import Actuator, Plant, Reference, Sensor, Stage
    from pinn_dyn.data import DataSource, DynamicsData, InitialStates
    from pinn_dyn.evaluation import RolloutValidator
    from pinn_dyn.identification.motion_limits import JointValues, MotionLimits
    from pinn_dyn.mechanics import Predictor
    from pinn_dyn.models.structure import Structure
    from pinn_dyn.systems import RigidChain
    from pinn_dyn.training import LeastSquares, WindowLoss

Names = str | Sequence[str]


@dataclass(kw_only=True)
class TrainSettings:
    """Keys of train.py."""

    name: str
    model_name: str
    seed: Seed
    compile: bool | Literal["auto"]
    threads: PositiveInt
    start_from: str | None = None
    payload: Names | None = None
    resume: str | None = None
    overwrite: bool = False
    trust: Names | None = None
    dataset: DataSource
    data: DynamicsData | Callable[..., DynamicsData]
    model: Predictor | Callable[..., Predictor]
    loss: WindowLoss | Callable[..., WindowLoss]
    optimizer: Optimizer | LeastSquares | Callable[..., Optimizer]
    scheduler: LRScheduler | Callable[..., LRScheduler]
    validator: RolloutValidator | Callable[..., RolloutValidator]
    trainer: Trainer | Callable[..., Trainer]
    callbacks: Mapping[str, Callback | Callable[..., Callback] | None]
    logger: Mapping[str, Logger | Callable[..., Logger]]


@dataclass(kw_only=True)
class TrainerArguments:
    """Arguments of ``lightning.Trainer`` that a configuration may set."""

    steps: PositiveInt | None = None
    validations: PositiveInt | None = None
    accelerator: Literal["cpu", "gpu", "cuda", "auto"] = "auto"
    devices: PositiveInt | Sequence[NonNegativeInt] | Literal["auto"] = "auto"
    strategy: str = "auto"
    precision: Literal["32-true", "32", 32, "bf16-mixed", "bf16"] | None = None
    gradient_clip_val: PositiveFloat | None = None
    gradient_clip_algorithm: Literal["norm", "value"] | None = None
    enable_progress_bar: bool = True  # lines of progress
    deterministic: bool | Literal["warn"] = False
    detect_anomaly: bool = False
    profiler: Literal["simple", "advanced"] | None = None


for _name in ("lightning.Trainer", "lightning.pytorch.trainer.trainer.Trainer"):
    STAND_INS[_name] = TrainerArguments


@dataclass(kw_only=True)
class _RunSettings:
    """Keys of a command that reads run folders."""

    checkpoint: Literal["best", "last"]
    trajectory: NonNegativeInt
    threads: PositiveInt
    trust: Names | None = None


@dataclass(kw_only=True)
class EvaluateSettings(_RunSettings):
    """Keys of evaluate.py."""

    runs: Names
    split: Literal["test", "validation"]
    dataset: DataSource | None = None
    horizon: PositiveFloat | None
    step: PositiveFloat | None
    windows: Sequence[PositiveFloat] | None
    ensemble: bool
    thresholds: Mapping[str, PositiveFloat]


@dataclass(kw_only=True)
class Gains:
    """Gains of the control laws: one number, or one for each coordinate."""

    position: PositiveFloat | Sequence[PositiveFloat]
    velocity: PositiveFloat | Sequence[PositiveFloat]


@dataclass(kw_only=True)
class Law:
    """A control law on the terms of the learned model or of the true system."""

    terms: Literal["learned", "truth"]
    law: Stage | Callable[..., Stage]
    observer: Stage | Callable[..., Stage] | None = None


@dataclass(kw_only=True)
class Guard:
    """Reaction to states far from the training data."""

    threshold: PositiveFloat | None = None
    fallback: Literal["hold", "regulation"] | None = None


@dataclass(kw_only=True)
class ControlSettings(_RunSettings):
    """Keys of control.py."""

    run: str
    gains: Gains | Mapping[str, Any]
    duration: PositiveFloat
    rate: PositiveFloat
    samples_rate: PositiveFloat | None
    initial_states: InitialStates | None
    runs: PositiveInt
    seed: Seed
    robot: Mapping[str, Any]
    actuator: Actuator
    sensor: Sensor
    dead_time: NonNegativeFloat
    guard: Guard | Mapping[str, Any]
    export: str | None
    exported_law: str
    export_real: Literal["double", "float"]
    settled_after: NonNegativeFloat
    animate: bool
    controllers: Mapping[str, Law | Mapping[str, Any]]
    reference: Reference | Callable[..., Reference]
    plant: Plant | Callable[..., Plant] | None


@dataclass(kw_only=True)
class KnownStructure:
    """Known structure of the robot, before a model is chosen."""

    structure: Structure | None = None


@dataclass(kw_only=True)
class CheckSettings:
    """Keys of check.py."""

    dataset: DataSource
    model: KnownStructure | Mapping[str, Any]
    longest_delay: PositiveFloat


@dataclass(kw_only=True)
class RobotKinematics:
    """Known structure of the robot."""

    structure: RigidChain


@dataclass(kw_only=True)
class ExciteSettings:
    """Keys of excite.py."""

    model: RobotKinematics | Mapping[str, Any]
    duration: PositiveFloat
    frequency: PositiveFloat
    start: JointValues
    limits: MotionLimits | Mapping[str, Any]
    steps: PositiveInt
    seed: Seed
    rate: PositiveFloat
    approach: NonNegativeFloat


@dataclass(kw_only=True)
class GatherSettings:
    """Keys of gather.py."""

    runs: Names
    evaluations: Names | None
    sort: str
    plot: str | None


SETTINGS: dict[str, type] = {
    "train": TrainSettings,
    "evaluate": EvaluateSettings,
    "control": ControlSettings,
    "check": CheckSettings,
    "gather": GatherSettings,
    "excite": ExciteSettings,
}
