"""The equations of mechanics: systems, states, trajectories and their integration."""

from pinn_dyn.mechanics.input_solver import InputSolver
from pinn_dyn.mechanics.integrators import RK4, Integrator, Rosenbrock
from pinn_dyn.mechanics.predictor import ContinuousPredictor, Predictor, double_copy
from pinn_dyn.mechanics.rollout import rollout
from pinn_dyn.mechanics.signal import Interpolation, Signal
from pinn_dyn.mechanics.sum import Sum
from pinn_dyn.mechanics.system import MechanicalSystem, Terms
from pinn_dyn.mechanics.trajectory import State, Trajectory, samples_of, stack, stack_until

__all__ = [
    "RK4",
    "ContinuousPredictor",
    "InputSolver",
    "Integrator",
    "Interpolation",
    "MechanicalSystem",
    "Predictor",
    "Rosenbrock",
    "Signal",
    "State",
    "Sum",
    "Terms",
    "Trajectory",
    "double_copy",
    "rollout",
    "samples_of",
    "stack",
    "stack_until",
]
