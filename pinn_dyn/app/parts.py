"""Builds one part of a configuration; every call of Hydra's ``instantiate`` is in this file."""

from __future__ import annotations

import re
from functools import partial
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from lightning.fabric.utilities.exceptions import MisconfigurationException

from pinn_dyn.app.keys import KEYS, Part, places
from pinn_dyn.app.schema import ConfigError, check_value

_HINTS = KEYS["control"] | KEYS["train"] | {"robot": Part}
_REFUSALS = (ValueError, TypeError, InstantiationException, MisconfigurationException)
_MISSING = re.compile(r"(\w+)(?:\.__init__)?\(\) missing \d+ required [\w-]+ arguments?: (.*)")


def build_part(
    name: str, config: dict[str, Any], /, *given: Any, partial_: bool = False, **extra: Any
) -> Any:
    """Instantiate a part of the configuration; its own error message comes first.

    Args:
        name: its place.
        config: its ``_target_`` and arguments.
        given: arguments that the program adds.
        partial_: whether arguments are added later.
        extra: arguments by name that the program adds.

    Raises:
        ConfigError: naming the part, if its keys are not arguments of its constructor, or with what
            its constructor said.
    """
    check_value(name, config, _HINTS.get(name, Part))
    later = bool(partial_ or given or extra)
    try:
        # Plain lists and dicts reach the constructors: no room below knows a config object.
        built = instantiate({**config, "_partial_": later}, _convert_="all")
        if isinstance(built, partial):  # those of Hydra 1.4 cannot be sent to another process
            built = partial(built.func, *built.args, **built.keywords)
        return built if partial_ or not later else built(*given, **extra)
    except Exception as error:  # what a configuration names may raise anything
        # Hydra wraps what a constructor said.
        wrapped = isinstance(error, InstantiationException) and error.__cause__
        raise ConfigError(f"{name}: {_said(name, config, wrapped or error)}") from error


def _said(name: str, config: dict[str, Any], error: BaseException) -> str:
    """What a constructor said, and what to do about it."""
    if found := _MISSING.search(str(error)):
        builder, keys = found.groups()
        place = next((one for one, part in places(config, name) if _is_of(part, builder)), name)
        key = re.findall(r"'(\w+)'", keys)[0]
        return (
            f"{keys} of {place} is missing: give {place}.{key}=..., or leave out the "
            f"~{place}.{key} that took it away"
        )
    if isinstance(error, _REFUSALS):
        return str(error)
    if isinstance(error, MemoryError):
        return "there is not enough memory: choose smaller sizes"
    return f"cannot be built with these values: {type(error).__name__}: {error}"


def _is_of(part: Any, builder: str) -> bool:
    """Whether this is a part that names a class."""
    return isinstance(part, dict) and str(part.get("_target_")).rsplit(".", 1)[-1] == builder
