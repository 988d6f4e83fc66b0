"""Ensembles: many members that are trained and evaluated together."""

from pinn_dyn.ensembles.data import EnsembleData
from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.ensembles.learner import EnsembleLearner
from pinn_dyn.ensembles.posterior import posterior_draws

__all__ = ["Ensemble", "EnsembleData", "EnsembleLearner", "posterior_draws"]
