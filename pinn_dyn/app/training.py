"""Training in Python: built objects in, a trained run out."""

from __future__ import annotations

import contextlib
import copy
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import lightning as L
import torch
from lightning.pytorch.loggers import Logger
from lightning.pytorch.utilities.seed import isolate_rng
from pydantic import PositiveInt
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LRScheduler

from pinn_dyn.app.build import ModelBuilder, build_predictor
from pinn_dyn.app.command import hush
from pinn_dyn.app.config import ConfigError, naming
from pinn_dyn.app.constants import write_constants
from pinn_dyn.app.described import described
from pinn_dyn.app.known_data import check_known, match_model, warn_of_structure
from pinn_dyn.app.provenance import provenance
from pinn_dyn.app.run import TRAJECTORIES, Run
from pinn_dyn.app.run_folder import (
    CHECKPOINTS,
    DATA,
    FINISHED,
    REPLACE,
    claimed,
    finish,
    in_one_line,
    load_run,
    merged,
    read_checkpoint,
    require_same_data,
    with_structures,
)
from pinn_dyn.app.trainer import (
    CLIPPING,
    Recorder,
    build_learner,
    build_trainer,
    compiles,
    epochs,
    even_validations,
    tensorboard,
)
from pinn_dyn.data import DataSource, DynamicsData, LogSource, data_identity, store
from pinn_dyn.data.cache import cache_key
from pinn_dyn.data.fastest_motion import too_long_for
from pinn_dyn.data.whole import write_whole
from pinn_dyn.ensembles import Ensemble, EnsembleData
from pinn_dyn.evaluation import RolloutFigures, RolloutValidator
from pinn_dyn.evaluation.metrics import VALIDATION_ERROR
from pinn_dyn.mechanics import Predictor, stack_until
from pinn_dyn.models import (
    AccelerationMLP,
    CoupledOscillators,
    HamiltonianNetwork,
    KnownAndNetwork,
    KnownMechanics,
    LagrangianNetwork,
    NextStateMLP,
    Statistics,
    SubspaceEncoder,
)
from pinn_dyn.models.output_limits import set_output_limits
from pinn_dyn.spelling import did_you_mean
from pinn_dyn.training import (
    DynamicsLearner,
    IncrementLoss,
    LeastSquares,
    LeastSquaresLearner,
    MidpointLoss,
    WindowLoss,
    one_cycle,
)

MODELS: dict[str, ModelBuilder] = {
    "lnn": LagrangianNetwork,
    "hnn": HamiltonianNetwork,
    "acceleration": AccelerationMLP,
    "mlp": partial(NextStateMLP, activation="silu"),
    "subnet": SubspaceEncoder,
    "oscillators": CoupledOscillators,
}
"""Models by their names in conf/model."""
LOSSES: dict[str, Callable[..., WindowLoss]] = {
    "increment": IncrementLoss,
    "midpoint": MidpointLoss,
}
"""Losses by their names in conf/loss."""
ADAMW = partial(AdamW, lr=0.005, weight_decay=1e-5, fused=True)
TRAINER = {"accelerator": "cpu", "devices": 1, "gradient_clip_val": 1.0}
STEPS, LOG_STEPS = 20_000, 1000
"""Default steps of the optimizer on simulated data and on a log."""
_PAIRS, _BATCH = 10_000, 128  # at most, of a log
_WINDOW, _STEP = 2, 0.02  # steps of a training window of a log, and their length in s
_FEW_PAIRS, _LONG_WINDOW = (
    150,
    10,
)  # pairs for least squares, and steps for it, subnet and oscillators
_HISTORY = 0.5  # s of the past, for subnet
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

log = logging.getLogger(__name__)


