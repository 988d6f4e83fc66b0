"""Training in Python: built objects in, a trained run out."""

from __future__ import annotations

import contextlib
import copy
import inspect
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import torch
from pydantic import PositiveInt
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LRScheduler

from pinn_dyn.data import DataSource, DynamicsData, LogSource
from pinn_dyn.data.cache import cache_key
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models import (
    AccelerationMLP,
    CoupledOscillators,
    HamiltonianNetwork,
    KnownMechanics,
    KnownSystem,
    LagrangianNetwork,
    NextStateMLP,
    SubspaceEncoder,
)
from pinn_dyn.run.configuration.build import ModelBuilder, built, described
from pinn_dyn.run.configuration.command_line import hush
from pinn_dyn.run.configuration.defaults import defaults, even_validations, section
from pinn_dyn.run.run import TRAJECTORIES, Run
from pinn_dyn.run.run_folder import (
    CHECKPOINTS,
    FINISHED,
    claimed,
    load_run,
    merged,
    with_structures,
)
from pinn_dyn.run.training.fit_constants import check_trainer, fit_constants
from pinn_dyn.run.training.known_data import match_model
from pinn_dyn.run.training.prepared import TrainingPlan, same_data
from pinn_dyn.training import IncrementLoss, LeastSquares, MidpointLoss, WindowLoss, one_cycle
from pinn_dyn.wording import did_you_mean

if TYPE_CHECKING:
    from lightning import Callback
    from lightning.pytorch.loggers import Logger

MODELS: dict[str, ModelBuilder] = {
    "lnn": LagrangianNetwork,
    "hnn": HamiltonianNetwork,
    "acceleration": AccelerationMLP,
    "mlp": NextStateMLP,
    "subnet": SubspaceEncoder,
    "oscillators": CoupledOscillators,
}
"""Models by their names in conf/model."""
_COLUMNS = [
    "name",
    "time",
    "q",
    "u",
    "v",
    "trajectory",
    "steps",
    "delay",
    "interpolation",
    "angles",
]

_PARTS = ("data", "loss", "optimizer", "scheduler", "validator")

log = logging.getLogger(__name__)


