"""Data sets of conf/dataset for Python."""

from __future__ import annotations

from typing import Any

from pinn_dyn.app.config import composed
from pinn_dyn.data import DataSource
from pinn_dyn.run.build import build_source


def dataset(name: str, **settings: Any) -> DataSource:
    """Build a data set of ``conf/dataset``, such as ``dataset("soft_arm_1", duration=4.0)``.

    ``settings`` replace arguments of the file ``<name>.yaml``.
    """
    overrides = [f"dataset={name}", *(f"dataset.{key}={x}" for key, x in settings.items())]
    return build_source(composed("train", overrides))
