"""Physics-informed neural networks that learn robot dynamics.

The names below are the public API; the packages contain more. A name is imported on first use, so
that ``import pinn_dyn`` takes no time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pinn_dyn.lazy_imports import LazyNames, lazy_attributes

if TYPE_CHECKING:
    from pinn_dyn.app.config import dataset as dataset
    from pinn_dyn.data import DataSource as DataSource
    from pinn_dyn.data import LogSource as LogSource
    from pinn_dyn.data import Splits as Splits
    from pinn_dyn.evaluation.closed_loops import close_loop as close_loop
    from pinn_dyn.identification.excitation_design import design_excitation as design_excitation
    from pinn_dyn.log_check.check import check as check
    from pinn_dyn.mechanics import MechanicalSystem as MechanicalSystem
    from pinn_dyn.mechanics import Signal as Signal
    from pinn_dyn.mechanics import Terms as Terms
    from pinn_dyn.mechanics import Trajectory as Trajectory
    from pinn_dyn.run.evaluation import evaluate as evaluate
    from pinn_dyn.run.run import Run as Run
    from pinn_dyn.run.run import ensemble as ensemble
    from pinn_dyn.run.run_folder import load as load
    from pinn_dyn.run.training.fit import fit as fit
    from pinn_dyn.run.training.train import train as train
    from pinn_dyn.systems import SoftArm as SoftArm

__version__ = "0.4.0"

__getattr__ = lazy_attributes(__name__)
__all__ = list(LazyNames(__name__).paths)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