def train(
    source: DataSource,
    model: str | ModelBuilder | Predictor,
    *,
    loss: str | Callable[..., WindowLoss] | None = None,
    optimizer: Callable[..., Optimizer] | LeastSquares | None = None,
    scheduler: Callable[..., LRScheduler] = one_cycle,
    data: Callable[..., DynamicsData] | None = None,
    validator: Callable[..., RolloutValidator] = RolloutValidator,
    steps: PositiveInt | None = None,
    validations: PositiveInt | None = None,
    seed: int = 0,
    compile: bool | Literal["auto"] = "auto",
    threads: PositiveInt = 1,
    trainer: Mapping[str, Any] = MappingProxyType({}),
    callbacks: Sequence[Callback] | None = None,
    loggers: Sequence[Logger] | None = None,
    start_from: Run | None = None,
    folder: str | Path | None = None,
    overwrite: bool = False,
    model_name: str | None = None,
    config: Mapping[str, Any] | None = None,
) -> Run:
    """Train a model on the data of a source, and return the run with the best checkpoint.

    Builders are classes or :func:`functools.partial` of them, without the arguments of the data::

        model=partial(LagrangianNetwork, mass=partial(NetworkCholesky, hidden=[64, 64]))
        data=partial(DynamicsData, steps=10, stride="20 ms", pairs=4000)
        optimizer=partial(torch.optim.AdamW, lr=0.002)

    Arguments that are None depend on the model and on the kind of data. They are those of train.py,
    see :func:`~.run.configuration.defaults.defaults`, also for ``activation`` of a
    ``NextStateMLP``, ``state`` of a ``HamiltonianNetwork`` and ``friction`` of ``KnownMechanics``.

    A folder with an interrupted training of the same data and arguments is resumed, and a finished
    one is loaded. A folder with another training is refused.

    Args:
        source: the data.
        model: builder, called with ``statistics=``; or ``"lnn"``, ``"hnn"``, ``"acceleration"``,
            ``"mlp"``, ``"subnet"`` or ``"oscillators"``; or a built predictor, which is trained in
            place.
        loss: builder, called with ``statistics=`` and ``model=``; or ``"increment"`` or
            ``"midpoint"``; None takes the increment loss.
        optimizer: builder, called with the parameters; or a least-squares fit; None takes AdamW.
        scheduler: builder, called with the optimizer and ``total_steps=``.
        data: builder of the training windows, called with ``source=``.
        validator: builder of the validation, called with ``training_step=``.
        steps: steps of the optimizer.
        validations: number of validations, a divisor of ``steps``.
        seed: seed of the weights and of the order of the windows.
        compile: compile the dynamics; ``"auto"`` does in long trainings if there is a compiler.
        threads: CPU threads; small networks are fastest with one.
        trainer: arguments of :class:`lightning.Trainer` beside the defaults; least squares uses
            none.
        callbacks: callbacks; None draws figures of rollouts if there is a folder.
        loggers: loggers; None writes a TensorBoard log to the folder.
        start_from: a run whose weights the training starts from.
        folder: the run folder; None uses a temporary one, see :meth:`Run.save`.
        overwrite: replace the run in the folder, if any.
        model_name: short name of the model for tables; None takes that of ``model``.
        config: description of the run that its checkpoint keeps; None describes the arguments.

    Raises:
        ValueError: if the data, the model or the settings do not fit together, or the folder holds
            a training of other data or arguments.
        NonFiniteLossError: if the loss becomes NaN or infinite.
        KeyboardInterrupt: if the training was interrupted; its last checkpoint is kept.
    """
    temporary = None
    if folder is None:
        temporary = TemporaryDirectory(prefix="pinn_dyn-")
        folder, callbacks = temporary.name, callbacks or ()
    model, model_name = _builder(model, model_name)
    on_log, least_squares = isinstance(source, LogSource), isinstance(optimizer, LeastSquares)
    values = defaults(_factory(model).__name__, on_log=on_log, least_squares=least_squares)
    usual = section(values, "trainer")
    usual_steps, most_validations = usual.pop("steps"), usual.pop("validations")
    steps = steps or usual_steps
    if config is None:
        model, trainer = _with_defaults(model, on_log), {**usual, **trainer}
    if least_squares:
        check_trainer(trainer)
    elif _factory(model) in (KnownMechanics, KnownSystem):
        log.info("optimizer=least_squares (in Python LeastSquares()) fits constants in seconds")
    model, changes = match_model(model, source)
    plan = TrainingPlan(
        source=source,
        model=model,
        loss=_loss(loss, section(values, "loss")),
        optimizer=optimizer or partial(AdamW, **section(values, "optimizer")),
        scheduler=scheduler,
        data=data or partial(DynamicsData, **section(values, "data"), history=_history(model)),
        validator=validator,
        steps=steps,
        validations=validations or even_validations(steps, most_validations),
        seed=seed,
        compile=compile,
        threads=threads,
        trainer=trainer,
        callbacks=callbacks,
        loggers=loggers,
        start_from=start_from,
        folder=Path(folder).expanduser(),
        stores_data=config is None and temporary is None,
    )
    description = with_structures(config or _description(plan, model_name))
    plan = replace(plan, config=merged(description, {"model": changes} if changes else {}))
    try:
        _carry_out(plan, overwrite)
    except KeyboardInterrupt:
        way = _way_on(plan.folder, temporary is not None, overwrite)
        # Without the frames of Lightning; the cause of the context is its exit, if any.
        raise KeyboardInterrupt(f"the training was interrupted: {way}") from None
    # The builder of a built model gives a model for the weights of the checkpoint.
    builder = (lambda statistics: copy.deepcopy(model)) if isinstance(model, Predictor) else model
    run = load_run(plan.folder, "best", trust=None, model=builder)
    return replace(run, _made_in_python=source if config is None else None, _temporary=temporary)


def _carry_out(plan: TrainingPlan, overwrite: bool) -> None:
    """Train, resume a training, or keep a finished one."""
    folder = plan.folder
    with _isolated(plan.threads), claimed(folder, plan.config, overwrite) as (checkpoint, saved):
        if saved.get(FINISHED):
            same_data(plan.source, folder, saved)
            log.info("already trained: %s is loaded; overwrite=True trains again", folder)
        elif isinstance(plan.optimizer, LeastSquares):
            fit_constants(plan, plan.optimizer, saved)
        else:
            from pinn_dyn.run.training.trainer import train_network  # imports Lightning

            train_network(plan, checkpoint, saved)


