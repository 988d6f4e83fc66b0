"""What a configuration may hold: types of the top-level keys here, those of a part by its class.

A part is a mapping with a ``_target_``; its keys are the arguments of that constructor, and the
constructor's annotations are their types. ``RANGES`` adds what numbers of a name must keep to.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import difflib
import importlib
import inspect
import math
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints


class ConfigError(ValueError):
    """The configuration cannot be used as it is; the message says what to change."""


class Part(NamedTuple):
    """Stands for an object that is built: a mapping with a ``_target_``."""


class Range(NamedTuple):
    """Numbers from ``low`` to ``high``, or above ``low`` alone."""

    low: float
    high: float = math.inf
    above: bool = False

    def __contains__(self, value: object) -> bool:
        assert isinstance(value, (int, float))
        return (value > self.low if self.above else value >= self.low) and value <= self.high

    def __str__(self) -> str:
        if self.high < math.inf:
            return f"from {self.low:g} to {self.high:g}"
        return f"above {self.low:g}" if self.above else f"of at least {self.low:g}"


Count = Annotated[int, Range(1)]
Index = Annotated[int, Range(0)]
Seconds = Annotated[float, Range(0, above=True)]
MOST_MEMBERS = 1000
Threads = Annotated[int, Range(1, 512)]
Names = str | Sequence[str]

KEYS: dict[str, dict[str, Any]] = {
    "train": {
        "name": str,
        "model_name": str,
        "seed": Annotated[int, Range(0, 2**32 - 1)],
        "compile": bool | Literal["auto"],
        "ensemble": Annotated[int, Range(1, MOST_MEMBERS)],
        "threads": Threads,
        "start_from": str | None,
        "resume": str | None,
        "resume_from": Literal["last", "best"] | None,
        "trust": Names | None,
        "search": Part | Mapping[str, Any] | None,  # of a finished run its draw alone
        **dict.fromkeys(
            ("dataset", "data", "model", "loss", "optimizer", "scheduler", "validator", "trainer"),
            Part,
        ),
        "callbacks": Mapping[str, Part | None],  # null leaves one out
        "logger": Mapping[str, Part],
    },
    "evaluate": {
        "runs": Names,
        "checkpoint": Literal["best", "last"],
        "split": Literal["test", "validation"],
        "dataset": Part | None,
        "horizon": Seconds | None,
        "step": Seconds | None,
        "windows": Sequence[Seconds] | None,
        "thresholds": Mapping[str, Annotated[float, Range(0, above=True)]],
        "trajectory": Index,
        "threads": Threads,
        "trust": Names | None,
    },
    "control": {
        "run": str,
        "checkpoint": Literal["best", "last"],
        "member": Index,
        "gains": Mapping[str, float | Sequence[float]],
        "duration": Seconds,
        "rate": Annotated[float, Range(0, above=True)] | None,
        "samples_rate": Annotated[float, Range(0, above=True)],
        "initial_states": Part | None,
        "runs": Count,
        "seed": Annotated[int, Range(0, 2**32 - 1)],
        "robot": Mapping[str, Any],
        "actuator": Part,
        "sensor": Part,
        "delay": Index,
        "guard": Mapping[str, Any],
        "stability": Mapping[str, Any] | None,
        "export": str | None,
        "settle_fraction": Annotated[float, Range(0, 1, above=True)],
        "settled_after": Annotated[float, Range(0)],
        "trajectory": Index,
        "animate": bool,
        "threads": Threads,
        "trust": Names | None,
        "controllers": Mapping[str, Mapping[str, Any]],
        "reference": Part,
        "plant": Part,
    },
    "check": {"dataset": Part, "longest_delay": Seconds},
    "gather": {
        "runs": Names,
        "evaluations": Names | None,
        "filter": Mapping[str, Any] | None,
        "sort": str,
        "plot": str | None,
        "plot_column": str | None,
    },
}

# Of the numbers that constructors take under these names.
RANGES = {
    **dict.fromkeys(("batch_size", "keep_every", "pairs", "steps", "stride", "substeps"), Range(1)),
    "hidden": Range(1, 20_000),  # two such layers have 1.6 GB
    **dict.fromkeys(("harmonics", "nodes", "segments", "validations"), Range(1)),
    **dict.fromkeys(("duration", "horizon", "lr", "piece", "rate", "window"), Range(0, above=True)),
    **dict.fromkeys(("gradient_clip_val", "weight_decay"), Range(0)),
    "coverage": Range(0, 1),
    "seed": Range(0, 2**32 - 1),
}

# Arguments of a constructor that the program gives, and what to set instead.
_LENGTH = "trainer.steps and trainer.validations"
GIVEN = {
    "data.batches_per_epoch": _LENGTH,
    "trainer.max_epochs": _LENGTH,
    "trainer.max_steps": _LENGTH,
    "trainer.check_val_every_n_epoch": _LENGTH,
    "trainer.val_check_interval": _LENGTH,
    "trainer.callbacks": "callbacks",
    "trainer.logger": "logger",
    "trainer.default_root_dir": "hydra.run.dir",
    "trainer.plugins": "trainer.precision and trainer.strategy",
}


def check(command: str, config: Mapping[str, Any]) -> None:
    """Refuse a configuration with an unknown key, or a value of another type or out of range.

    Raises:
        ConfigError: naming the key, what was found and what was expected.
    """
    known = KEYS[command]
    for key, value in config.items():
        if key not in known:
            raise ConfigError(
                f"the configuration has no key {key!r}{did_you_mean(key, list(known))}"
            )
        check_value(key, value, known[key])


def did_you_mean(key: str, known: Sequence[str]) -> str:
    """The known keys that are like another one, as the end of a sentence."""
    close = difflib.get_close_matches(key, known, n=3, cutoff=0.6)
    return f": did you mean {' or '.join(close)}?" if close else ""


def check_value(path: str, value: Any, hint: Any) -> None:
    """Refuse a value that is not what an annotation says, and so every part in it.

    Raises:
        ConfigError: naming the path of the value.
    """
    if not fits(value, hint):
        raise ConfigError(f"{path} is {_shown(value)}, expected {words(hint)}")
    if _is_part(value):
        _check_part(path, value)
        return
    name = path.rsplit(".", 1)[-1]
    numbers = value if isinstance(value, list) else [value]
    for number in numbers:
        if name in RANGES and _is_number(number) and number not in RANGES[name]:
            raise ConfigError(f"{path} is {_shown(value)}, expected numbers {RANGES[name]}")
    if isinstance(value, Mapping):
        inner = next((get_args(h)[1] for h in _options(hint) if len(get_args(h)) == 2), Any)
        for key, item in value.items():
            check_value(f"{path}.{key}", item, inner)
    elif isinstance(value, list):
        for index, item in enumerate(value):
            if isinstance(item, (Mapping, list)):
                check_value(f"{path}[{index}]", item, Any)


def _check_part(path: str, part: Mapping[str, Any]) -> None:
    """Refuse what the constructor of a part does not take."""
    known = arguments(part["_target_"], path)
    for key, value in part.items():
        if key in ("_target_", "_partial_"):
            continue
        if instead := GIVEN.get(f"{path}.{key}"):
            raise ConfigError(f"{path}.{key} is not to be set: the program does, by {instead}")
        if key not in known:
            if known.get("**") is not None:
                continue
            name = part["_target_"].rsplit(".", 1)[-1]
            raise ConfigError(
                f"{path}: {name} takes no {key!r}{did_you_mean(key, list(known))}; if an "
                f"experiment has it for another class, remove it by '~{path}.{key}'"
            )
        check_value(f"{path}.{key}", value, known[key])


def arguments(target: Any, path: str = "_target_") -> dict[str, Any]:
    """The arguments of what a ``_target_`` names, with their annotations; ``**``: any others.

    Raises:
        ConfigError: if there is no such class or function.
    """
    found = find(target, path)
    described: Any = found
    if isinstance(found, type) and not dataclasses.is_dataclass(found):
        described = found.__init__  # type: ignore[misc]
    try:
        hints = get_type_hints(described, include_extras=True)
    except Exception:  # names that exist for type checkers only, in other packages
        hints = {}
    taken: dict[str, Any] = {}
    for name, one in inspect.signature(found).parameters.items():
        if one.kind is one.VAR_KEYWORD:
            taken["**"] = Any
        elif one.kind is not one.VAR_POSITIONAL:
            taken[name] = hints.get(name, Any)
    if path == "trainer":
        taken |= {"steps": Count, "validations": Count}
    return taken


def find(target: Any, path: str = "_target_") -> Any:
    """The class or function of a dotted name.

    Raises:
        ConfigError: if there is none.
    """
    if not isinstance(target, str):
        raise ConfigError(f"{path}._target_ is {_shown(target)}, expected the name of a class")
    parts = target.split(".")
    for cut in range(len(parts) - 1, 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError as error:
            if error.name and ".".join(parts[:cut]).startswith(error.name):
                continue
            raise ConfigError(f"{path}._target_ is {target!r}: {error}") from error
        except (ValueError, TypeError):
            break
        for name in parts[cut:]:
            found = getattr(found, name, None)
        if callable(found):
            return found
        break
    raise ConfigError(
        f"{path}._target_ is {target!r}, which does not exist: expected the dotted name of a class "
        "that can be imported, as pinn_dyn.models.LagrangianNetwork"
    )


def fits(value: Any, hint: Any) -> bool:
    """Whether a plain value of a configuration is what an annotation says."""
    options = _options(hint)
    return any(_fits(value, option) for option in options)


def _options(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a union, or the annotation itself."""
    if get_origin(hint) in (Union, types.UnionType):
        return tuple(option for part in get_args(hint) for option in _options(part))
    return (hint,)


