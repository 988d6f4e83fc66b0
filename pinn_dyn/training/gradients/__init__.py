"""Gradient engines: eager autograd, or compiled programs."""

from pinn_dyn.training.gradients.compiled import Compiled
from pinn_dyn.training.gradients.eager import Eager, Engine

__all__ = ["Compiled", "Eager", "Engine"]
