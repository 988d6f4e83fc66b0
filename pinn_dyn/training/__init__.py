"""Training: the LightningModule, losses and callbacks."""

from pinn_dyn.training.impulse import ImpulseLoss
from pinn_dyn.training.learner import DynamicsLearner, NonFiniteLossError
from pinn_dyn.training.losses import IncrementLoss, WindowLoss

__all__ = ["DynamicsLearner", "ImpulseLoss", "IncrementLoss", "NonFiniteLossError", "WindowLoss"]
