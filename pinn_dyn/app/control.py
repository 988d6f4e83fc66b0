"""Control a robot by a learned model, as control.py does."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torch import Tensor

from pinn_dyn.app.build import build_law, build_reference, build_source
from pinn_dyn.app.config import ConfigError, checked
from pinn_dyn.app.control_results import write_results, write_stability
from pinn_dyn.app.parts import build_part
from pinn_dyn.app.provenance import write_provenance
from pinn_dyn.app.run_folder import load_run, write_config
from pinn_dyn.app.trust import packages
from pinn_dyn.control import (
    ClosedLoopRecord,
    Controller,
    DataRegion,
    Guarded,
    ModelBasedLaw,
    ProportionalDerivative,
    Reference,
    SetPoint,
    check_limits,
    close_loop,
    close_loop_continuous,
    export_law,
    model_report,
)
from pinn_dyn.data import DataSource
from pinn_dyn.data.whole import whole, write_whole
from pinn_dyn.ensembles import Ensemble
from pinn_dyn.evaluation.report import Origin, measured_model_report
from pinn_dyn.mechanics import MechanicalSystem, Predictor, double_copy
from pinn_dyn.systems import HasDomain, HasLimits

log = logging.getLogger(__name__)

_DOMAIN_SAMPLES = 101  # of a reference
MOST_INSTANTS = 1e8
"""Of all runs of a controller: some GB."""
# States per trajectory that a region of training data is drawn from.
_REGION_SAMPLES = 200


def control(cfg: DictConfig) -> float:
    """Close the loop of each controller; returns the RMS error of the learned one.

    Raises:
        ConfigError: on a run that is no mechanical model, or a part that does not fit the robot.
    """
    config = checked("control", cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    write_config(folder, config)
    torch.set_num_threads(config["threads"])
    run = load_run(Path(config["run"]), config["checkpoint"], packages(config.get("trust")))
    model = _one_model(run.model, config["member"])
    if not isinstance(model, MechanicalSystem):
        raise ConfigError(
            f"run: {run.folder} holds a black box ({run.config['model_name']}), which has no terms "
            "M, G and A for a control law: give a run of model=lnn or model=hnn"
        )
    if not model.input_affine:
        raise ConfigError(
            f"run: {run.folder} has a force that is not linear in the input (model/input=nonlinear "
            "or a load-dependent friction), and the control laws invert A(q): train with "
            "model/input=network, or another friction"
        )
    if model.has_residual:
        raise ConfigError(
            f"run: {run.folder} has a residual force (model/residual=network), which the "
            "control laws cannot invert: train without it"
        )
    learned = double_copy(model)
    source = build_source(run.config)
    origin = write_provenance(
        {run.config["name"]: run}, source, config, {"run": run.config}, folder
    )
    if source.system is None:
        return _report_without_truth(learned, source, folder, origin)

    robot = build_part("robot", {**run.config["dataset"]["system"], **config["robot"]})
    reference = build_reference(config, robot)
    q0, v0 = _initial_states(config, reference)
    for key, size in (("reference", reference(0.0).q.shape[-1]), ("initial_states", q0.shape[-1])):
        if size != robot.num_coordinates:
            raise ConfigError(
                f"{key} has {size} coordinates, expected {robot.num_coordinates}, as the robot has"
            )
    if isinstance(robot, HasLimits):
        with _errors_of("reference"):
            check_limits(reference, robot.q_low, robot.q_high, config["duration"], robot.v_max)
    _check_length(config, reference, len(q0))
    if isinstance(robot, HasDomain):
        moments = np.linspace(0.0, config["duration"], _DOMAIN_SAMPLES)
        wanted = [reference(float(t)).q.reshape(-1, q0.shape[-1]) for t in moments]
        visited = torch.cat([q0, *wanted]).numpy()
        with _errors_of("reference"):
            robot.check_domain(visited.min(0), visited.max(0))
    if not 0 <= config["trajectory"] < len(q0):
        raise ConfigError(
            f"trajectory is {config['trajectory']}, expected one of the {len(q0)} runs, 0 to "
            f"{len(q0) - 1}"
        )
    _check_box(config["stability"], robot)
    _check_learned(config)
    laws = {name: build_law(config, name, learned, source.system) for name in config["controllers"]}
    if config["export"] is not None:
        with _errors_of("export"):
            path = export_law(laws["learned"], Path(config["export"]))
        log.info("the learned law is in %s; docs/realtime.md says how to load it", path)
    if config["guard"].get("threshold") is not None:
        laws["learned"] = _guarded(laws, config, source)

    records: dict[str, ClosedLoopRecord] = {}
    for name, law in laws.items():
        records[name] = _close_loop(name, law, robot, reference, q0, v0, config)
        _write_record(records[name], folder / f"record_{name}.npz")
        for index, reason in enumerate(records[name].stopped):
            if reason:
                log.warning("%s, run %d was stopped: %s", name, index, reason)
    stability = None
    if config["stability"] is not None:
        with _errors_of("stability"):
            stability = write_stability(learned, robot, records["learned"], config, folder)
    return write_results(records, source, robot, reference, config, folder, stability, origin)


def _one_model(model: Predictor, member: int) -> Predictor:
    """Of an ensemble the member that is asked for; a single model is the only member of itself."""
    if isinstance(model, Ensemble):
        with _errors_of("run"):
            return model.member(member)
    if member != 0:
        raise ConfigError(f"member is {member}, but the run holds a single model: leave it out")
    return model


def _report_without_truth(
    learned: MechanicalSystem, source: DataSource, folder: Path, origin: Origin
) -> float:
    """Of a model of measured data, what can be said where nobody knows the truth."""
    q = torch.cat([item.q[:: _stride(item.q)] for item in source.load().train]).double()
    text = model_report(learned, q, region=f"the training data of {source.name}")
    write_whole(folder / "stability.md", text)
    print(text)
    title = f"{source.name}: learned model of measured data"
    page = measured_model_report(title=title, report=text, origin=origin)
    write_whole(folder / "report.html", page)
    log.info(
        "%s is measured data, there is no robot to close the loop with: what can be said of the "
        "model alone is in %s",
        source.name,
        folder / "stability.md",
    )
    return float("nan")


def _initial_states(config: dict[str, Any], reference: Reference) -> tuple[Tensor, Tensor]:
    """q0 and v0, ``(K, N)``: drawn from a box, or on the reference."""
    if config["initial_states"] is None:
        start = reference(0.0)
        shape = (-1, start.q.shape[-1])
        return start.q.double().reshape(shape), start.v.double().reshape(shape)
    # Another stream than the one that set points are drawn from, with the same seed.
    rng = np.random.default_rng([config["seed"], 1])
    box = build_part("initial_states", config["initial_states"])
    q0, v0 = box.draw(config["runs"], rng)
    return torch.from_numpy(q0), torch.from_numpy(v0)


def _check_learned(config: dict[str, Any]) -> None:
    """Refuse to look at a controller named learned where there is none."""
    if not config["controllers"]:
        raise ConfigError("controllers is empty, expected at least one")
    looks = {
        "export": config["export"] is not None,
        "guard.threshold": config["guard"].get("threshold") is not None,
        "stability": config["stability"] is not None,
    }
    for key, looked_at in looks.items():
        if looked_at and "learned" not in config["controllers"]:
            raise ConfigError(
                f"{key} is set, which looks at the controller 'learned', and there are "
                f"{', '.join(config['controllers'])} alone: set {key}=null"
            )


def _check_box(box: dict[str, Any] | None, robot: MechanicalSystem) -> None:
    """Refuse a stability region that does not fit the robot, before anything is run."""
    if box is None:
        return
    size = robot.num_coordinates
    for key in ("q_low", "q_high"):
        if len(box[key]) != size:
            raise ConfigError(
                f"stability.{key} is {box[key]}, expected {size} numbers, one for each "
                "coordinate of the robot"
            )
    if any(low > high for low, high in zip(box["q_low"], box["q_high"], strict=True)):
        raise ConfigError(
            f"stability.q_low is {box['q_low']}, expected at most stability.q_high, {box['q_high']}"
        )
    if isinstance(robot, HasDomain):
        with _errors_of("stability"):
            robot.check_domain(np.array(box["q_low"], float), np.array(box["q_high"], float))


def _check_length(config: dict[str, Any], reference: Reference, runs: int) -> None:
    """Refuse runs that no memory holds, or that end before their error is measured."""
    key = "samples_rate" if config["rate"] is None else "rate"
    duration, instants = config["duration"], config["duration"] * config[key] * runs
    if not instants <= MOST_INSTANTS:
        raise ConfigError(
            f"duration is {duration} s, {key} {config[key]} Hz and runs {runs}: {instants:.2g} "
            f"instants, expected at most {MOST_INSTANTS:.2g}"
        )
    if isinstance(reference, SetPoint) and config["settled_after"] > duration:
        raise ConfigError(
            f"settled_after is {config['settled_after']} s, expected at most duration, {duration} s"
        )


def _guarded(laws: dict[str, Controller], config: dict[str, Any], source: DataSource) -> Controller:
    """The learned law with an eye on its distance from the training data."""
    law = laws["learned"]
    if not isinstance(law, ModelBasedLaw):
        raise ConfigError(
            f"guard: controllers.learned is a {type(law).__name__}, expected one of the laws "
            "alone: leave out its observer, or the guard"
        )
    train = source.load().train
    fallback = None
    with _errors_of("guard"):
        if config["guard"].get("fallback"):
            gains = config["gains"]
            fallback = ProportionalDerivative(law.model, gains["position"], gains["velocity"])
        region = DataRegion(
            [item.q[:: _stride(item.q)] for item in train],
            [item.v[:: _stride(item.v)] for item in train],
            angles=getattr(law.model, "angles", ()),
        )
        return Guarded(law, fallback, region, threshold=config["guard"]["threshold"])


def _stride(samples: Tensor) -> int:
    return max(1, samples.shape[0] // _REGION_SAMPLES)


def _close_loop(
    name: str,
    law: Controller,
    robot: MechanicalSystem,
    reference: Reference,
    q0: Tensor,
    v0: Tensor,
    config: dict[str, Any],
) -> ClosedLoopRecord:
    """One controller on the robot, in continuous time or at a rate."""
    actuator = build_part("actuator", config["actuator"])
    sensor = build_part("sensor", {"seed": config["seed"], **config["sensor"]})
    motion = law, reference, q0, v0
    common = {
        "duration": config["duration"],
        "actuator": actuator,
        "progress": f"closing the loop: {name}",
    }
    with _errors_of(f"controllers.{name}"):
        if config["rate"] is None:
            if config["delay"] or np.any(sensor.q_noise) or np.any(sensor.v_noise):
                raise ValueError(
                    "rate is null, a law in continuous time, which has neither delay nor sensor "
                    "noise: give a rate, or set them to 0"
                )
            return close_loop_continuous(
                robot, *motion, samples_rate=config["samples_rate"], **common
            )
        plant = build_part("plant", config["plant"], robot)
        return close_loop(
            plant, *motion, rate=config["rate"], sensor=sensor, delay=config["delay"], **common
        )


def _write_record(record: ClosedLoopRecord, path: Path) -> None:
    arrays: dict[str, Any] = {
        **{name: getattr(record, name).numpy() for name in ("t", "q", "v", "u", "u_wanted")},
        **{f"{name}_ref": value.numpy() for name, value in record.reference._asdict().items()},
        **{name: value.numpy() for name, value in record.diagnostics.items()},
        "stopped": np.array([reason or "" for reason in record.stopped]),
    }
    with whole(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, **arrays)


@contextlib.contextmanager
def _errors_of(part: str) -> Iterator[None]:
    """Name the part of the configuration that an error is about."""
    try:
        yield
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(f"{part}: {error}") from error
