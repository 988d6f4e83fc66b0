"""Tensors of PyTorch and matrices of NumPy as tables."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from pinn_dyn.data.logs.arrays import table_of_arrays
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.table import Request


def read_torch(path: Path, request: Request) -> pd.DataFrame | dict[str, pd.DataFrame]:
    """Read a file of ``torch.save``: a matrix, a dictionary of tensors, or a list of these: runs.

    Raises:
        LogError: on other objects, which are never unpickled.
    """
    try:
        content = torch.load(path, weights_only=True, map_location="cpu")
    except pickle.UnpicklingError as error:
        raise LogError(
            f"{path}: holds Python objects, which are not loaded: save plain tensors, as in "
            "torch.save({'t': t, 'q': q, 'u': u}, path)"
        ) from error
    if isinstance(content, list):
        return {str(k): _table(path, request, item) for k, item in enumerate(content)}
    return _table(path, request, content)


def read_npy(path: Path, request: Request) -> pd.DataFrame:
    """Read a matrix with the columns ``0``, ``1`` and so on, or a structured array by its names."""
    values = np.load(path, allow_pickle=False)
    names = values.dtype.names
    return _table(path, request, {name: values[name] for name in names} if names else values)


def _table(path: Path, request: Request, content: Any) -> pd.DataFrame:
    variables = _arrays("", content)
    if "" not in variables:
        return table_of_arrays(path, request, variables)
    matrix = np.atleast_2d(variables[""])
    names = [str(k) for k in range(matrix.shape[1])]
    return pd.DataFrame(matrix, pd.RangeIndex(1, len(matrix) + 1), names)


def _arrays(name: str, content: Any) -> dict[str, Any]:
    """Return the arrays of nested mappings, as ``name.name``."""
    if isinstance(content, torch.Tensor):
        return {name: content.numpy(force=True)}
    if not isinstance(content, Mapping):
        return {name: np.asarray(content)}
    parts = [_arrays(f"{name}.{key}".strip("."), value) for key, value in content.items()]
    return {key: value for part in parts for key, value in part.items()}
