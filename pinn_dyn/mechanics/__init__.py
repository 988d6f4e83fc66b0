"""The equations of mechanics: systems, states, trajectories and their integration."""

from pinn_dyn.mechanics.ensemble import Ensemble
from pinn_dyn.mechanics.integration import rollout
from pinn_dyn.mechanics.predictor import ContinuousPredictor, Predictor, double_copy
from pinn_dyn.mechanics.system import MechanicalSystem, Terms
from pinn_dyn.mechanics.trajectory import Coordinates, Interpolation, Trajectory, stack

__all__ = [
    "ContinuousPredictor",
    "Coordinates",
    "Ensemble",
    "Interpolation",
    "MechanicalSystem",
    "Predictor",
    "Terms",
    "Trajectory",
    "double_copy",
    "rollout",
    "stack",
]
