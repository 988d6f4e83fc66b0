"""The words of a command line, before Hydra composes a configuration of them, and what it says."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path
from typing import Any

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, IntervalSweep, Override, RangeSweep
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from pinn_dyn.app.keys import KEYS
from pinn_dyn.app.schema import ConfigError
from pinn_dyn.spelling import did_you_mean

OVERRIDE = re.compile(r"~|[^-=].*=", re.DOTALL)
_RAISED = re.compile(r"\w+ raised while resolving interpolation: ")
# Beside what OmegaConf says: what to do about it.
_INSTEAD = {
    "Interpolation key": ": give it, or leave out what takes it away",
    "Environment variable": ": set it, or give another value",
    "merge DictConfig with ListConfig": ": give [...] for a list, {...} for keys",
    "merge incompatible container types": ": give [...] for a list, {...} for keys",  # 2.4
    "HydraConfig was not set": ": where the key is there already, leave out the + before it",
    "extraneous input": ": expected ${key}, as ${seed}",
}
MOST_JOBS = 100_000
"""Of a sweep."""


def command_line(words: list[str] | None = None) -> str:
    """The command that this process was started with, or with other words, for a shell."""
    program = Path(sys.argv[0]).name
    start = ["python", program] if program.endswith(".py") else [program]
    return shlex.join([*start, *(sys.argv[1:] if words is None else words)])


def refused(words: list[str], error: BaseException) -> str:
    """Which settings of Hydra itself an error may be about that is raised outside of our code."""
    settings = [word for word in words if word.lstrip("+~").startswith("hydra")]
    return (
        f"Hydra cannot start with {', '.join(settings) or 'these words'}: {type(error).__name__}: "
        f"{' '.join(str(error).split())}"
    )


def parsed(words: list[str]) -> list[Override]:
    """Overrides of a command line.

    Raises:
        ConfigError: on a word that is none.
    """
    try:
        return OverridesParser.create().parse_overrides(words)
    except OverrideParseException as error:
        raise ConfigError(
            f"{error.override!r} cannot be read: expected key=value, brackets and braces closed, "
            "and in quotes what has other signs than plain letters, digits and ._-/, as "
            "\"name='arm, é'\""
        ) from error


def check_words(command: str, folder: Path, overrides: list[Override]) -> None:
    """Refuse what Hydra takes apart in a traceback, or lets through though it helps nobody.

    Raises:
        ConfigError: on a top-level key that is taken away, a group that is given something else
            than the name of an option, a sweep over nothing or without end, or an option that is
            given to the key of its group.
    """
    for override in overrides:
        word, key = str(override.input_line), override.key_or_group
        if override.is_delete():
            if key in KEYS[command]:
                raise ConfigError(
                    f"'{word}' takes away a key that {command}.py needs: leave it out, or give "
                    f"another value, as {key}=..."
                )
            continue
        if override.is_sweep_override() and (count := _jobs(override)) not in range(1, MOST_JOBS):
            raise ConfigError(
                f"'{word}' is a sweep over {count:.6g} values, expected 1 to {MOST_JOBS - 1}"
            )
        group = key.replace(".", "/")
        if group != key and (folder / group).is_dir():
            for value in _values(override):
                if isinstance(value, str) and value in _options(folder, group):
                    raise ConfigError(
                        f"{word!r} gives {key} a text, where it is an object: to choose the option "
                        f"write {group}={value}"
                    )
        if key == "hydra" or is_group(folder, word):
            for value in _values(override):
                items = value if isinstance(value, list) else [value]
                if not items or not all(map(_names, items)):
                    raise ConfigError(
                        f"{key} is {value!r}, expected the name of an option: "
                        f"{', '.join(_options(folder, key)) or 'leave it out'}"
                    )


def _jobs(override: Override) -> float:
    """How many values a sweep has."""
    value = override.value()
    if isinstance(value, ChoiceSweep):
        return len(value.list)
    if isinstance(value, RangeSweep) and None not in (value.start, value.stop):
        return max(0, -(-(value.stop - value.start) // (value.step or 1)))  # type: ignore[operator]
    return 1


def _names(item: Any) -> bool:
    """Whether a value can name an option, or hold the keys of one."""
    return isinstance(item, dict) or (isinstance(item, str) and "${" not in item)


def _values(override: Override) -> list[Any]:
    value = override.value()
    if isinstance(value, ChoiceSweep):
        return [str(item) for item in value.list]
    if isinstance(value, (IntervalSweep, RangeSweep)):
        return [value.start]
    return [value]


def chooses(folder: Path, override: Override) -> bool:
    """Whether an override names options of a group, not values of its keys."""
    return is_group(folder, str(override.input_line)) and not any(
        isinstance(value, dict) for value in _values(override)
    )


def is_group(folder: Path, override: str) -> bool:
    """Whether an override chooses an option of a group in a folder of configurations."""
    name = override.split("=")[0].lstrip("+~").split("@")[0]
    return bool(name) and "." not in name and (folder / name).is_dir()


def _options(folder: Path, group: str) -> list[str]:
    """The options of a group, also those in folders of it."""
    place = folder / group
    found = (path.relative_to(place).with_suffix("") for path in place.rglob("*.yaml"))
    return sorted(path.as_posix() for path in found)


def no_option(folder: Path, error: MissingConfigException) -> str:
    """What an option may have meant that does not exist."""
    group, _, choice = str(error.missing_cfg_file).rpartition("/")
    group = group.partition("//")[0]  # of an option that is a path
    while group and not (folder / group).is_dir() and not error.options:
        group, _, above = group.rpartition("/")  # of an experiment in a folder
        choice = f"{above}/{choice}"
    options = sorted(error.options or _options(folder, group))
    if not group or not options:
        return str(error).splitlines()[0]
    builds = [one for one in options if choice and choice.lower() in _class(folder / group, one)]
    meant = did_you_mean(choice, options)
    if builds:
        meant = f": did you mean {' or '.join(builds)}?"
    return (
        f"'{error.missing_cfg_file}' does not exist{meant or '.'} Options of {group}: "
        f"{', '.join(options)}"
    )


def _class(folder: Path, option: str) -> str:
    """The name of the class that an option builds, in small letters."""
    path = folder / f"{option}.yaml"
    values = yaml.safe_load(path.read_text()) if path.is_file() else None
    target = str(values.get("_target_", "")) if isinstance(values, dict) else ""
    return target.rsplit(".", 1)[-1].lower()


def said(folder: Path, error: HydraException | OmegaConfBaseException) -> str:
    """What Hydra says about a configuration, without what only its authors need."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        return no_option(folder, error)
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    key = getattr(cause, "full_key", None)
    lines = [f"{key}: {str(cause).splitlines()[0]}" if key else str(error).strip()]
    lines[0] = _RAISED.sub("", lines[0])
    for piece, instead in _INSTEAD.items():
        if key and piece in lines[0]:
            lines[0] += instead
    if cause is not error:
        lines[:0] = str(error).splitlines()[:1]
    return "\n".join(lines).replace("\\'", "'")