@contextlib.contextmanager
def _isolated(threads: int) -> Iterator[None]:
    """Restore the number of threads and the random numbers of PyTorch after a training."""
    with contextlib.ExitStack() as stack:
        stack.callback(torch.set_num_threads, torch.get_num_threads())
        stack.enter_context(torch.random.fork_rng(range(torch.cuda.device_count())))
        torch.set_num_threads(threads)
        hush()
        yield


def _way_on(folder: Path, is_temporary: bool, overwrite: bool) -> str:
    """Return how an interrupted training goes on."""
    if is_temporary:
        return "its steps are lost; with folder=... the same call would resume it"
    if not (folder / CHECKPOINTS / "last.ckpt").is_file():
        return "nothing is saved yet, the same call starts again"
    return f"the same call resumes it from {folder}" + " without overwrite" * overwrite


def _builder(model: Any, name: str | None) -> tuple[Any, str]:
    """Return the builder of a model that may be a name, and its short name."""
    if isinstance(model, str):
        return _by_name("model", model, MODELS), name or model
    return model, name or _factory(model).__name__


def _factory(model: Any) -> Any:
    """Return the class or function of a builder, or the class of a built model."""
    factory = model.func if isinstance(model, partial) else model
    return factory if hasattr(factory, "__name__") else type(factory)


def _loss(loss: str | Callable[..., WindowLoss] | None, values: Mapping[str, Any]) -> Any:
    """Return the builder of a loss that may be a name."""
    if loss is None or isinstance(loss, str):
        names = {"increment": partial(IncrementLoss, **values), "midpoint": MidpointLoss}
        return _by_name("loss", loss or "increment", names)
    return loss


def _by_name(kind: str, value: str, names: Mapping[str, Any]) -> Any:
    if value not in names:
        expected = f", expected {', '.join(names)} or a builder like partial(KnownMechanics, ...)"
        raise ValueError(f"{kind} is {value!r}{did_you_mean(value, names) or expected}")
    return names[value]


def _with_defaults(model: Any, on_log: bool) -> Any:
    """Return the builder of a model with the settings that the command line has by default."""
    if isinstance(model, Predictor):
        return model
    settings = getattr(model, "keywords", {})
    values = section(defaults(_factory(model).__name__, on_log=on_log), "model")
    changes = built({k: x for k, x in values.items() if k not in settings})
    if "known" in settings:
        changes["known"] = _with_defaults(settings["known"], on_log)
    return partial(model, **changes) if changes else model


def _history(model: Any) -> float:
    """Return the time before its start that a model sees, s."""
    if isinstance(model, Predictor):
        return model.input_history
    arguments = inspect.signature(model).parameters
    return arguments["history"].default if "history" in arguments else 0.0


def _model_description(model: Any) -> dict[str, Any]:
    """Describe a builder, or a built model by a hash of all but its learned parameters."""
    if not isinstance(model, Predictor):
        return {"model": described(model)}
    shapes = {name: list(value.shape) for name, value in model.named_parameters()}
    fixed = {name: value.tolist() for name, value in model.named_buffers()}
    return {
        "model": None,
        "built": cache_key([type(model).__qualname__, repr(model), shapes, fixed]),
    }


def _description(plan: TrainingPlan, name: str) -> dict[str, Any]:
    """Describe a training in Python; its trajectories are stored in the run folder."""
    source = plan.source
    stored = {
        "_target_": "pinn_dyn.data.StoredSource",
        "path": TRAJECTORIES,
        "name": source.name,
        "labels": list(source.labels),
        "input_labels": list(source.input_labels),
        "angles": list(source.angles),
        "delay": source.input_delay.tolist(),
    }
    config = {"name": f"{source.name}/{name}", "model_name": name, "dataset": stored}
    if isinstance(source, LogSource):
        # Columns and cleaning, for predictions along a data frame.
        columns = {key: described(getattr(source, key)) for key in _COLUMNS}
        config["log"] = {"_target_": "pinn_dyn.data.LogSource", "files": "*", **columns}
    config |= _model_description(plan.model)
    config |= {name: described(getattr(plan, name)) for name in _PARTS}
    config |= {name: getattr(plan, name) for name in ("seed", "compile", "threads")}
    if plan.start_from is not None:
        config["start_from"] = str(plan.start_from.folder)
    length = {"steps": plan.steps, "validations": plan.validations}
    return config | {"trainer": {**length, **plan.trainer}}