_SEQUENCES = (
    list,
    tuple,
    collections.abc.Sequence,
    collections.abc.Iterable,
    collections.abc.Collection,
)
_MAPPINGS = (dict, collections.abc.Mapping, collections.abc.MutableMapping)


def _fits(value: Any, hint: Any) -> bool:
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if hint is None or hint is type(None):
        return value is None
    if origin is Annotated:
        limits = [limit for limit in inner[1:] if isinstance(limit, Range)]
        return fits(value, inner[0]) and all(value in limit for limit in limits)
    if origin is Literal:
        return any(value == x and type(value) is type(x) for x in inner)
    if hint is Part:
        return _is_part(value)
    if hint is bool:
        return isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint is float:
        return _is_number(value) and math.isfinite(value)
    if hint in (str, Path):
        return isinstance(value, str)
    if (origin or hint) in _SEQUENCES:
        if not isinstance(value, list):
            return False
        if origin is tuple and inner and inner[-1] is not Ellipsis and len(value) != len(inner):
            return False
        return not inner or all(fits(item, inner[0]) for item in value)
    if (origin or hint) in _MAPPINGS:
        return isinstance(value, Mapping) and not _is_part(value)
    # A class, a protocol or something to call is built; numbers stand for tensors and arrays.
    if getattr(hint, "__name__", "") in ("Tensor", "ndarray"):
        return _is_number(value) or isinstance(value, list)
    if isinstance(hint, type) or origin is collections.abc.Callable:
        return isinstance(value, Mapping) or hint is object
    return True


