"""Training: the LightningModule, losses and callbacks."""

from pinn_dyn.training.learner import DynamicsLearner, NonFiniteLossError
from pinn_dyn.training.losses import IncrementLoss

__all__ = ["DynamicsLearner", "IncrementLoss", "NonFiniteLossError"]
