"""Training of an ensemble: many seeds at once, as one batched model."""

from __future__ import annotations

from torch import Tensor
from torch.optim import Optimizer

from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.ensembles.gradients import CompiledMembers
from pinn_dyn.ensembles.stack import ContinuousStack
from pinn_dyn.mechanics import Predictor
from pinn_dyn.models.output_limits import joint_limits, output_limits
from pinn_dyn.training import ELEMENTWISE, SOAP, DynamicsLearner, ParameterVector
from pinn_dyn.training.gradients import Eager, Engine


class EnsembleLearner(DynamicsLearner):
    """LightningModule that trains the members of an :class:`Ensemble` together and independently.

    Windows ``(E, B, ...)`` have a batch for each member. The loss is the sum of the losses of the
    members, so their gradients are independent, and clipped by the norm of each member. Validation
    rolls out the ensemble. Arguments and errors are those of :class:`DynamicsLearner`.

    Raises:
        ValueError: in training, if the optimizer mixes the entries of a tensor, and so the members.
    """

    model: Ensemble

    def output_limits(self, model: Predictor, q: Tensor) -> dict[str, Tensor]:
        assert isinstance(model, Ensemble)
        limits = [output_limits(model.member(k), q) for k in range(model.size)]
        return {f"{model.prefix}{name}": x for name, x in joint_limits(limits).items()}

    def parameter_vector(self) -> ParameterVector:
        return ParameterVector(self.model.parameters(), self.model.size)

    def gradients(self, vector: ParameterVector, steps: int) -> Engine:
        stack = self.model.stack
        if self._compile and isinstance(stack, ContinuousStack):
            return CompiledMembers(self.loss, stack, vector)
        return Eager(self.loss, stack, vector)

    def loss_figures(self, losses: Tensor) -> dict[str, Tensor]:
        return {**super().loss_figures(losses), "train/loss_spread": losses.std()}

    def built_optimizer(self, vector: ParameterVector) -> Optimizer:
        optimizer = super().built_optimizer(vector)
        if type(optimizer) is SOAP:
            return MemberSOAP(vector.parameters, **optimizer.defaults)
        if type(optimizer) not in ELEMENTWISE:
            raise ValueError(
                f"optimizer is {type(optimizer).__name__}, which mixes the weights of different "
                "members: use optimizer=adamw or optimizer=soap"
            )
        return optimizer


class MemberSOAP(SOAP):
    """SOAP on parameters ``(E, ...)`` with preconditioners for each of the E members."""

    leading = 1
