"""Physics-informed neural networks that learn robot dynamics obeying mechanics.

The names below are the front door; each room of the package has more. They are imported when they
are asked for, so that ``import pinn_dyn`` takes no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pinn_dyn.app.fit import fit as fit
    from pinn_dyn.app.learned_model import LearnedModel as LearnedModel
    from pinn_dyn.app.learned_model import load as load
    from pinn_dyn.data import DataSource as DataSource
    from pinn_dyn.data import Splits as Splits
    from pinn_dyn.evaluation.closed_loops import close_loop as close_loop
    from pinn_dyn.mechanics import MechanicalSystem as MechanicalSystem
    from pinn_dyn.mechanics import Signal as Signal
    from pinn_dyn.mechanics import Terms as Terms
    from pinn_dyn.mechanics import Trajectory as Trajectory
    from pinn_dyn.systems import SoftArm as SoftArm

__version__ = "0.3.0"

_HOMES = {
    "DataSource": "pinn_dyn.data",
    "LearnedModel": "pinn_dyn.app.learned_model",
    "MechanicalSystem": "pinn_dyn.mechanics",
    "Signal": "pinn_dyn.mechanics",
    "SoftArm": "pinn_dyn.systems",
    "Splits": "pinn_dyn.data",
    "Terms": "pinn_dyn.mechanics",
    "Trajectory": "pinn_dyn.mechanics",
    "close_loop": "pinn_dyn.evaluation.closed_loops",
    "fit": "pinn_dyn.app.fit",
    "load": "pinn_dyn.app.learned_model",
}

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'pinn_dyn' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
