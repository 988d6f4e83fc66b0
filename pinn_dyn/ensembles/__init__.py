"""Ensembles: several models of one robot, whose predictions have a mean and a spread."""

from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.ensembles.sampling import posterior_draws, sampled_models

__all__ = ["Ensemble", "posterior_draws", "sampled_models"]
