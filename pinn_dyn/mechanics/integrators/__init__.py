"""One-step methods, one per file, and the loop over their steps."""

from pinn_dyn.mechanics.integrators.integrator import Dynamics, Integrator
from pinn_dyn.mechanics.integrators.rk4 import RK4
from pinn_dyn.mechanics.integrators.rosenbrock import Rosenbrock
from pinn_dyn.mechanics.integrators.sticking import Sticking, with_friction

__all__ = ["RK4", "Dynamics", "Integrator", "Rosenbrock", "Sticking", "with_friction"]
