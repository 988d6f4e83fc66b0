"""Data sets of conf/dataset for use in Python."""

from __future__ import annotations

from typing import Any

from pinn_dyn.app.build import build_source
from pinn_dyn.app.config import composed
from pinn_dyn.data import DataSource


def dataset(name: str, **settings: Any) -> DataSource:
    """Build a data set of ``conf/dataset``, such as ``dataset("soft_arm_1", duration=4.0)``.

    Args:
        name: file name without suffix.
        settings: arguments of its class that replace those of the file.
    """
    overrides = [f"dataset={name}", *(f"dataset.{key}={x}" for key, x in settings.items())]
    return build_source(composed("train", overrides))
