"""Ensembles: several models of one robot, whose predictions have a mean and a spread."""

from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.ensembles.posterior import posterior_draws
from pinn_dyn.ensembles.sampling import sampled_models

__all__ = ["Ensemble", "posterior_draws", "sampled_models"]
