"""Least squares as a LightningModule: one training step is the whole fit."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import torch
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor
from torch.optim import SGD

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Predictor, Trajectory
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.constants_fit import COVARIANCE, FIT, Fit, StoppedFit
from pinn_dyn.training.learner import DynamicsLearner, Validator
from pinn_dyn.training.least_squares import LeastSquares
from pinn_dyn.training.losses import WindowLoss


class LeastSquaresLearner(DynamicsLearner):
    """LightningModule that fits a model by least squares in a single training step.

    The trainer has ``steps: 1`` and ``validations: 1``, and one batch contains all windows. SIGTERM
    and Ctrl-C interrupt a fit at any time. It continues from the checkpoint that is then written.

    Args:
        model, solver: the model to fit, and the least-squares solver.
        part_errors: function from a model and true trajectories to the errors of parts of the
            motions, ``(V,)``, to compare the stages of the fit.
        covariance: covariance of the initial constants from an earlier fit, if any.
        loss, validator, config, statistics: see :class:`DynamicsLearner`.

    Attributes:
        result: result of the fit, once it is finished or interrupted.

    Raises:
        TypeError: if the parameters of the model are not physical constants.
    """

    result: Fit | None = None

    def __init__(
        self,
        model: LearnedConstants,
        *,
        solver: LeastSquares,
        part_errors: Callable[[Predictor, Trajectory], Tensor],
        covariance: Tensor | None = None,
        loss: WindowLoss,
        validator: Validator,
        config: dict[str, Any],
        statistics: Statistics,
    ):
        if not isinstance(model, LearnedConstants):
            raise TypeError(
                "least squares fits physical constants (model=known or known_system), not "
                f"{type(model).__name__}: use optimizer=adamw"
            )
        super().__init__(
            model,
            loss=loss,
            optimizer=SGD,
            scheduler=torch.optim.lr_scheduler.ConstantLR,
            validator=validator,
            config=config,
            statistics=statistics,
            compile=False,
        )
        self.solver, self.part_errors, self.covariance = solver, part_errors, covariance

    def training_step(self, batch: Windows, batch_idx: int) -> None:  # type: ignore[override]
        """Fit the model on all training trajectories and windows, in double precision."""
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        assert isinstance(self.model, LearnedConstants)
        if self.result is None or self.result.stopped_in is not None:
            try:
                with _sigterm_interrupts():
                    self.result = self.solver.fit(
                        self.model,
                        data.splits.train,
                        data.windows,
                        self.covariance,
                        self.result,
                        self._validation_errors,
                    )
            except StoppedFit as stopped:
                self.result = stopped.fit
                if self.trainer.received_sigterm:
                    raise SIGTERMException from stopped
                raise
        self.log_losses(torch.tensor(self.result.residual**2))
        self.optimizers().step()  # type: ignore[union-attr]  # only counts the step

    def _validation_errors(self, model: LearnedConstants) -> Tensor:
        (truth,) = self.trainer.datamodule.val_dataloader()  # type: ignore[attr-defined]
        with torch.no_grad():
            return self.part_errors(model, truth)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Save the fit, and its covariance for later fits."""
        if self.result is not None:
            checkpoint[COVARIANCE] = self.result.covariance
            checkpoint[FIT] = self.result.state()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Continue the fit of the checkpoint, if any."""
        if FIT in checkpoint:
            count = sum(p.numel() for p in self.model.parameters())
            self.result = Fit.from_state(checkpoint[FIT], count)

    def configure_optimizers(self) -> Any:
        """Return an optimizer that does nothing; the trainer counts its steps."""
        return SGD(self.model.parameters(), lr=0.0)


@contextlib.contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM within a context, since a step takes minutes."""
    before = signal.getsignal(signal.SIGTERM)

    def interrupt(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, before)  # once, since the result is then being saved
        if callable(before):
            before(number, frame)  # the handler of the trainer
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # which alone receives signals
        yield
        return
    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
