"""Losses of predicted windows."""

from pinn_dyn.training.losses.increment import IncrementLoss
from pinn_dyn.training.losses.midpoint import MidpointLoss
from pinn_dyn.training.losses.window_loss import Penalized, WindowLoss

__all__ = ["IncrementLoss", "MidpointLoss", "Penalized", "WindowLoss"]
