"""Configurations: found, checked before anything runs, and turned into plain values."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.override_parser.types import IntervalSweep
from hydra.errors import ConfigCompositionException, HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import (
    InterpolationToMissingValueError,
    MissingMandatoryValue,
    OmegaConfBaseException,
)

from pinn_dyn.app.keys import GIVEN, KEYS, places
from pinn_dyn.app.schema import ConfigError, check, short_form
from pinn_dyn.app.schema import arguments as arguments_of
from pinn_dyn.app.words import OVERRIDE, check_words, chooses, parsed, refused, said
from pinn_dyn.spelling import did_you_mean

# An installed package has its conf/ inside, a checkout beside the entry scripts.
_INSTALLED = Path(__file__).resolve().parents[1] / "conf"
CONF = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parents[1] / "conf"


_OPEN = ("filter", "robot", "thresholds")  # mappings with keys of the user's choice
_CONFIG_DIR = re.compile(r"(?:--config-dir|-cd)[ =](\S+)")  # a user's own groups


def config_folder(command: str) -> Path:
    """Where the configuration of a command and its groups are: control has a folder of its own."""
    own = CONF / command
    return own if own.is_dir() else CONF


def plain(cfg: DictConfig) -> dict[str, Any]:
    """The configuration as nested dicts, lists and values, all interpolations resolved.

    Raises:
        ConfigError: naming every value that is still missing, or one that cannot be computed.
    """
    try:
        values = OmegaConf.to_container(cfg, resolve=True, throw_on_missing=True)
    except (MissingMandatoryValue, InterpolationToMissingValueError) as error:
        missing = sorted(OmegaConf.missing_keys(cfg))
        raise ConfigError(
            f"no value for {', '.join(missing)}: give it on the command line, as in "
            f"'{missing[0]}=...'"
        ) from error
    except OmegaConfBaseException as error:
        raise ConfigError(said(CONF, error)) from error
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def checked(command: str, cfg: DictConfig) -> dict[str, Any]:
    """The configuration of a command as plain values, of the right types and in range.

    Raises:
        ConfigError: naming the key that is missing, unknown or of the wrong kind.
    """
    config = plain(cfg)
    check(command, config)
    return config


def composed(command: str, overrides: list[str]) -> dict[str, Any]:
    """The checked configuration of a command with the words of a command line, as plain values.

    Raises:
        ConfigError: as :func:`checked` and :func:`completed`, or with what Hydra said.
    """
    words = completed(command, overrides)
    folder = str(config_folder(command))
    try:
        with hydra.initialize_config_dir(version_base="1.3", config_dir=folder):
            return checked(command, hydra.compose(command, overrides=words))
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(said(config_folder(command), error)) from error


def completed(command: str, arguments: list[str]) -> list[str]:
    """Command-line arguments, with a ``++`` before keys that exist but stand in no YAML.

    A YAML names the arguments that are usually changed. What else a class takes may be given as
    well, as in ``loss.huber=0.01``, and so may the optional keys of a command, as ``resume=...``.

    Raises:
        ConfigError: on a key that does not exist, with those that were probably meant. What Hydra
            itself explains, a group's wrong option say, is left to it.
    """
    words = [word for word in arguments if OVERRIDE.match(word)]
    check_words(command, config_folder(command), parsed(words))
    while (unknown := _unknown_key(command, arguments)) is not None:
        key, known = unknown
        before = arguments
        place, _, name = key.rpartition(".")
        exists = name in _takes(command, known, place)
        arguments = [
            f"++{x}"
            # Also of a mapping, as dataset.test={seconds: 1, piece: 1}.
            if _is_unlisted(command, known, x) or (exists and x.startswith(f"{place}={{"))
            else x
            for x in before
        ]
        if arguments == before:
            if key.startswith("hydra."):
                raise ConfigError(
                    f"Hydra has no key '{key}': see all with 'python {command}.py --cfg hydra', "
                    f"and put a + before one that is new, as '+{key}=...'"
                )
            taken = _takes(command, known, place)
            also = (f"{place}.{one}" if place else one for one in taken)
            there = (one for one, _ in places(known) if one and "[" not in one)
            keys = list(dict.fromkeys([*there, *also]))
            if key in keys:  # under a part that another word takes away
                raise ConfigError(f"there is no {place} for '{key}' with {' '.join(before)}")
            close = did_you_mean(key, [one for one in keys if one not in GIVEN])
            inside = _at(known, place)
            if place and inside is None and place in keys:
                close = f": {place} is null, give {place}={{{name}: ...}}."
            elif place and isinstance(inside, dict) and not taken:
                close = f"{close.rstrip('?')}? To add it, put a + before it."
            if not close and (same := [k for k in keys if k.split(".")[-1] == name]):
                close = f": did you mean {' or '.join(same[:3])}?"
            raise ConfigError(
                f"the configuration has no key '{key}'{close or ': no key is like it.'} See all "
                f"keys with 'python {command}.py --cfg job'."
            )
    return arguments


def _is_unlisted(command: str, known: dict[str, Any], word: str) -> bool:
    """Whether an argument sets a key that exists, but stands in no YAML."""
    key, equals, _ = word.partition("=")
    if not equals or not re.fullmatch(r"[A-Za-z]\w*(\.\w+)*", key):
        return False
    path, _, name = key.rpartition(".")
    place = _at(known, path)
    if not isinstance(place, dict) or name in place:
        return False
    return path in _OPEN or name in _takes(command, known, path)


def _at(known: Any, path: str) -> Any:
    """What is at a place of the configuration; None if there is nothing."""
    for name in path.split(".") if path else ():
        known = known.get(name) if isinstance(known, dict) else None
    return known


def _takes(command: str, known: dict[str, Any], path: str) -> dict[str, Any]:
    """What may be set at a place of the configuration."""
    if not path:
        return KEYS[command]
    place = _at(known, path)
    if isinstance(place, dict) and "_target_" in place:
        return arguments_of(place["_target_"], path)
    above, _, name = path.rpartition(".")
    return short_form(_takes(command, known, above).get(name))


def _unknown_key(command: str, arguments: list[str]) -> tuple[str, dict[str, Any]] | None:
    """The first key of the overrides that is in no YAML, and the configuration without it."""
    words = [word for word in arguments if OVERRIDE.match(word)]
    if folders := _CONFIG_DIR.findall(" ".join(arguments)):
        words.append(f"hydra.searchpath=[file://{Path(folders[0]).resolve()}]")
    overrides = []
    read = parsed(words)
    for word, override in zip(words, read, strict=True):
        # Of a sweep the first choice stands for all, of an interval its start.
        value = override.value()
        if isinstance(value, IntervalSweep):
            word = f"{word.split('=')[0]}={value.start}"
        elif override.is_sweep_override():
            word = f"{word.split('=')[0]}={next(override.sweep_string_iterator())}"
        overrides.append(word)
    folder = config_folder(command)
    places = [word for word in overrides if word.startswith("hydra.searchpath=")]
    groups = [
        *places,
        *(word for word, one in zip(overrides, read, strict=True) if chooses(folder, one)),
    ]
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(folder)):
        try:
            hydra.compose(command, overrides=overrides)
        except MissingConfigException as error:
            raise ConfigError(said(folder, error)) from error
        except ConfigCompositionException as error:
            key = getattr(error.__cause__, "full_key", None)
            if not key or "is not in struct" not in str(error.__cause__):
                return None
            return key, _unresolved(command, groups)
        except (ValueError, TypeError, AttributeError, LookupError) as error:
            below = _below_a_value(_unresolved(command, groups), overrides)
            raise ConfigError(below or refused(words, error)) from error
    return None


def _unresolved(command: str, overrides: list[str]) -> dict[str, Any]:
    return cast(dict[str, Any], OmegaConf.to_container(hydra.compose(command, overrides=overrides)))


def _below_a_value(known: dict[str, Any], words: list[str]) -> str | None:
    """Which word gives a key to something that has none."""
    for word in words:
        path = word.split("=")[0].lstrip("+~")
        while "." in path:
            path = path.rpartition(".")[0]
            value = _at(known, path)
            if value is not None and not isinstance(value, dict):
                return f"{word}: {path} is {value!r}, which has no keys: give {path}=..."
    return None
