"""How the gradient of a loss is taken: by autograd as it stands, or by compiled programs."""

from pinn_dyn.training.gradients.compiled import Compiled
from pinn_dyn.training.gradients.eager import Eager, Engine

__all__ = ["Compiled", "Eager", "Engine"]
