"""Description of a simulation as plain JSON: the key of its recordings in the cache."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

_MODULE_ATTRIBUTES = frozenset(vars(torch.nn.Module()))


def describe(value: object) -> Any:
    """Describe a value as JSON: an object by its class and its ``describe()`` or its attributes.

    A class or a function is identified by its name: a recording shows by its samples whether the
    present code has made it (:func:`~pinn_dyn.data.cache.load_or_make`).

    Raises:
        TypeError: on an object that cannot be pickled; give its class a method ``describe()``.
    """
    return plain(value, _described_object)


def plain(value: object, describe_object: Callable[[Any], Any]) -> Any:
    """Convert tensors, mappings and sequences to JSON, and other objects by a function."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (torch.Tensor, np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item, describe_object) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [plain(item, describe_object) for item in value]
    return describe_object(value)


def _described_object(value: Any) -> Any:
    if isinstance(value, (type, types.FunctionType)):
        return value.__qualname__
    if hasattr(value, "describe"):
        settings = value.describe()
    elif isinstance(value, torch.nn.Module):
        settings = {k: item for k, item in vars(value).items() if k not in _MODULE_ATTRIBUTES}
        settings |= {**value._parameters, **value._buffers, **value._modules}
    elif dataclasses.is_dataclass(value):
        settings = {item.name: getattr(value, item.name) for item in dataclasses.fields(value)}
    else:
        return describe(value.__reduce_ex__(2))
    return {"class": type(value).__qualname__, **describe(settings)}
