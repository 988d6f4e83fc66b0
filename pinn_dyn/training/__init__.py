"""Training: the LightningModule, losses and callbacks."""

from pinn_dyn.training.ensemble import EnsembleLearner
from pinn_dyn.training.fit import fit
from pinn_dyn.training.impulse import ImpulseLoss
from pinn_dyn.training.learner import DynamicsLearner, NonFiniteLossError
from pinn_dyn.training.least_squares import Fit, LeastSquares
from pinn_dyn.training.least_squares_learner import LeastSquaresLearner
from pinn_dyn.training.losses import IncrementLoss, WindowLoss
from pinn_dyn.training.member_soap import MemberSOAP
from pinn_dyn.training.midpoint import MidpointLoss

__all__ = [
    "DynamicsLearner",
    "EnsembleLearner",
    "Fit",
    "ImpulseLoss",
    "IncrementLoss",
    "LeastSquares",
    "LeastSquaresLearner",
    "MemberSOAP",
    "MidpointLoss",
    "NonFiniteLossError",
    "WindowLoss",
    "fit",
]
