"""Ensembles: many members trained, and predicting, at once."""

from pinn_dyn.ensembles.data import EnsembleData
from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.ensembles.learner import EnsembleLearner

__all__ = ["Ensemble", "EnsembleData", "EnsembleLearner"]
