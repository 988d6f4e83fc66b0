"""Training of an ensemble: many seeds at once, as one batched model."""

from __future__ import annotations

import torch
from pytorch_optimizer import SOAP
from torch import Tensor
from torch.optim import SGD, Adagrad, Adam, Adamax, NAdam, Optimizer, RAdam, RMSprop

from pinn_dyn.ensembles.ensemble import Ensemble
from pinn_dyn.ensembles.gradients import CompiledMembers
from pinn_dyn.ensembles.member_soap import MemberSOAP
from pinn_dyn.ensembles.stack import ContinuousStack
from pinn_dyn.training import DynamicsLearner
from pinn_dyn.training.gradients import Eager, Engine

# Optimizers that treat every number on its own: for them E stacked weights are E trainings.
_ELEMENTWISE = (Adam, NAdam, RAdam, Adamax, Adagrad, RMSprop, SGD)


class EnsembleLearner(DynamicsLearner):
    """Trains the members of an :class:`Ensemble` side by side, each as if it were alone.

    A batch of windows has a leading dimension E, one batch for each member. The loss is the sum of
    the members' losses, so that each member's gradient is that of its own loss; gradients are
    clipped by each member's own norm; the optimizer moves every weight by itself, or with the
    others of its member (:class:`MemberSOAP`). Validation rolls out the ensemble.

    Args and errors: as :class:`DynamicsLearner`.

    Raises:
        ValueError: at the start of the training, if the optimizer mixes the entries of a tensor,
            and so the members.
    """

    model: Ensemble

    def gradients(self, steps: int) -> Engine:
        """Those of the members, each in its own parameters."""
        stack = self.model.stack
        if self._compile and isinstance(stack, ContinuousStack):
            return CompiledMembers(self.loss, stack)
        return Eager(self.loss, stack)

    def log_losses(self, losses: Tensor) -> None:
        """Log mean and standard deviation over the members."""
        super().log_losses(losses)
        self.log("train/loss_spread", losses.std(), on_step=False, on_epoch=True, batch_size=1)

    def built_optimizer(self) -> Optimizer:
        """The optimizer, SOAP with preconditioners of each member's own."""
        optimizer = super().built_optimizer()
        if isinstance(optimizer, SOAP):
            return MemberSOAP(optimizer)
        if not isinstance(optimizer, _ELEMENTWISE):
            raise ValueError(
                f"optimizer is {type(optimizer).__name__}, which mixes the weights of a tensor, "
                "here those of different members: take optimizer=adamw or soap, or train the seeds "
                "one by one (train.py -m seed=0,1,2)"
            )
        return optimizer

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: int | float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip each member's gradient by its own norm, as a training of its own would."""
        if gradient_clip_val is None:
            return
        if gradient_clip_algorithm == "value":  # of single numbers: the same for an ensemble
            super().configure_gradient_clipping(
                optimizer, gradient_clip_val, gradient_clip_algorithm
            )
            return
        gradients = [p.grad for p in self.model.parameters() if p.grad is not None]
        clip_by_member(gradients, float(gradient_clip_val))


def clip_by_member(gradients: list[Tensor], largest: float) -> None:
    """Scale gradients ``(E, ...)`` in place so that each member's norm is at most ``largest``.

    The norm of a member is that of all its gradients together, as in
    ``torch.nn.utils.clip_grad_norm_``.
    """
    squares = [gradient.reshape(gradient.shape[0], -1).square().sum(1) for gradient in gradients]
    norms = torch.stack(squares).sum(0).sqrt()
    scales = (largest / (norms + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(scales.reshape(-1, *[1] * (gradient.ndim - 1)))
