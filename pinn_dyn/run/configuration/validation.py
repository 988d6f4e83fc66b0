"""Checks of configurations against the signatures of the classes that ``_target_`` names."""

from __future__ import annotations

import collections.abc
import contextlib
import difflib
import functools
import inspect
import pkgutil
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import pydantic
from pydantic import Field, NonNegativeFloat, PositiveFloat, TypeAdapter, ValidationError
from pydantic_core import PydanticCustomError

from pinn_dyn.lazy_imports import LazyNames
from pinn_dyn.run.configuration.signatures import STAND_INS, unknown_keys

_CONFIG = pydantic.ConfigDict(strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
_LISTS = (
    list,
    tuple,
    collections.abc.Sequence,
    collections.abc.Iterable,
    collections.abc.Collection,
)
_MAPPINGS = (dict, collections.abc.Mapping, collections.abc.MutableMapping)
_PLAIN = (bool, int, float, str, type(None), Any)  # The optimizers of PyTorch state no limits.
_OPTIMIZER = {"lr": PositiveFloat, "weight_decay": NonNegativeFloat, "eps": PositiveFloat}

Seed = Annotated[int, Field(ge=0, lt=2**32)]
SET_BY_PROGRAM = {
    *("data.batches_per_epoch", "data.source", "loss.model", "loss.statistics"),
    *("model.statistics", "optimizer.maximize", "optimizer.params", "plant.system"),
    *("scheduler.optimizer", "scheduler.total_steps", "validator.training_step"),
}
"""Keys of arguments that the program sets itself."""


class ConfigError(ValueError):
    """The configuration cannot be used as it is; the message says what to change."""


def check_arguments(target: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """Check that values are arguments of a target and none is missing; report all mistakes."""
    paths = dict(places(values))
    if clashes := SET_BY_PROGRAM.intersection(paths):
        raise ConfigError(f"set by the program, leave out: {', '.join(sorted(clashes))}")
    with _reported(values):
        _validate_arguments(target, values, required=True)
    for path, value in paths.items():
        if value == "???":
            raise ConfigError(_line({"type": "missing", "loc": [path], "input": value}, values, ""))


def check_keys(target: type, values: Mapping[str, Any]) -> None:
    """Check keys against the source of classes, without imports; report all mistakes."""
    lines = [
        _line({"type": "unknown_key", "loc": [path], "ctx": keys, "input": None}, values, "")
        for path, keys in unknown_keys(values, f"{target.__module__}.{target.__qualname__}")
    ]
    if lines:
        raise ConfigError("\n".join(lines))


def check_value(path: str, value: Any, annotation: Any = object) -> None:
    """Check the value of a key against an annotation; by default, that of any object."""
    with _reported(value, path):
        TypeAdapter(_configurable(annotation), config=_CONFIG).validate_python(value)


@contextlib.contextmanager
def _reported(value: Any, path: str = "") -> Iterator[None]:
    try:
        yield
    except ValidationError as error:
        root = {path: value} if path else value
        lines = [_line(mistake, root, path) for mistake in error.errors(include_url=False)]
        raise ConfigError("\n".join(dict.fromkeys(lines))) from error


_CHANGED = {
    "delay": ": it is now dead_time in s",
    "ensemble": ": train.py -m seed=0,1,2 trains several, evaluate.py ensemble=true takes the mean",
    "member": ": give the run of one seed",
    "rate": "; a law in nearly continuous time is rate=20000",
    "stability": ": python examples/paper/proposition_1.py RUN writes the report",
    r"controllers\.\w+\.(law|observer)\.actuator": ": the limits of the loop are enough, remove it",
}
"""Hints for keys of earlier versions."""


def _line(mistake: Mapping[str, Any], root: Any, path: str) -> str:
    for step in mistake["loc"]:
        path += f"[{step}]" if isinstance(step, int) else f".{step}" if path else str(step)
    kind, value = mistake["type"], mistake["input"]
    if kind == "missing" or value == "???":
        return f"no value for {path}: give it as '{path}=...'"
    change = next((text for pattern, text in _CHANGED.items() if re.fullmatch(pattern, path)), "")
    if kind == "unknown_key":
        hint = change or _closest(path, mistake["ctx"], root)
        return f"the configuration has no key '{path}'{hint}"
    expected = mistake["msg"].replace("Input should be", "expected") + change
    if kind == "object" and isinstance(value, str) and "." in path:
        expected += f"; to choose the option of a group, write {path.replace('.', '/')}={value}"
    text = repr(value)
    return f"{path} is {text if len(text) <= 80 else f'{text[:77]}...'}, {expected}"


def _closest(path: str, keys: Mapping[str, Any], root: Any) -> str:
    """Return the keys beside an unknown key that resemble it, or else those anywhere."""
    parent, dot, name = path.rpartition(".")
    names = [key for key in keys if f"{parent}{dot}{key}" not in SET_BY_PROGRAM]
    close = [f"{parent}{dot}{key}" for key in difflib.get_close_matches(name, names)]
    paths = [key for key, _ in places(root) if key != path and "[" not in key]
    paths = [key for key in paths if difflib.get_close_matches(name, [key.rpartition(".")[2]])]
    close = close or difflib.get_close_matches(path, paths, cutoff=0)
    return f": did you mean {' or '.join(close)}?" if close else f", expected {', '.join(names)}"


def places(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Iterate over a nested configuration and everything in it, each value with its path."""
    yield path, value
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from places(item, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from places(item, f"{path}[{index}]")


@functools.cache
def arguments_model(target: Any, required: bool = False) -> type[pydantic.BaseModel]:
    """Make the model of the arguments of a class; all are optional unless ``required``."""
    name = f"{getattr(target, '__module__', '')}.{getattr(target, '__qualname__', '')}"
    target = STAND_INS.get(name, target)
    is_plain_class = isinstance(target, type) and not hasattr(target, "__dataclass_fields__")
    hints = _hints(target.__init__ if is_plain_class else target)
    if str(getattr(target, "__module__", "")).startswith("torch.optim"):
        hints |= _OPTIMIZER
    extra: Literal["allow", "forbid"] = "forbid"
    fields: dict[str, Any] = {}
    for name, parameter in inspect.signature(target).parameters.items():
        if parameter.kind is parameter.VAR_KEYWORD:
            extra = "allow"
        elif parameter.kind is not parameter.VAR_POSITIONAL:
            default = ... if required and parameter.default is parameter.empty else None
            # The alias is the key: a field of its name could hide a method of the model.
            field = Field(default, alias=name)
            fields[f"{name}_"] = (_configurable(hints.get(name, Any)), field)
    config = pydantic.ConfigDict(**_CONFIG, extra=extra)
    return pydantic.create_model(
        getattr(target, "__name__", "arguments"), __config__=config, **fields
    )


def _hints(target: Any) -> dict[str, Any]:
    try:
        names = LazyNames(target.__module__)
        return get_type_hints(target, localns=names, include_extras=True)
    except Exception:  # names that other packages import for type checkers only
        return {}


def _configurable(hint: Any) -> Any:
    """Return the type of plain values that describe an object of an annotation."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return Annotated[(_configurable(inner[0]), *inner[1:])]
    if origin in (Union, UnionType):
        return _union(inner)
    if origin is tuple and inner[-1:] != (Ellipsis,):
        return Annotated[tuple[tuple(map(_configurable, inner))], pydantic.Strict(False)]  # type: ignore[misc]
    if (origin or hint) in _LISTS:
        return list[_configurable(inner[0] if inner else Any)]  # type: ignore[misc]
    if (origin or hint) in _MAPPINGS:
        return dict[str, _configurable(inner[1] if inner else Any)]  # type: ignore[misc]
    if _is_array(hint):
        return _union((float, list[float], list[list[float]]))
    if _is_object(hint):
        return _object([hint])
    if hint is Path:
        return str
    return hint if origin is Literal or hint in _PLAIN else Any


def _is_array(hint: Any) -> bool:
    return getattr(hint, "__name__", "") in ("Tensor", "ndarray")


def _is_object(hint: Any) -> bool:
    if get_origin(hint) is not None:
        return get_origin(hint) is collections.abc.Callable
    simple = hint in (*_PLAIN, *_LISTS, *_MAPPINGS, Path) or _is_array(hint)
    return isinstance(hint, type) and not simple


def _union(options: Sequence[Any]) -> Any:
    """Merge the classes among the options: one description fits any of them."""
    objects = [option for option in options if _is_object(option)]
    short = bool(objects) and Mapping[str, Any] in options
    plain = [x for x in options if x not in objects and not (short and x == Mapping[str, Any])]
    values = [_configurable(option) for option in plain if option is not type(None)]
    values += [_object(objects, short)] if objects else []
    union: Any = Union[tuple(values)]  # noqa: UP007
    if len(values) > 1:
        union = Annotated[union, pydantic.WrapValidator(_merge_alternatives)]
    return union | None if type(None) in options else union


def _merge_alternatives(value: Any, validate: Callable[[Any], Any]) -> Any:
    """Report the mistakes of the alternative that fits best, at the path of the value."""
    try:
        return validate(value)
    except ValidationError as error:
        mistakes = error.errors(include_url=False)
    best = max(mistakes, key=lambda mistake: len(mistake["loc"]))["loc"]
    if len(best) > 1:
        fitting = [mistake for mistake in mistakes if mistake["loc"][0] == best[0]]
        raise _error([{**mistake, "loc": mistake["loc"][1:]} for mistake in fitting])
    messages = [mistake["msg"].removeprefix("Input should be ") for mistake in mistakes]
    expected = " or ".join(dict.fromkeys(" or ".join(messages).split(" or ")))
    kind = "object" if any(mistake["type"] == "object" for mistake in mistakes) else "union"
    raise PydanticCustomError(kind, "Input should be {expected}", {"expected": expected})


def _object(hints: Sequence[Any], short: bool = False) -> Any:
    """Return the type of a mapping that describes an object of classes or factories."""
    classes = [hint for hint in hints if isinstance(hint, type) and get_origin(hint) is None]
    factories = [(*get_args(hint), Any)[1] for hint in hints if hint not in classes]
    either = object in classes or bool(classes and factories)
    kinds = [*classes, *factories]
    named = dict.fromkeys(x.__name__ for x in kinds if isinstance(x, type) and x is not object)
    title = " or ".join(named) or "object"
    form = f"an object of the class {title}: a mapping with a _target_"
    if short:
        form = f"a mapping with {', '.join(inspect.signature(hints[0]).parameters)}"

    def check(value: Any) -> Any:
        if isinstance(value, Mapping) and short and "_target_" not in value:
            _validate_arguments(hints[0], value, required=True)
            return value
        if not isinstance(value, Mapping) or "_target_" not in value:
            raise PydanticCustomError("object", "Input should be {form}", {"form": form})
        arguments = dict(value)
        maker = _maker(arguments.pop("_target_"), kinds, title)
        partial = arguments.pop("_partial_", False)
        if not (isinstance(partial, bool) if either else partial is bool(factories)):
            raise _mistake("_partial_", partial, "which does not fit this object")
        _validate_arguments(maker, arguments)
        return value

    return Annotated[
        Any,
        pydantic.PlainValidator(check),
        pydantic.WithJsonSchema({"type": "object", "title": title}),
    ]


def _maker(name: Any, kinds: Sequence[Any], title: str) -> Any:
    if object in kinds and name in STAND_INS:  # without an import that takes seconds
        return STAND_INS[name]
    try:
        maker = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise _mistake("_target_", name, f"which cannot be imported: {error}") from error
    made = maker if isinstance(maker, type) else _hints(maker).get("return", type(maker))
    checkable = all(isinstance(x, type) and not getattr(x, "_is_protocol", False) for x in kinds)
    if isinstance(made, type) and checkable and not issubclass(made, tuple(kinds)):
        raise _mistake("_target_", name, f"expected the name of a subclass of {title}")
    return maker


def _validate_arguments(target: Any, values: Mapping[str, Any], required: bool = False) -> None:
    model = arguments_model(target, required)
    try:
        model.model_validate(dict(values))
    except ValidationError as error:
        mistakes: list[dict[str, Any]] = [dict(x) for x in error.errors(include_url=False)]
        keys = {str(field.alias): None for field in model.model_fields.values()}
        for mistake in mistakes:
            if mistake["type"] == "extra_forbidden" and len(mistake["loc"]) == 1:
                mistake |= {"type": "unknown_key", "ctx": keys}
        raise _error(mistakes) from None


def _mistake(key: str, value: Any, message: str) -> ValidationError:
    return _error([{"type": "object_key", "msg": message, "loc": (key,), "input": value}])


def _error(mistakes: Sequence[Mapping[str, Any]]) -> ValidationError:
    details: list[Any] = [
        {**x, "type": PydanticCustomError(x["type"], x["msg"], x.get("ctx"))} for x in mistakes
    ]
    return ValidationError.from_exception_data("configuration", details)
