"""Check configurations against the signatures of the classes that they name.

A configuration describes an object by the name of its class, ``_target_``, and the arguments of its
constructor. :func:`arguments_model` makes a pydantic model of a signature: the annotations are the
types, and ``Annotated[float, Field(gt=0)]`` adds limits. An argument that is an object itself is
described, and checked, in the same way.
"""

from __future__ import annotations

import collections.abc
import contextlib
import difflib
import functools
import inspect
import pkgutil
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    Strict,
    TypeAdapter,
    ValidationError,
    WrapValidator,
    create_model,
)
from pydantic_core import InitErrorDetails, PydanticCustomError, core_schema

_CONFIG = ConfigDict(strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
_LISTS = (list, collections.abc.Sequence, collections.abc.Iterable, collections.abc.Collection)
_MAPPINGS = (dict, collections.abc.Mapping, collections.abc.MutableMapping)
_Numbers = float | list[float] | list[list[float]]

Seed = Annotated[int, Field(ge=0, lt=2**32)]
STAND_INS: dict[Any, type] = {}
"""Classes of other packages, and dataclasses whose fields are the arguments to accept for them."""
SET_BY_PROGRAM: dict[str, str] = {}
"""Keys that the program sets itself, and what to set instead."""


class ConfigError(ValueError):
    """The configuration cannot be used as it is; the message says what to change."""


def check_arguments(target: Callable[..., Any], values: Mapping[str, Any]) -> None:
    """Check that values are arguments of a class or function, and that none is missing.

    Raises:
        ConfigError: with a line for each mistake.
    """
    for path, value in places(values):
        if path in SET_BY_PROGRAM:
            raise ConfigError(_line({"loc": [path], "input": value}, values, ""))
    with _reported(values):
        _validate_arguments(arguments_model(target, True), values)


def check_value(path: str, value: Any, annotation: Any = Any) -> None:
    """Check one value, which may describe an object, against an annotation.

    Args:
        path: where the value stands in the configuration, for messages.
        value: plain values, lists and mappings.
        annotation: type of the value; ``Any`` checks only an object that the value describes.

    Raises:
        ConfigError: with a line for each mistake.
    """
    if annotation is Any and isinstance(value, Mapping) and "_target_" in value:
        annotation = object
    with _reported(value, path):
        TypeAdapter(_configurable(annotation), config=_CONFIG).validate_python(value)


@contextlib.contextmanager
def _reported(value: Any, path: str = "") -> Iterator[None]:
    """Turn the mistakes that pydantic finds in a value into one line each."""
    try:
        yield
    except ValidationError as error:
        mistakes = error.errors(include_url=False)
        lines = [_line(dict(mistake), value, path) for mistake in mistakes]
        raise ConfigError("\n".join(dict.fromkeys(lines))) from error


def _line(mistake: dict[str, Any], root: Any, prefix: str) -> str:
    """Describe a mistake: path, value, what was expected."""
    path = prefix
    for step in mistake["loc"]:
        path += f"[{step}]" if isinstance(step, int) else f".{step}" if path else str(step)
    if path in SET_BY_PROGRAM:
        return f"{path} is set by the program: set {SET_BY_PROGRAM[path]} instead"
    if mistake["type"] == "missing":
        return f"{path} is missing: give {path}=..."
    if mistake["type"] == "unknown_key":
        return (
            f"the configuration has no key '{path}'{_closest(path, mistake['ctx']['keys'], root)}"
        )
    shown = repr(mistake["input"])
    shown = shown if len(shown) <= 80 else f"{shown[:77]}..."
    expected = mistake["msg"].replace("Input should be", "expected")
    if mistake["type"] == "object" and isinstance(mistake["input"], str) and "." in path:
        option = f"{path.replace('.', '/')}={mistake['input']}"
        expected += f" (to choose the option of a group, write {option})"
    return f"{path} is {shown}, {expected}"


def _closest(path: str, keys: Sequence[str], root: Any) -> str:
    """Return the keys beside an unknown one that are like it, or else those anywhere."""
    parent, _, name = path.rpartition(".")
    prefix = f"{parent}." if parent else ""
    close = [f"{prefix}{key}" for key in difflib.get_close_matches(name, keys)]
    if not close:
        paths = [key for key, _ in places(root) if "[" not in key and not key.endswith("_target_")]
        close = difflib.get_close_matches(path, [key for key in paths if key != path])
    if not close:
        return f", expected {', '.join(keys) or 'none'}"
    return f": did you mean {' or '.join(close)}?"


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
def arguments_model(target: Any, required: bool = False) -> type[BaseModel]:
    """Make the pydantic model of the arguments of a class or function.

    Args:
        target: the class or function.
        required: make arguments without a default mandatory; otherwise the program may add them.
    """
    target = STAND_INS.get(target, target)
    is_plain_class = isinstance(target, type) and not hasattr(target, "__dataclass_fields__")
    hints = _hints(target.__init__ if is_plain_class else target)
    try:
        parameters = list(inspect.signature(target).parameters.values())
    except ValueError:  # a class written in C
        parameters = [inspect.Parameter("arguments", inspect.Parameter.VAR_KEYWORD)]
    fields: dict[str, Any] = {}
    for parameter in parameters:
        name = parameter.name
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        optional = not required or parameter.default is not parameter.empty
        field = Field(None, alias=name) if optional else Field(alias=name)
        # The alias is the key: a field of its name could hide a method of the model.
        fields[f"{name}_"] = (_configurable(_limited(target, name, hints.get(name, Any))), field)
    open_ended = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    config = ConfigDict(**_CONFIG, extra="allow" if open_ended else "forbid")
    model_name = getattr(target, "__name__", "arguments")
    return create_model(model_name, __config__=config, **fields)


_Share = Annotated[float, Field(ge=0, lt=1)]
_OPTIMIZER_ARGUMENTS = {
    "lr": PositiveFloat,
    "weight_decay": NonNegativeFloat,
    "eps": PositiveFloat,
    "betas": tuple[_Share, _Share],
}


def _limited(target: Any, name: str, hint: Any) -> Any:
    """Add limits to the annotations of the optimizers of PyTorch, which have none."""
    is_optimizer = str(getattr(target, "__module__", "")).startswith("torch.optim")
    return _OPTIMIZER_ARGUMENTS.get(name, hint) if is_optimizer else hint


def argument_names(target: str) -> set[str]:
    """Return the names of the arguments of the class or function of a dotted name."""
    return set(inspect.signature(pkgutil.resolve_name(target)).parameters)


def _hints(target: Any) -> dict[str, Any]:
    try:
        return get_type_hints(target, include_extras=True)
    except Exception:  # names that other packages import for type checkers only
        return {}


def _configurable(hint: Any) -> Any:
    """Return the type of plain values that describe an object of an annotation."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return Annotated[(_configurable(inner[0]), *inner[1:])]
    if origin in (Union, types.UnionType):
        return _union(inner)
    if origin is tuple and inner and inner[-1] is not Ellipsis:
        return Annotated[tuple[tuple(map(_configurable, inner))], Strict(False)]  # type: ignore[misc]
    if (origin or hint) in (*_LISTS, tuple):
        return list[_configurable(inner[0] if inner else Any)]  # type: ignore[misc]
    if (origin or hint) in _MAPPINGS:
        return dict[str, _configurable(inner[1] if inner else Any)]  # type: ignore[misc]
    if getattr(hint, "__name__", "") in ("Tensor", "ndarray"):
        return Annotated[_Numbers, WrapValidator(_merge_alternatives)]
    if hint is Path:
        return str
    if _is_object(hint):
        return Annotated[Any, _Object([hint])]
    if origin is Literal or hint in (Any, None, type(None), bool, int, float, str):
        return hint
    return Any


def _is_object(hint: Any) -> bool:
    """Return true for a class or a factory, which a configuration describes by ``_target_``."""
    if get_origin(hint) is collections.abc.Callable:
        return True
    plain = (bool, int, float, str, Path, type(None), list, tuple, *_LISTS, *_MAPPINGS)
    array = getattr(hint, "__name__", "") in ("Tensor", "ndarray")
    simple = hint is Any or hint in plain or array  # since Python 3.11 Any is a class
    return isinstance(hint, type) and get_origin(hint) is None and not simple


def _union(options: Sequence[Any]) -> Any:
    """Merge the classes among the options: one description fits any of them."""
    objects = [option for option in options if _is_object(option)]
    short = bool(objects) and Mapping[str, Any] in options
    values = [
        _configurable(option)
        for option in options
        if option not in (None, type(None), *objects)
        and not (short and option == Mapping[str, Any])
    ]
    if objects:
        values.append(Annotated[Any, _Object(objects, short)])
    union: Any = Union[tuple(values)]  # noqa: UP007
    if len(values) > 1:
        union = Annotated[union, WrapValidator(_merge_alternatives)]
    return union | None if type(None) in options or None in options else union


def _merge_alternatives(value: Any, validate: Callable[[Any], Any]) -> Any:
    """Report the mistakes of the alternative that fits best, at the path of the value."""
    try:
        return validate(value)
    except ValidationError as error:
        mistakes = error.errors(include_url=False)
    deepest = max(mistakes, key=lambda mistake: len(mistake["loc"]))
    if len(deepest["loc"]) > 1:
        fitting = [mistake for mistake in mistakes if mistake["loc"][0] == deepest["loc"][0]]
        raise _located([{**mistake, "loc": mistake["loc"][1:]} for mistake in fitting])
    messages = [mistake["msg"].removeprefix("Input should be ") for mistake in mistakes]
    expected = " or ".join(dict.fromkeys(" or ".join(messages).split(" or ")))
    kind = "object" if any(mistake["type"] == "object" for mistake in mistakes) else "union"
    raise PydanticCustomError(kind, "Input should be {expected}", {"expected": expected})


def _located(mistakes: Sequence[Mapping[str, Any]]) -> ValidationError:
    details: list[InitErrorDetails] = [
        {
            "type": PydanticCustomError(mistake["type"], mistake["msg"], mistake.get("ctx")),
            "loc": mistake["loc"],
            "input": mistake["input"],
        }
        for mistake in mistakes
    ]
    return ValidationError.from_exception_data("configuration", details)


class _Object:
    """Annotation of a value that describes an object: a mapping with a ``_target_``.

    Args:
        hints: classes that the object may be of, or factories: ``Callable[..., Class]``.
        short: accept the arguments of the first class alone, without a ``_target_``.
    """

    def __init__(self, hints: Sequence[Any], short: bool = False):
        self.short = hints[0] if short else None
        factories = [get_args(hint)[-1] for hint in hints if get_origin(hint) is not None]
        classes = [hint for hint in hints if get_origin(hint) is None]
        factories += [Any for hint in hints if hint is collections.abc.Callable]
        either = object in classes or bool(classes and factories)
        self.partial = None if either else bool(factories)
        self.kinds = [*classes, *factories]
        named = dict.fromkeys(kind.__name__ for kind in self.kinds if isinstance(kind, type))
        self.title = " or ".join(name for name in named if name != "object") or "object"

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        """Return the schema of a plain function, :meth:`check`."""
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """Return the schema for the configuration reference."""
        return {"type": "object", "title": self.title}

    def check(self, value: Any) -> Any:
        """Check the class and, recursively, the arguments of a description."""
        is_mapping = isinstance(value, Mapping)
        if is_mapping and self.short is not None and "_target_" not in value:
            _validate_arguments(arguments_model(self.short, True), value)
            return value
        if not is_mapping or "_target_" not in value:
            form = f"an object of the class {self.title}: a mapping with a _target_"
            if self.short is not None:
                form = f"a mapping with {', '.join(inspect.signature(self.short).parameters)}"
            raise PydanticCustomError("object", "Input should be {form}", {"form": form})
        target, partial = value["_target_"], value.get("_partial_", False)
        maker = self._maker(target)
        if not isinstance(partial, bool) or self.partial not in (None, partial):
            expected = "true or false" if self.partial is None else str(self.partial).lower()
            raise _mistake("_partial_", partial, f"Input should be {expected} for this object")
        arguments = {k: x for k, x in value.items() if k not in ("_target_", "_partial_")}
        _validate_arguments(arguments_model(maker), arguments)
        return value

    def _maker(self, target: Any) -> Any:
        """Return the class or function of a name, if it makes an object of the right kind."""
        try:
            maker = pkgutil.resolve_name(target)
        except (ImportError, AttributeError, ValueError, TypeError) as error:
            raise _mistake("_target_", target, f"which cannot be imported: {error}") from error
        made = maker if isinstance(maker, type) else _hints(maker).get("return")
        if inspect.isbuiltin(maker) or not callable(maker):
            made = type(maker)
        known = [kind for kind in self.kinds if isinstance(kind, type)]
        checkable = len(known) == len(self.kinds) and not any(
            getattr(kind, "_is_protocol", False) for kind in known
        )
        if isinstance(made, type) and checkable and not issubclass(made, tuple(known)):
            raise _mistake(
                "_target_", target, f"Input should be the name of a subclass of {self.title}"
            )
        return maker


def _mistake(key: str, value: Any, message: str) -> ValidationError:
    return _located([{"type": "object_key", "msg": message, "loc": (key,), "input": value}])


def _validate_arguments(model: type[BaseModel], values: Mapping[str, Any]) -> None:
    """Validate arguments, and tell unknown ones which keys there are."""
    try:
        model.model_validate(dict(values))
    except ValidationError as error:
        mistakes: list[dict[str, Any]] = [dict(x) for x in error.errors(include_url=False)]
        keys = [field.alias for field in model.model_fields.values()]
        for mistake in mistakes:
            if mistake["type"] == "extra_forbidden" and len(mistake["loc"]) == 1:
                mistake |= {"type": "unknown_key", "ctx": {"keys": keys}}
        raise _located(mistakes) from None
