"""What a configuration may hold: the keys of a command are in :mod:`keys`, those of a part here.

A part is a mapping with a ``_target_``; its keys are the arguments of that constructor, and the
constructor's annotations are their types. ``RANGES`` adds what numbers of a name must keep to.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import importlib
import inspect
import itertools
import math
import types
from collections.abc import Collection, Iterable, Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pinn_dyn.app.keys import (
    GIVEN,
    KEYS,
    MOST_WEIGHTS,
    NEEDED,
    RANGES,
    TRAINER,
    Kind,
    Part,
    Range,
    Section,
    places,
)
from pinn_dyn.spelling import did_you_mean


class ConfigError(ValueError):
    """The configuration cannot be used as it is; the message says what to change."""


def check(command: str, config: Mapping[str, Any]) -> None:
    """Refuse a configuration that lacks a key, has an unknown one, or a value that does not fit.

    Raises:
        ConfigError: naming the key, what was found and what was expected.
    """
    known = KEYS[command]
    # Sections last: they take up values of others, as reference.seed=${seed}.
    for key, value in sorted(config.items(), key=lambda item: isinstance(item[1], Mapping)):
        if key not in known:
            raise ConfigError(f"the configuration has no key {key!r}{did_you_mean(key, known)}")
        check_value(key, value, known[key])
    for key, hint in known.items():
        # Trainings of earlier versions were of single models.
        if key not in config and key != "ensemble" and not fits(None, hint):
            raise _missing(key, hint)
    if command == "train":
        for part, keys in NEEDED.items():
            taken = arguments(config[part]["_target_"], part)
            for key in keys:
                if key in taken and key not in config[part]:
                    raise _missing(f"{part}.{key}", taken[key])
        _check_weights(config)


def _missing(path: str, hint: Any) -> ConfigError:
    return ConfigError(f"{path} is missing, expected {words(hint)}: give {path}=...")


def _check_weights(config: Mapping[str, Any]) -> None:
    """Refuse networks that no machine holds, before they are built."""
    members = config.get("ensemble", 1)
    for path, widths in places(config["model"], "model"):
        if not path.endswith(".hidden") or not isinstance(widths, list):
            continue
        if len(widths) > 100:
            raise ConfigError(f"{path} has {len(widths)} layers, expected at most 100")
        weights = members * sum(a * b for a, b in itertools.pairwise(widths))
        if weights > MOST_WEIGHTS:
            raise ConfigError(
                f"{path} is {_shown(widths)}, {weights:.2g} weights with ensemble={members}: "
                f"expected at most {MOST_WEIGHTS:.2g}, choose fewer or narrower layers"
            )


def check_value(path: str, value: Any, hint: Any) -> None:
    """Refuse a value that is not what an annotation says, and so every part in it.

    Raises:
        ConfigError: naming the path of the value.
    """
    if not fits(value, hint):
        raise ConfigError(f"{path} is {_shown(value)}, expected {words(hint)}")
    if _is_part(value):
        _check_part(path, value, hint)
        return
    name = path.rsplit(".", 1)[-1]
    numbers = value if isinstance(value, list) else [value]
    for number in numbers:
        if name in RANGES and _is_number(number) and number not in RANGES[name]:
            raise ConfigError(f"{path} is {_shown(value)}, expected numbers {RANGES[name]}")
    if isinstance(value, Mapping):
        section = next((option for option in _options(hint) if _is_section(option)), None)
        if section is not None:
            _check_section(path, value, section)
            return
        inner = next((get_args(h)[1] for h in _options(hint) if len(get_args(h)) == 2), Any)
        known = short_form(hint)  # whose missing and misspelt keys from_config names
        for key, item in value.items():
            check_value(f"{path}.{key}", item, known.get(key, inner))
    elif isinstance(value, list):
        fitting = (h for h in _options(hint) if _is_list(h) and _fits(value, h))
        inner = next((get_args(h)[0] for h in fitting), Any)
        for index, item in enumerate(value):
            if isinstance(item, (Mapping, list)):
                check_value(f"{path}[{index}]", item, inner)


def _check_section(path: str, value: Mapping[str, Any], section: Any) -> None:
    """Refuse a mapping without the keys of a section, or with others."""
    hints = short_form(section)
    for key in value:
        if key not in hints:
            raise ConfigError(
                f"{path} takes no {key!r}{did_you_mean(key, hints)}; expected {', '.join(hints)}"
            )
    for field in dataclasses.fields(section):
        if field.name in value:
            check_value(f"{path}.{field.name}", value[field.name], hints[field.name])
        elif field.default is dataclasses.MISSING:
            raise _missing(f"{path}.{field.name}", hints[field.name])


def _check_part(path: str, part: Mapping[str, Any], hint: Any) -> None:
    """Refuse a part of another kind, or what its constructor does not take."""
    known = arguments(part["_target_"], path)
    _check_kind(path, part, hint)
    name = part["_target_"].rsplit(".", 1)[-1]
    for key, value in part.items():
        if key in ("_target_", "_partial_"):
            continue
        if instead := GIVEN.get(f"{path}.{key}"):
            raise ConfigError(f"{path}.{key} is not to be set: the program does, by {instead}")
        if path == "trainer" and key in known and key not in TRAINER:
            raise ConfigError(f"trainer.{key} is not to be set, only {', '.join(TRAINER)}")
        if key not in known:
            if known.get("**") is not None:
                continue
            raise ConfigError(
                f"{path}: {name} takes no {key!r}{did_you_mean(key, known)}; if an "
                f"experiment has it for another class, remove it by '~{path}.{key}'"
            )
        check_value(f"{path}.{key}", value, known[key])


def _check_kind(path: str, part: Mapping[str, Any], hint: Any) -> None:
    """Refuse what builds an object of another class than an annotation says."""
    options = _options(hint)
    kinds = [
        limit for option in options for limit in get_args(option)[1:] if isinstance(limit, Kind)
    ]
    wanted = [find(name) for kind in kinds for name in kind.names]
    plain = (option for option in options if isinstance(option, type))
    wanted += [option for option in plain if option not in (Part, type(None))]
    heads = [get_args(option)[-1] for option in options if _is_callable(option)]
    wanted += [head for head in heads if isinstance(head, type)]
    partial = part.get("_partial_", False)
    if not isinstance(partial, bool):
        raise ConfigError(f"{path}._partial_ is {_shown(partial)}, expected true or false")
    if wanted and not kinds and partial != bool(heads):
        right = str(bool(heads)).lower()
        raise ConfigError(f"{path}._partial_ is {partial}, expected {right} for this object")
    made = find(part["_target_"], path)
    if inspect.isbuiltin(made):  # of Python itself, as os.system
        made = type(made)
    elif not isinstance(made, type):
        made = _hints(made).get("return")
    if not isinstance(made, type):
        return  # a function of one's own that does not say what it returns
    known = tuple(one for one in wanted if not getattr(one, "_is_protocol", False))
    if wanted and len(known) == len(wanted) and not issubclass(made, known):
        raise ConfigError(
            f"{path}._target_ is {part['_target_']!r}, expected a "
            f"{' or '.join(one.__name__ for one in known)}"
        )


def arguments(target: Any, path: str = "_target_") -> dict[str, Any]:
    """The arguments of what a ``_target_`` names, with their annotations; ``**``: any others.

    Raises:
        ConfigError: if there is no such class or function.
    """
    taken = _parameters(find(target, path))
    return taken | TRAINER if path == "trainer" else taken


def _parameters(found: Any) -> dict[str, Any]:
    """The arguments of a class or function with their annotations; ``**``: any others."""
    described: Any = found
    if isinstance(found, type) and not dataclasses.is_dataclass(found):
        described = found.__init__  # type: ignore[misc]
    hints = _hints(described)
    taken: dict[str, Any] = {}
    try:
        parameters = inspect.signature(found).parameters
    except ValueError:  # written in C, without a word about its arguments
        return {"**": Any}
    for name, one in parameters.items():
        if one.kind is one.VAR_KEYWORD:
            taken["**"] = Any
        elif one.kind is not one.VAR_POSITIONAL:
            taken[name] = hints.get(name, Any)
    return taken


def short_form(hint: Any) -> dict[str, Any]:
    """The keys, with their annotations, of a mapping without a ``_target_``; none if it has any."""
    for option in _options(hint):
        if _is_section(option):
            return get_type_hints(option, include_extras=True)
        if hasattr(option, "from_config"):
            return _parameters(option)
    return {}


def _hints(described: Any) -> dict[str, Any]:
    """The annotations of a function or a class, evaluated; none if they cannot be."""
    try:
        return get_type_hints(described, include_extras=True)
    except Exception:  # names that exist for type checkers only, in other packages
        return {}


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
    if get_origin(hint) is Annotated and not any(isinstance(x, Range) for x in get_args(hint)):
        return _options(get_args(hint)[0])
    return (hint,)


_SEQUENCES = (list, tuple, Sequence, Iterable, Collection)
_MAPPINGS = (dict, Mapping, MutableMapping)


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
    if _is_section(hint):
        return isinstance(value, Mapping) and not _is_part(value)
    if hint is bool:
        return isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63
    if hint is float:
        return _is_number(value) and abs(value) < math.inf  # which NaN is not, nor any huge integer
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
        return _is_number(value) or (isinstance(value, list) and all(fits(x, hint) for x in value))
    if isinstance(hint, type) or _is_callable(hint):
        return _is_part(value) or hint is object
    return True


def words(hint: Any) -> str:
    """An annotation in words, for messages and for the configuration reference."""
    options = _options(hint)
    if any(hasattr(option, "from_config") for option in options):  # beside its plain mapping
        options = tuple(one for one in options if (get_origin(one) or one) not in _MAPPINGS)
    texts = list(dict.fromkeys(map(_words, options)))
    lists = [text for text in texts if text.startswith("a list")]  # last: a comma ends none
    return " or ".join([text for text in texts if text not in lists] + lists)


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
    if hint is Part:
        return "an object, a mapping with a _target_"
    if known := short_form(hint):
        return f"a mapping with {', '.join(known)}"
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
    if isinstance(hint, type) or _is_callable(hint):
        return "an object, a mapping with a _target_"
    return "any value"


def _is_section(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, Section)


def _is_callable(hint: Any) -> bool:
    return get_origin(hint) is collections.abc.Callable


def _is_list(hint: Any) -> bool:
    return (get_origin(hint) or hint) in _SEQUENCES and bool(get_args(hint))


def _is_part(value: Any) -> bool:
    return isinstance(value, Mapping) and "_target_" in value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
