"""Configurations: composed by Hydra, and checked before anything runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from pinn_dyn.app.settings import SETTINGS
from pinn_dyn.run.configuration.defaults import defaults, even_validations
from pinn_dyn.run.configuration.validation import (
    ConfigError,
    check_arguments,
    check_keys,
    check_value,
)
from pinn_dyn.wording import did_you_mean

if TYPE_CHECKING:
    from pinn_dyn.data import DataSource

# An installed package has its conf/ inside, a checkout beside the entry scripts.
_INSTALLED = Path(__file__).resolve().parents[1] / "conf"
_RUNS = {"evaluate": "runs=[{}]", "gather": "runs=[{}]", "control": "run={}"}
CONF = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parents[1] / "conf"


# The name of an experiment, or else the last two folders of the path of a run.
OmegaConf.register_new_resolver(
    "experiment_or_run",
    lambda name, run: name or "/".join(Path(run).absolute().parts[-2:]),
    replace=True,
)


def _default(key: str, kind: str = "", *, _root_: DictConfig) -> Any:
    """Return the default of a key of train.py; ``kind`` is ``log`` for windows as of a log."""
    parts = [f"{name}._target_" for name in ("model", "dataset", "optimizer")]
    paths = [str(OmegaConf.select(_root_, part)) for part in parts]
    model, source, optimizer = (path.rpartition(".")[2] for path in paths)
    on_log = kind == "log" or source == "LogSource"
    value = defaults(model, on_log=on_log, least_squares=optimizer == "LeastSquares")[key]
    steps = OmegaConf.select(_root_, "trainer.steps") if key == "trainer.validations" else None
    return even_validations(steps, value) if isinstance(steps, int) else value


OmegaConf.register_new_resolver("default", _default, replace=True)


def config_folder(command: str) -> Path:
    """Return the folder with the configuration of a command: control.py has its own."""
    folder = CONF / command
    return folder if folder.is_dir() else CONF


def completed(command: str, overrides: Sequence[str]) -> list[str]:
    """Put ``++`` before every override of a value, so that keys in no YAML can be set as well.

    Words without ``=`` are paths of run folders: they become the value of ``runs`` or ``run``.
    """
    folder = config_folder(command)
    paths = [text for text in overrides if "=" not in text and not text.startswith("~")]
    if paths and command in _RUNS:
        text = ",".join(f"'{path}'" for path in paths)
        overrides = [x for x in overrides if x not in paths] + [_RUNS[command].format(text)]
    matches = [re.match(r"(?!hydra\.)([A-Za-z]\w*(?:\.\w+)*)=", text) for text in overrides]
    return [
        f"++{text}" if match and not (folder / match[1]).is_dir() else text
        for text, match in zip(overrides, matches, strict=True)
    ]


def resolved(cfg: DictConfig) -> dict[str, Any]:
    """Convert a configuration to nested dicts, lists and values, with interpolations resolved."""
    try:
        values = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise ConfigError(explained(error)) from error
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def checked(command: str, cfg: DictConfig | dict[str, Any]) -> dict[str, Any]:
    """Return the configuration of a command as plain values, without mistakes.

    Raises:
        ConfigError: with a line for each key that is missing or unknown, or has a wrong value.
    """
    config = cfg if isinstance(cfg, dict) else resolved(cfg)
    check_keys(SETTINGS[command], config)
    trainer = config.get("trainer")
    if isinstance(trainer, dict) and trainer.get("_target_") == "lightning.Trainer":
        check_value("trainer", trainer)  # before the import of Lightning
    check_arguments(SETTINGS[command], config)
    return config


def composed(
    command: str, overrides: Sequence[str], config_dir: str | None = None
) -> dict[str, Any]:
    """Compose and check the configuration of a command; of a sweep the first value counts.

    ``config_dir`` is a folder with further options of groups. A ConfigError is that of
    :func:`checked`, has the message of Hydra, or names an option that the shipped one hides.
    """
    options = Path(config_dir or "").resolve()
    search_path = [f"hydra.searchpath=[file://{options}]"] if config_dir else []
    folder, before = Path(config_folder(command)), HydraConfig.instance().cfg
    try:
        with hydra.initialize_config_dir(version_base="1.3", config_dir=str(folder)):
            texts = [*search_path, *_first_of_sweeps(completed(command, overrides))]
            try:
                cfg = hydra.compose(command, overrides=texts, return_hydra_config=True)
            except (ValueError, TypeError, AttributeError) as error:  # of Hydra, without a message
                raise ConfigError(f"Hydra cannot use {' '.join(overrides)}: {error}") from error
            HydraConfig.instance().set_config(cfg)  # resolves ${hydra:...}
            for group, option in cfg.hydra.runtime.choices.items() if config_dir else ():
                file = Path(str(group).partition("@")[0], f"{option}.yaml")
                if (options / file).is_file() and (folder / file).is_file() and options != folder:
                    raise ConfigError(f"{options / file} is hidden by {folder / file}: rename it")
            with open_dict(cfg):
                del cfg["hydra"]
            return checked(command, cfg)
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(explained(error)) from error
    finally:
        HydraConfig.instance().cfg = before


def _first_of_sweeps(overrides: list[str]) -> list[str]:
    first = []
    for text, override in zip(
        overrides, OverridesParser.create().parse_overrides(overrides), strict=True
    ):
        value = override.value()
        if isinstance(value, IntervalSweep):
            text = f"{text.split('=')[0]}={value.start}"
        elif override.is_sweep_override():
            text = f"{text.split('=')[0]}={next(override.sweep_string_iterator(), 'null')}"
        first.append(text)
    return first


def explained(error: HydraException | OmegaConfBaseException) -> str:
    """Return the message of Hydra in one line, with the closest option of a group."""
    if isinstance(error, MissingConfigException) and error.options:
        group, _, option = str(error.missing_cfg_file).rpartition("/")
        options = ", ".join(error.options)
        hint = did_you_mean(option, error.options)
        return f"'{group}/{option}' does not exist{hint or '.'} Options of {group}: {options}"
    return " ".join(str(error).partition("Config search path")[0].split())


def dataset(name: str, **settings: Any) -> DataSource:
    """Build a data set of ``conf/dataset``, such as ``dataset("soft_arm_1", duration=4.0)``.

    ``settings`` replace arguments of the file ``<name>.yaml``.
    """
    from pinn_dyn.run.configuration.build import (
        build_source,  # imports PyTorch, which --help does not need
    )

    overrides = [f"dataset={name}", *(f"dataset.{key}={x}" for key, x in settings.items())]
    return build_source(composed("train", overrides))
