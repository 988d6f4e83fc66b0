"""Training: the LightningModule, losses, gradients, schedule."""

from pinn_dyn.training.checkpoints import WholeCheckpoints
from pinn_dyn.training.fit import fit
from pinn_dyn.training.learner import DynamicsLearner, NonFiniteLossError
from pinn_dyn.training.least_squares import Fit, LeastSquares
from pinn_dyn.training.least_squares_learner import COVARIANCE, LeastSquaresLearner
from pinn_dyn.training.losses import IncrementLoss, MidpointLoss, Penalized, WindowLoss
from pinn_dyn.training.schedule import one_cycle

__all__ = [
    "COVARIANCE",
    "DynamicsLearner",
    "Fit",
    "IncrementLoss",
    "LeastSquares",
    "LeastSquaresLearner",
    "MidpointLoss",
    "NonFiniteLossError",
    "Penalized",
    "WholeCheckpoints",
    "WindowLoss",
    "fit",
    "one_cycle",
]
