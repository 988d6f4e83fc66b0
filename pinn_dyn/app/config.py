"""Configurations: found, checked before anything runs, and turned into plain values."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import IntervalSweep
from hydra.errors import ConfigCompositionException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

# An installed package has its conf/ inside, a checkout beside the entry scripts.
_INSTALLED = Path(__file__).resolve().parents[1] / "conf"
CONF = _INSTALLED if _INSTALLED.is_dir() else _INSTALLED.parents[1] / "conf"


class ConfigError(ValueError):
    """The configuration cannot be used as it is; the message says what to change."""


def plain(cfg: DictConfig) -> dict[str, Any]:
    """The configuration as nested dicts, lists and values, all interpolations resolved.

    Raises:
        ConfigError: naming every value that is still missing.
    """
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        raise ConfigError(
            f"no value for {', '.join(missing)}: give it on the command line, as in "
            f"'{missing[0]}=...'"
        )
    values = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items()}


def misspelt_key(config_name: str, arguments: list[str]) -> str | None:
    """What is wrong with a key among command-line overrides, and what was probably meant.

    None if every key exists, or if Hydra itself will explain the error (a group's wrong option,
    say, for which it lists the right ones).
    """
    words = [word for word in arguments if "=" in word and not word.startswith("-")]
    try:
        overrides = []
        for word, parsed in zip(
            words, OverridesParser.create().parse_overrides(words), strict=True
        ):
            # Of a sweep the first choice stands for all, of an interval its start.
            value = parsed.value()
            if isinstance(value, IntervalSweep):
                word = f"{word.split('=')[0]}={value.start}"
            elif parsed.is_sweep_override():
                word = f"{word.split('=')[0]}={next(parsed.sweep_string_iterator())}"
            overrides.append(word)
    except OverrideParseException:
        return None
    with hydra.initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        try:
            hydra.compose(config_name, overrides=overrides)
        except ConfigCompositionException as error:
            key = getattr(error.__cause__, "full_key", None)
            if not key or "is not in struct" not in str(error.__cause__):
                return None
            groups = [o for o in overrides if "." not in o.split("=")[0] and _is_group(o)]
            known = _keys(hydra.compose(config_name, overrides=groups))
            close = difflib.get_close_matches(key, known, n=3, cutoff=0.6) or [
                name for name in known if name.split(".")[-1] == key.split(".")[-1]
            ]
            hint = f"did you mean {' or '.join(close[:3])}?" if close else "no key is like it."
            return (
                f"the configuration has no key '{key}': {hint} See all keys with "
                f"'python {config_name}.py --cfg job'."
            )
    return None


def _is_group(override: str) -> bool:
    return (CONF / override.split("=")[0].lstrip("+~")).is_dir()


def _keys(cfg: DictConfig) -> list[str]:
    def walk(values: dict[Any, Any], prefix: str) -> Iterator[str]:
        for key, value in values.items():
            yield f"{prefix}{key}"
            if isinstance(value, dict):
                yield from walk(value, f"{prefix}{key}.")

    values = OmegaConf.to_container(cfg)
    assert isinstance(values, dict)
    return list(walk(values, ""))
