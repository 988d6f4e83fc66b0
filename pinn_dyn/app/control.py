"""The command control.py: close the loop between a trained model and its robot."""

from __future__ import annotations

import inspect
import logging
import pkgutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torch import Tensor

from pinn_dyn.app.config import checked
from pinn_dyn.app.control_results import write_results
from pinn_dyn.control import DataRegion, Guarded, Pipeline, Reference, Stage, export_law
from pinn_dyn.data import DataSource, SimulationError
from pinn_dyn.evaluation import close_loops
from pinn_dyn.evaluation.learned_terms import term_conditions
from pinn_dyn.mechanics import MechanicalSystem, Predictor, double_copy
from pinn_dyn.models import CoupledOscillators
from pinn_dyn.run.configuration.build import ConfigError, build_part
from pinn_dyn.run.configuration.trust import packages
from pinn_dyn.run.export import ranges_of
from pinn_dyn.run.provenance import write_provenance
from pinn_dyn.run.run import Run
from pinn_dyn.run.run_folder import load_run, write_config

log = logging.getLogger(__name__)

_REGION_SAMPLES = 200  # states per trajectory that a region of training data is drawn from


def control(cfg: DictConfig) -> float:
    """Close the loop of each controller; return the RMS error of the first controller.

    Raises:
        SimulationError: after all results are written, if a run of the first controller diverged.
    """
    config = checked("control", cfg)
    folder = Path(HydraConfig.get().runtime.output_dir)
    write_config(folder, config)
    torch.set_num_threads(config["threads"])
    run = load_run(Path(config["run"]), config["checkpoint"], packages(config.get("trust")))
    try:
        return _close_loops(run, config, folder)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _close_loops(run: Run, config: dict[str, Any], folder: Path) -> float:
    source = run.source
    learned = _learned_system(run, config)
    _require_learned_law(config, source)
    if source.system is None:
        return _without_robot(learned, run, config, folder)
    runs, configurations = {run.config["name"]: run}, {"run": run.config}
    origin = write_provenance(runs, source, config, configurations, folder)
    robot = build_part("robot", {**run.config["dataset"]["system"], **config["robot"]})
    reference = build_reference(config, robot)
    q0, v0 = _initial_states(config)
    count = len(reference(0.0).q.reshape(-1, robot.num_coordinates) if q0 is None else q0)
    if config["trajectory"] >= count:
        raise ConfigError(f"trajectory is {config['trajectory']}, expected 0 to {count - 1}")
    laws = {name: _law(name, run, config, learned, source.system) for name in config["controllers"]}
    if config["export"]:
        _export(laws[config["exported_law"]], run, config)
    sensor = build_part("sensor", {"seed": config["seed"], **config["sensor"]})
    noisy = np.any(sensor.q_noise) or np.any(sensor.v_noise)
    result = close_loops(
        laws,
        reference,
        robot,
        q0=q0,
        v0=v0,
        plant=build_part("plant", config["plant"], robot) if config["plant"] else None,
        actuator=build_part("actuator", config["actuator"]),
        sensor=sensor if noisy else None,
        progress=True,
        **{
            key: config[key]
            for key in ("duration", "rate", "samples_rate", "dead_time", "settled_after")
        },
    )
    for name, record in result.records.items():
        for index, reason in enumerate(record.stopped):
            if reason:
                log.warning("%s, run %d was stopped: %s", name, index, reason)
    error = write_results(result, source, robot, reference, config, folder, origin)
    first, record = next(iter(result.records.items()))
    if reasons := [reason for reason in record.stopped if reason]:
        raise SimulationError(
            f"{first}: {len(reasons)} of {len(record.stopped)} runs were stopped: {reasons[0]}; "
            "reduce the gains, or raise the rate"
        )
    return error


def _require_learned_law(config: dict[str, Any], source: DataSource) -> None:
    """Refuse keys that would be ignored without the learned law, or without a robot."""
    is_guarded = config["guard"].get("threshold") is not None
    if source.system is None and is_guarded and not config["export"]:
        raise ConfigError(f"guard: {source.name} has no simulated robot: leave the key out")
    if "learned" not in config["controllers"] and is_guarded:
        raise ConfigError("guard: needs the controller 'learned': do not remove it")
    law = config["exported_law"]
    if config["export"] and config["controllers"].get(law, {}).get("terms") != "learned":
        parts = config["controllers"].items()
        learned_names = [name for name, part in parts if part["terms"] == "learned"]
        raise ConfigError(
            f"export: exported_law is {law!r}, expected a controller with learned terms: "
            f"{', '.join(learned_names) or 'do not remove them all'}"
        )


