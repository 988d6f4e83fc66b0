"""Training: the LightningModule, losses and callbacks."""

from pinn_dyn.training.checkpoints import WholeCheckpoints
from pinn_dyn.training.ensemble import EnsembleLearner
from pinn_dyn.training.fit import fit
from pinn_dyn.training.impulse import ImpulseLoss
from pinn_dyn.training.learner import DynamicsLearner, NonFiniteLossError
from pinn_dyn.training.losses import IncrementLoss, WindowLoss
from pinn_dyn.training.member_soap import MemberSOAP
from pinn_dyn.training.midpoint import MidpointLoss
from pinn_dyn.training.schedule import one_cycle

__all__ = [
    "DynamicsLearner",
    "EnsembleLearner",
    "ImpulseLoss",
    "IncrementLoss",
    "MemberSOAP",
    "MidpointLoss",
    "NonFiniteLossError",
    "WholeCheckpoints",
    "WindowLoss",
    "fit",
    "one_cycle",
]