def train(
    source: DataSource,
    model: str | ModelBuilder | Predictor,
    *,
    loss: str | Callable[..., WindowLoss] = IncrementLoss,
    optimizer: Callable[..., Optimizer] | LeastSquares = ADAMW,
    scheduler: Callable[..., LRScheduler] = one_cycle,
    data: Callable[..., DynamicsData] | None = None,
    validator: Callable[..., RolloutValidator] = RolloutValidator,
    steps: PositiveInt | None = None,
    validations: PositiveInt | None = None,
    seed: int = 0,
    ensemble: PositiveInt = 1,
    compile: bool | Literal["auto"] = "auto",
    threads: PositiveInt = 1,
    trainer: Mapping[str, Any] = TRAINER,
    callbacks: Sequence[L.Callback] | None = None,
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

    A folder with an interrupted training of the same data and arguments is resumed, and a finished
    one is loaded. A folder with another training is refused.

    Args:
        source: the data.
        model: builder, called with ``statistics=``; or ``"lnn"``, ``"hnn"``, ``"acceleration"``,
            ``"mlp"``, ``"subnet"`` or ``"oscillators"``; or a built predictor, which is trained in
            place.
        loss: builder, called with ``statistics=`` and ``model=``; or ``"increment"`` or
            ``"midpoint"``.
        optimizer: builder, called with the parameters; or a least-squares fit.
        scheduler: builder, called with the optimizer and ``total_steps=``.
        data: builder of the training windows, called with ``source=``; None takes windows of two
            steps of about 20 ms from a log (ten for least squares, subnet and oscillators), and the
            defaults of :class:`~pinn_dyn.data.DynamicsData` from other sources.
        validator: builder of the validation, called with ``training_step=``.
        steps: steps of the optimizer; None takes 1,000 on a log and 20,000 on other sources.
        validations: number of validations, a divisor of ``steps``; None takes up to 10 on a log
            and up to 4 on other sources.
        seed: seed of the weights and of the order of the windows.
        ensemble: number of models trained at once, with the seeds seed, seed + 1, ...
        compile: compile the dynamics; ``"auto"`` does in long trainings if there is a compiler.
        threads: CPU threads; small networks are fastest with one.
        trainer: arguments of :class:`lightning.Trainer`.
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
    is_log = isinstance(source, LogSource)
    data = data or _windows(source, model, optimizer)
    steps = steps or (LOG_STEPS if is_log else STEPS)
    if isinstance(optimizer, LeastSquares):
        steps = validations = 1
        trainer = {key: value for key, value in trainer.items() if key not in CLIPPING}
    validations = validations or even_validations(steps, 10 if is_log else 4)
    if isinstance(model, str):
        builder = _by_name("model", model, MODELS)
        if model == "hnn" and is_log:  # a log has no momenta
            builder = partial(builder, state="qv")
        model_name, model = model_name or model, builder
    made_in_python = config is None
    model, changes = match_model(model, source)
    parts: dict[str, Any] = dict(
        data=data,
        loss=_by_name("loss", loss, LOSSES),
        optimizer=optimizer,
        scheduler=scheduler,
        validator=validator,
    )
    if config is None:
        settings: dict[str, Any] = dict(
            seed=seed, compile=compile, ensemble=ensemble, threads=threads
        )
        if start_from is not None:
            settings["start_from"] = str(start_from.folder)
        settings["trainer"] = {"steps": steps, "validations": validations, **trainer}
        config = _description(source, model, model_name, parts) | settings
    config = merged(with_structures(config), {"model": changes} if changes else {})
    run_folder = Path(folder).expanduser()
    try:
        with contextlib.ExitStack() as stack:
            stack.callback(torch.set_num_threads, torch.get_num_threads())
            torch.set_num_threads(threads)
            stack.enter_context(isolate_rng())
            hush()
            checkpoint, saved = stack.enter_context(claimed(run_folder, config, overwrite))
            if saved.get(FINISHED):
                _same_data(source, run_folder, saved)
                log.info("already trained: %s is loaded; overwrite=True trains again", run_folder)
            else:
                if checkpoint is not None:
                    log.info("resuming in %s from step %d", run_folder, saved["global_step"])
                # A missing compiler or device is refused before data are simulated.
                parts |= dict(config=config, compile=compiles(compile, steps, trainer))
                parts["clipping"] = {key: trainer[key] for key in CLIPPING if key in trainer}
                if callbacks is None:
                    callbacks = [RolloutFigures(every_n_validations=4)]
                if loggers is None:
                    loggers = [tensorboard(run_folder)]
                length = epochs(steps, validations)
                loop = build_trainer(run_folder, trainer, callbacks, loggers, length)
                identity = _same_data(source, run_folder, saved)
                if made_in_python and temporary is None:
                    store(source, run_folder / TRAJECTORIES)
                if isinstance(source, LogSource):
                    write_whole(run_folder / "log_report.md", source.report)
                L.seed_everything(seed, verbose=False)
                windows = build_data(parts.pop("data"), source, seed, length[1])
                learner = _learner(model, windows, loop.world_size, seed, ensemble, parts)
                if start_from is not None:
                    _start_from(start_from, learner, new=checkpoint is None)
                _fit(loop, learner, windows, identity, checkpoint, run_folder)
    except KeyboardInterrupt:
        way = f"the same call resumes it from {run_folder}" + " without overwrite" * overwrite
        if temporary is not None:
            way = "its steps are lost; with folder=... the same call would resume it"
        elif not (run_folder / CHECKPOINTS / "last.ckpt").is_file():
            way = "nothing is saved yet, the same call starts again"
        # Without the frames of Lightning; the cause of the context is its exit, if any.
        raise KeyboardInterrupt(f"the training was interrupted: {way}") from None
    # The builder of a built model gives a model for the weights of the checkpoint.
    builder = (lambda statistics: copy.deepcopy(model)) if isinstance(model, Predictor) else model
    run = load_run(run_folder, "best", trust=None, model=builder)
    return replace(run, _made_in_python=source if made_in_python else None, _temporary=temporary)


def _by_name(kind: str, value: Any, names: Mapping[str, Any]) -> Any:
    """Return the builder of a name, or the value if it is no name."""
    if not isinstance(value, str):
        return value
    if value not in names:
        expected = f", expected {', '.join(names)} or a builder like partial(KnownMechanics, ...)"
        raise ValueError(f"{kind} is {value!r}{did_you_mean(value, names) or expected}")
    return names[value]


def _windows(source: DataSource, model: Any, optimizer: Any) -> Callable[..., DynamicsData]:
    """Return the builder of the default windows."""
    if not isinstance(source, LogSource):
        return DynamicsData
    t = source.load().train[0].t
    stride = max(round(_STEP / float(t[1] - t[0])), 1)
    few = isinstance(optimizer, LeastSquares)
    pairs, steps = (_FEW_PAIRS, _LONG_WINDOW) if few else (_PAIRS, _WINDOW)
    batch = min(_BATCH, pairs)
    windows = partial(DynamicsData, pairs=pairs, steps=steps, stride=stride, batch_size=batch)
    if model == "subnet":
        return partial(windows, history=_HISTORY, steps=_LONG_WINDOW)
    return partial(windows, steps=_LONG_WINDOW) if model == "oscillators" else windows


def _same_data(source: DataSource, folder: Path, saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return the identity of the data; refuse data other than those of the run in the folder."""
    log.info("%s: loading data", source.name)
    with naming("data"):
        identity = data_identity(source)
    require_same_data(folder, saved.get(DATA, {}), source.name, identity, REPLACE)
    return identity


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


def _description(
    source: DataSource, model: Any, name: str | None, parts: Mapping[str, Any]
) -> dict[str, Any]:
    """Describe a training in Python; its trajectories are stored in the run folder."""
    factory = model.func if isinstance(model, partial) else model
    name = name or getattr(factory, "__name__", type(factory).__name__)
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
    return config | _model_description(model) | {key: described(x) for key, x in parts.items()}


def build_data(
    data: Callable[..., DynamicsData], source: DataSource, seed: int, batches: int
) -> DynamicsData:
    """Build the windows, with the seed of the training unless they have one."""
    seeds = {} if "seed" in getattr(data, "keywords", {}) else {"seed": seed}
    with naming("data"):
        return data(source=source, batches_per_epoch=batches, **seeds)


def _statistics(windows: DynamicsData, devices: int) -> Statistics:
    with naming("data"):
        if warning := too_long_for(windows.splits.train, windows.step, windows.source.labels):
            log.warning("%s: %s", windows.source.name, warning)
        if windows.batch_size % devices:
            raise ValueError(f"batch_size {windows.batch_size} is no multiple of {devices} devices")
        return windows.statistics


def _check_windows(model: Predictor, windows: DynamicsData) -> None:
    """Refuse windows without the momenta or the past that the model needs; warn of short ones."""
    if model.state == "qp" and windows.windows.p.shape[-1] == 0:
        raise ValueError(
            f"{windows.source.name} has no momenta p: set model.state=qv, or use model=lnn"
        )
    if model.input_history > windows.history:
        raise ValueError(
            f"the model uses {model.input_history} s before its start, but data.history is "
            f"{windows.history} s: set data.history={model.input_history}"
        )
    if model.past_steps > 20 * windows.steps:
        log.warning(
            f"the model sees {model.past_steps} steps of {windows.step:g} s before windows of "
            f"{windows.steps} steps: increase data.stride or data.steps, or reduce model.history"
        )


def _learner(
    model: ModelBuilder | Predictor,
    windows: DynamicsData,
    devices: int,
    seed: int,
    ensemble: int,
    parts: dict[str, Any],
) -> DynamicsLearner:
    """Build the model and its validation, and from other parts the LightningModule."""
    statistics = _statistics(windows, devices)
    with naming("validator"):
        rollouts = parts.pop("validator")(training_step=statistics.step)
        rollouts.check(stack_until(windows.splits.validation), windows.splits.train)
    with naming("model"):
        predictor = build_predictor(model, statistics, seed, ensemble)
        _check_windows(predictor, windows)
    check_known(predictor, windows.source)
    warn_of_structure(predictor, windows.source)
    return build_learner(predictor, statistics, rollouts, **parts)


def _start_from(run: Run, learner: DynamicsLearner, *, new: bool) -> None:
    """Start a new training from the weights of a run, and any fit from its covariance."""
    if new:
        _take_weights(learner.model, run)
    if isinstance(learner, LeastSquaresLearner):
        if run.covariance is None:
            raise ConfigError("start_from: the run has no covariance of its constants")
        learner.covariance = run.covariance


def _take_weights(model: Predictor, run: Run) -> None:
    trained = copy.deepcopy(run.model)
    set_output_limits(trained, {})
    if isinstance(model, KnownAndNetwork) and isinstance(trained, KnownMechanics):
        model = model.known
    try:
        model.load_state_dict(trained.state_dict())
    except RuntimeError as error:
        text = f"start_from: {run.folder} is of another model: {in_one_line(error)}"
        raise ConfigError(text) from error
    log.info("starting from the weights of %s", run.folder)


def _fit(
    trainer: L.Trainer,
    learner: DynamicsLearner,
    windows: DynamicsData,
    identity: dict[str, Any],
    checkpoint: Path | None,
    folder: Path,
) -> None:
    """Fit, write the results of the run to its folder, and log the validation error."""
    config, source = learner.hparams["config"], windows.source
    name, seed, pairs = config["name"], config["seed"], len(windows.windows)
    recorder = Recorder({"name": name, "seed": seed, "pairs": pairs, **provenance()}, identity)
    trainer.callbacks.insert(0, recorder)  # type: ignore[attr-defined]
    solver = learner if isinstance(learner, LeastSquaresLearner) else None
    last = folder / CHECKPOINTS / "last.ckpt"
    data: L.LightningDataModule = windows
    if isinstance(learner.model, Ensemble):
        data = EnsembleData(windows, learner.model.size)
    try:
        builds = solver or isinstance(learner.model, Ensemble)  # the optimizer, inside of fit
        with naming("optimizer") if builds else contextlib.nullcontext():
            trainer.fit(learner, data, ckpt_path=checkpoint, weights_only=True)
        if checkpoint is not None and not trainer.callback_metrics:  # ended just before its record
            trainer.validate(learner, data, verbose=False)
    except SystemExit as stop:  # Lightning's end of an interrupted training
        if solver and solver.result is not None:
            trainer.save_checkpoint(last, weights_only=False)
        raise KeyboardInterrupt from stop
    if solver and solver.result is not None:
        recorder.facts["stage"] = solver.result.stage
        assert isinstance(data, DynamicsData)
        runs, cutoff = data.splits.train, solver.solver.cutoff
        write_constants(learner.model, solver.result, source, folder, runs, cutoff)
    # Other processes have counted the steps of theirs.
    record = recorder.record(trainer, learner.model, read_checkpoint(last)["global_step"])
    finish(folder, record)
    error = record["validation"].get(VALIDATION_ERROR, float("nan"))
    diverged = record["validation"].get("val/diverged", 0)
    log.info(
        "%s seed %d: validation error %s over %s after %.0f s of training, in %s",
        *(name, seed, f"{diverged:g} diverged" if diverged else f"{error:.5f}"),
        *(learner.validator, record["training_seconds"], folder),
    )