def _without_robot(
    learned: MechanicalSystem | CoupledOscillators, run: Run, config: dict[str, Any], folder: Path
) -> float:
    """Export the law on a model of measured data, and write how well it is conditioned."""
    source = run.source
    if config["export"]:
        _export(_law(config["exported_law"], run, config, learned, learned), run, config)
    if isinstance(learned, CoupledOscillators):
        if not config["export"]:
            raise ConfigError(f"{source.name} has no simulated robot: export the law, export=law.c")
        return float("nan")
    q = torch.cat([_thinned(item.q) for item in source.load().train])
    table = term_conditions(learned, q)
    table.to_csv(folder / "conditions.csv", index=False)
    print(table.describe().loc[["min", "50%", "max"]].to_string(float_format="{:.3g}".format))
    log.info(
        "%s is measured data without a simulated robot, so no loop is closed; the table over the "
        "training data is in %s. M and D must be positive definite, and A well conditioned",
        source.name,
        folder / "conditions.csv",
    )
    return float("nan")


def _law(
    name: str,
    run: Run,
    config: dict[str, Any],
    learned: MechanicalSystem | CoupledOscillators,
    truth: MechanicalSystem | CoupledOscillators,
) -> Pipeline:
    """Build a law with its observer, guard, limits and dead time, for loop and export."""
    law = build_law(config, name, learned, truth)
    guarded = {"learned", config["exported_law"]} if config["export"] else {"learned"}
    if config["guard"].get("threshold") is not None and name in guarded:
        law = _guarded(law, config, run.source)
    actuator = build_part("actuator", config["actuator"])
    return Pipeline(law, 1 / config["rate"], actuator=actuator, dead_time=run.input_delay)


def _export(law: Pipeline, run: Run, config: dict[str, Any]) -> None:
    try:
        path = export_law(
            law,
            config["export"],
            real=config["export_real"],
            about={"q": run.labels, "u": run.input_labels},
            ranges=ranges_of(run.statistics),
        )
    except (TypeError, RuntimeError, ImportError) as error:
        raise ConfigError(f"export={config['export']}: {error}") from error
    log.info("%s holds the law; docs/realtime.md says how to call it", path)


def _thinned(values: Tensor) -> Tensor:
    return values[:: max(1, len(values) // _REGION_SAMPLES)]


def _learned_system(run: Run, config: dict[str, Any]) -> MechanicalSystem | CoupledOscillators:
    model = run.model
    if isinstance(model, CoupledOscillators):
        return double_copy(model).requires_grad_(False)
    if not isinstance(model, MechanicalSystem):
        raise ConfigError(
            f"{run.folder} holds a black box ({run.config['model_name']}), which has no terms "
            "M, G and A for a control law. controllers=latent takes oscillators. For other laws, "
            "give a run of model=lnn or model=hnn"
        )
    if not model.num_inputs:
        raise ConfigError(f"{run.folder}: the model has no inputs, so no control law can move it")
    return double_copy(model)


def _initial_states(config: dict[str, Any]) -> tuple[Tensor | None, Tensor | None]:
    if config["initial_states"] is None:
        return None, None
    # A different stream from that of the set points, with the same seed.
    rng = np.random.default_rng([config["seed"], 1])
    q0, v0 = build_part("initial_states", config["initial_states"]).draw(config["runs"], rng)
    return torch.from_numpy(q0), torch.from_numpy(v0)


def _guarded(law: Stage, config: dict[str, Any], source: DataSource) -> Stage:
    train = source.load().train
    q, v = ([_thinned(getattr(item, name)) for item in train] for name in ("q", "v"))
    region = DataRegion(q, v, angles=getattr(law.model, "angles", source.angles))
    return Guarded(law, region, **config["guard"])


def build_reference(config: dict[str, Any], robot: MechanicalSystem) -> Reference:
    """Build ``config["reference"]``; one that needs the robot's kinematics gets the robot."""
    part = config["reference"]
    return build_part("reference", part, *([robot] if part.get("_partial_") else []))


def build_law(config: dict[str, Any], name: str, learned: Predictor, truth: Predictor) -> Stage:
    """Build one of ``config["controllers"]`` on the terms that it names, with its observer."""
    part = config["controllers"][name]
    model = learned if part["terms"] == "learned" else truth
    accepted = inspect.signature(pkgutil.resolve_name(part["law"]["_target_"])).parameters
    gains = {f"{key}_gain": value for key, value in config["gains"].items()}
    gains = {key: value for key, value in gains.items() if key in accepted}
    law = build_part(f"controllers.{name}.law", {**gains, **part["law"]}, model)
    if part.get("observer") is None:
        return law
    return build_part(f"controllers.{name}.observer", part["observer"], law)
