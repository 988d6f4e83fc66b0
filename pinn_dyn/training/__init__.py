"""Training: LightningModules, losses, gradient engines, optimizers and schedules."""

from typing import TYPE_CHECKING

from pinn_dyn.lazy_imports import lazy_attributes
from pinn_dyn.training.constants_fit import COVARIANCE, FIT, Fit
from pinn_dyn.training.least_squares import LeastSquares
from pinn_dyn.training.losses import (
    IncrementLoss,
    MidpointLoss,
    NonFiniteLossError,
    Penalized,
    WindowLoss,
)
from pinn_dyn.training.optimizers import SOAP, one_cycle
from pinn_dyn.training.parameter_vector import ELEMENTWISE, ParameterVector

if TYPE_CHECKING:
    from pinn_dyn.training.learner import DynamicsLearner, WholeCheckpoints

__all__ = [
    "COVARIANCE",
    "ELEMENTWISE",
    "FIT",
    "SOAP",
    "DynamicsLearner",
    "Fit",
    "IncrementLoss",
    "LeastSquares",
    "MidpointLoss",
    "NonFiniteLossError",
    "ParameterVector",
    "Penalized",
    "WholeCheckpoints",
    "WindowLoss",
    "one_cycle",
]

__getattr__ = lazy_attributes(__name__)
