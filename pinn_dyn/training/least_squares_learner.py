"""Least squares as a LightningModule: one training step is the whole fit."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

import torch
from lightning.pytorch.utilities.exceptions import SIGTERMException
from torch import Tensor
from torch.optim import SGD

from pinn_dyn.data.windows import Windows
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.training.constants_fit import Fit, StoppedFit
from pinn_dyn.training.learner import DynamicsLearner, Validator
from pinn_dyn.training.least_squares import LeastSquares
from pinn_dyn.training.losses import WindowLoss

COVARIANCE = "covariance"
"""Under which a checkpoint has that of the constants."""
_FIT = "fit"


class LeastSquaresLearner(DynamicsLearner):
    """Fits a model by least squares where others take many steps of an optimizer.

    So a fit has the run folder, checkpoints, validation and logs of every training. The trainer has
    ``steps: 1`` and ``validations: 1``; one batch holds all windows. SIGTERM and Ctrl-C end a fit
    at once, wherever it is: it goes on from the checkpoint that is written then.

    Args:
        model: what is fitted.
        solver: the fit.
        covariance: of the constants that the model starts from, if an earlier fit found them.
        loss, validator, config, statistics: as of :class:`DynamicsLearner`.

    Attributes:
        result: of the fit, once it is done or was stopped.

    Raises:
        TypeError: unless the parameters of the model are physical constants.
    """

    result: Fit | None = None

    def __init__(
        self,
        model: LearnedConstants,
        *,
        solver: LeastSquares,
        covariance: Tensor | None = None,
        loss: WindowLoss,
        validator: Validator,
        config: dict[str, Any],
        statistics: Statistics,
    ):
        if not isinstance(model, LearnedConstants):
            raise TypeError(
                "least squares fits physical constants (model=known or known_system), not "
                f"{type(model).__name__}: take optimizer=adamw"
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
        self.solver = solver
        self.covariance = covariance

    def training_step(self, batch: Windows, batch_idx: int) -> None:  # type: ignore[override]
        """The fit, on all training trajectories and windows, in double precision."""
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        assert isinstance(self.model, LearnedConstants)
        if self.result is None or self.result.stopped_in is not None:
            try:
                with _sigterm_interrupts():
                    self.result = self.solver.fit(
                        self.model, data.splits.train, data.windows, self.covariance, self.result
                    )
            except StoppedFit as stopped:
                self.result = stopped.fit
                if self.trainer.received_sigterm:
                    raise SIGTERMException from stopped
                raise
        self.log_losses(torch.tensor(self.result.residual**2))
        self.optimizers().step()  # type: ignore[union-attr]  # no gradients: it only counts

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the fit, and its covariance for one that starts from it."""
        if self.result is not None:
            checkpoint[COVARIANCE] = self.result.covariance
            checkpoint[_FIT] = self.result.state()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Go on with the fit of the checkpoint, if it has one.

        Raises:
            ValueError: if what it has is none.
        """
        if _FIT in checkpoint:
            count = sum(p.numel() for p in self.model.parameters())
            self.result = Fit.from_state(checkpoint[_FIT], count)

    def configure_optimizers(self) -> Any:
        """One that does nothing, as the trainer counts its steps."""
        return SGD(self.model.parameters(), lr=0.0)


@contextlib.contextmanager
def _sigterm_interrupts() -> Iterator[None]:
    """SIGTERM raises KeyboardInterrupt, as Ctrl-C does: who waits for a step waits for minutes."""
    before = signal.getsignal(signal.SIGTERM)

    def interrupt(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, before)  # once: what was found is being kept by then
        if callable(before):
            before(number, frame)  # the trainer's, which makes a note of it
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():  # which alone gets signals
        yield
        return
    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