def words(hint: Any) -> str:
    """An annotation in words, for messages and for the configuration reference."""
    names: list[str] = []
    for option in _options(hint):
        if (text := _words(option)) not in names:
            names.append(text)
    return " or ".join(names)


def _words(hint: Any) -> str:
    origin, inner = get_origin(hint), get_args(hint)
    plain: dict[Any, str] = {
        Any: "any value",
        None: "null",
        type(None): "null",
        bool: "true or false",
        int: "a whole number",
        float: "a number",
        str: "a text",
        Path: "a path",
    }
    if origin is None and isinstance(hint, collections.abc.Hashable) and hint in plain:
        return plain[hint]
    if origin is Annotated:
        return " ".join([words(inner[0]), *map(str, inner[1:])])
    if origin is Literal:
        return " or ".join(map(str, inner))
    if (origin or hint) in _SEQUENCES:
        return f"a list, each {words(inner[0])}" if inner and inner[0] is not Any else "a list"
    if (origin or hint) in _MAPPINGS:
        return "a mapping"
    if getattr(hint, "__name__", "") in ("Tensor", "ndarray"):
        return "numbers"
    if isinstance(hint, type) or origin is collections.abc.Callable:
        return "an object, a mapping with a _target_"
    return "any value"


def _is_part(value: Any) -> bool:
    return isinstance(value, Mapping) and "_target_" in value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
