"""Ensembles: many members that are trained and evaluated together."""

from typing import TYPE_CHECKING

from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.ensembles.posterior import posterior_draws
from pinn_dyn.ensembles.sampling import sampled_models
from pinn_dyn.lazy import lazy_attributes

if TYPE_CHECKING:
    from pinn_dyn.ensembles.learner import EnsembleLearner

__all__ = ["Ensemble", "EnsembleLearner", "posterior_draws", "sampled_models"]
__getattr__ = lazy_attributes(__name__)
