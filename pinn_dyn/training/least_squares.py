"""Least squares for models of few parameters: from inverse dynamics, then on roll-outs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated

import numpy as np
import torch
from pydantic import Field, PositiveFloat
from scipy.optimize import least_squares
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pinn_dyn.data.windows import Windows
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.training.constants_fit import (
    Fit,
    Prior,
    StoppedFit,
    far_from_start,
    posterior_covariance,
)
from pinn_dyn.training.filtered_motion import correlation_length, filtered_motion
from pinn_dyn.training.sensitivity import rollout_slopes

log = logging.getLogger(__name__)

AtLeastTwo = Annotated[int, Field(ge=2)]
"""Number of samples or evaluations: one sample has no spread."""

_MOST_PARAMETERS = 500
_CHUNK = 500
"""Windows whose derivatives are rolled out at once; bounds the memory."""
_FIRST_NOISE = 0.1
"""Of the normalized residuals at most, before a fit has shown it."""
REST = 0.05
"""Part of a joint's typical speed below which it counts as at rest."""
_CHANGED = 5.0
"""Standard deviation of the parameters of a changed body: a payload may outweigh its link."""
_BROKEN = 1e4
"""Residual of a roll-out that breaks down."""


class LeastSquares:
    """Maximum a posteriori fit by Gauss-Newton (a trust region, ``scipy.optimize``)::

        min over z of  |r(z)|^2 / s^2 + (z - z_0)^T P (z - z_0)

    z are the standardized parameters of the model, so z_0 = 0 and P = 1 is its prior. After an
    earlier fit z_0 is what that found and P the inverse of its covariance, but for the bodies that
    have ``changed`` since: a payload is learned from seconds, as all the rest is known. Two stages,
    each started where the one before ended:

    1. inverse dynamics: r = k^-1 (M a + C v + G + D v + F - A u), each force in units of its
       spread, at samples of the motion after a zero-phase low-pass filter of ``cutoff`` Hz. The
       same filter on q, v, a and u leaves a linear law as it is. A joint at rest is left out, as
       dry friction may then have any value up to its level. This is the classical identification,
       here with constants that stay physical;
    2. roll-outs: r = predicted less measured increments of the windows, each in units of its
       spread, as of the loss of increments. Derivatives by forward mode through the integrator.
       First over a quarter of the windows' steps, then over all.

    s, by residual, is the root mean square of what remains, found by repeating each stage. What is
    correlated counts as one: successive samples of the motion by :func:`correlation_length`, the
    residuals within a window, and of windows that overlap, for each coordinate.

    Args:
        cutoff: of the filter before the inverse dynamics, Hz: above the motion, below the noise.
        rollouts: whether to take the second stage; without it the result is the identification.
        samples: samples of the inverse dynamics.
        evaluations: most evaluations of the residuals in a stage.
        velocity_weight: weight of the velocity half in the roll-outs, as of the loss.
        changed: bodies and other owners of constants, such as the ``tip`` in ``mass of tip``,
            that are others than in the earlier fit, and free again.
    """

    def __init__(
        self,
        *,
        cutoff: PositiveFloat,
        rollouts: bool = True,
        samples: AtLeastTwo = 2000,
        evaluations: AtLeastTwo = 25,
        velocity_weight: PositiveFloat = 1.0,
        changed: Sequence[str] = (),
    ):
        self.cutoff = cutoff
        self.rollouts = rollouts
        self.samples = samples
        self.evaluations = evaluations
        self.velocity_weight = velocity_weight
        self.changed = list(changed)

    def fit(
        self,
        model: LearnedConstants,
        trajectories: Sequence[Trajectory],
        windows: Windows,
        covariance: Tensor | None = None,
        stopped: Fit | None = None,
    ) -> Fit:
        """Fit the model in place; it comes back in the precision it had.

        Args:
            model: what is fitted.
            trajectories: the training trajectories, for the inverse dynamics.
            windows: the training windows, for the roll-outs.
            covariance: of the z that the model has from an earlier fit, ``(P, P)``, if any.
            stopped: this very fit, if it was stopped, to go on from the z that the model has.

        Raises:
            ValueError: on a model without parameters or with more than 500, trajectories that are
                too short for the filter, fewer residuals than parameters without an earlier fit, a
                covariance that is none or of another model, or changed bodies that the model does
                not have, or without an earlier fit.
            StoppedFit: on an interrupt; the model then has the best z so far.
        """
        count = sum(p.numel() for p in model.parameters())
        if not 0 < count <= _MOST_PARAMETERS:
            raise ValueError(
                f"the model has {count} parameters, least squares takes 1 to {_MOST_PARAMETERS}: "
                "take a gradient method (optimizer=adamw) or a smaller model"
            )
        precision = next(model.parameters()).dtype
        model.double()
        prior = stopped.prior if stopped else self._prior(model, covariance)
        earlier = covariance is not None
        stages: list[Callable[[], Fit]] = [
            partial(self._identify, model, prior, trajectories, earlier)
        ]
        if self.rollouts:
            windows = windows.to(torch.device("cpu"), torch.float64)
            steps, size = len(windows.t) - 1, len(windows) * model.num_coordinates
            _require_enough(
                size * _halves(steps) * steps,
                count,
                f"{len(windows)} windows of {steps} steps",
                "take more windows (data.pairs) or longer ones (data.steps)",
                earlier,
            )
            # Short ones first: long ones break down, or end in a poor minimum, from a poor start.
            short = -(-steps // 4)
            enough = size * _halves(short) * short >= count
            for length in [short, steps] if enough and short < steps else [steps]:
                stages.append(partial(self._roll_out, model, prior, windows.first(length)))
        found, number = stopped, (stopped.stopped_in or 0) if stopped else 0
        try:
            while number < len(stages):
                found = stages[number]()
                number += 1
        except KeyboardInterrupt as interrupt:
            nothing = torch.zeros_like(prior.root)
            known = found or Fit(
                posterior_covariance(nothing, prior.root), nothing, prior, float("nan"), 0
            )
            raise StoppedFit(replace(known, stopped_in=number)) from interrupt
        finally:
            model.to(precision)
        assert found is not None
        z = parameters_to_vector(model.parameters()).detach().to(prior.mean)
        for line in far_from_start(model.parameter_names(), z, prior):
            log.warning("least squares: %s", line)
        return found

    def _prior(self, model: LearnedConstants, covariance: Tensor | None) -> Prior:
        z, names = parameters_to_vector(model.parameters()).detach(), model.parameter_names()
        if covariance is None:
            if self.changed:
                raise ValueError(
                    f"changed is {self.changed}, but there is no earlier fit that "
                    "they have changed since: name its run, start_from=<run>"
                )
            return Prior(0 * z, torch.eye(len(z)).to(z))
        owners = [name.split(" of ", 1)[-1] for name in names]
        if unknown := [one for one in self.changed if one not in owners]:
            raise ValueError(
                f"changed names {', '.join(unknown)}, expected some of "
                f"{', '.join(dict.fromkeys(owners))}"
            )
        if covariance.shape != (len(z), len(z)):
            raise ValueError(
                f"the earlier fit has {len(covariance)} constants, this model {len(z)}: take the "
                "friction and the drive gains of that run"
            )
        free = torch.tensor([owner in self.changed for owner in owners])
        held = ~free
        spread = torch.where(
            held[:, None] & held, covariance.to(z), torch.diag(_CHANGED**2 * free.to(z))
        )
        factor, failed = torch.linalg.cholesky_ex(spread)
        if failed:
            raise ValueError(
                "the covariance of the earlier fit is no positive definite matrix of finite "
                "numbers: its checkpoint is damaged, fit it again"
            )
        # Not by way of the inverse: rounding makes it indefinite where much is known for certain.
        root = torch.linalg.solve_triangular(factor, torch.eye(len(z)).to(z), upper=False)
        return Prior(z, root)

    def _identify(
        self,
        model: LearnedConstants,
        prior: Prior,
        trajectories: Sequence[Trajectory],
        earlier: bool,
    ) -> Fit:
        q, v, a, u = filtered_motion(trajectories, self.cutoff, self.samples)
        with torch.no_grad():
            spread = model.force_scale(q, v, a, u)
        moves = v.abs() > REST * v.std(0)
        if not moves.any():
            raise ValueError(
                "least squares: nothing moves in the training trajectories, expected motions that "
                "show the constants: excite the robot"
            )
        _require_enough(
            int(moves.sum()),
            len(prior.mean),
            f"{len(q)} samples of filtered motion, without joints at rest,",
            "record longer motions of all joints, or raise optimizer.samples",
            earlier,
        )
        samples = model.samples(q, v, a, u)

        def errors() -> Tensor:
            return samples.missing_force() / model.drive_gain() / spread

        def residuals(derivative: bool) -> Tensor:
            error = errors()
            if not derivative:
                return error[moves]
            by_gain = (error * spread).unsqueeze(-1) * model.slopes().gain()
            by_z = samples.by_parameters() - by_gain
            return (by_z / (model.drive_gain() * spread).unsqueeze(-1))[moves]

        self._solve("inverse dynamics", model, prior, residuals, correlated=1.0)
        with torch.no_grad():
            correlated = correlation_length((errors() * moves).numpy())
        stage = f"inverse dynamics, {correlated:.3g} samples as one"
        return self._solve(stage, model, prior, residuals, correlated=correlated)

    def _roll_out(self, model: LearnedConstants, prior: Prior, windows: Windows) -> Fit:
        scale = windows.statistics().qv_increment_std.clone()
        scale[:, model.num_coordinates :] /= self.velocity_weight**0.5
        x0, measured = windows.start("qv"), windows.increments("qv")
        first = (2 - _halves(measured.shape[1])) * model.num_coordinates

        def residuals(derivative: bool) -> Tensor:
            if derivative:
                parts = [rollout_slopes(model, part) for part in windows.split(_CHUNK)]
                return (torch.cat(parts) / scale.unsqueeze(-1))[:, :, first:]
            predicted = model.increments(x0, windows.t, windows.input)
            return ((predicted[:, 1:] - measured) / scale)[..., first:]

        correlated = float(measured.shape[1])
        stage = f"roll-outs of {float(windows.t[-1]):.3g} s"
        return self._solve(stage, model, prior, residuals, correlated=correlated)

    def _solve(
        self,
        stage: str,
        model: LearnedConstants,
        prior: Prior,
        residuals: Callable[[bool], Tensor],
        *,
        correlated: float,
    ) -> Fit:
        """Two fits, the second with the noise that the first left; the model is set in place.

        ``residuals`` gives those of the model as it is, ``(..., R)``, or their derivatives
        ``(..., R, P)``; ``correlated`` of them count as one.
        """
        z = parameters_to_vector(model.parameters()).detach()
        mean, root = prior.mean.numpy(), prior.root.numpy()

        def spread(at: np.ndarray) -> float:
            remains = np.mean(_evaluate(model, at, residuals, False) ** 2)
            return max(float(np.sqrt(remains)), np.finfo(float).eps)

        noise, steps = min(spread(z.numpy()), _FIRST_NOISE), 0
        best = np.inf, z.numpy()
        for _ in range(2):
            weight = 1 / (noise * correlated**0.5)
            best = np.inf, best[1]

            def value(at: np.ndarray, weight: float = weight) -> np.ndarray:
                nonlocal best
                data = weight * _evaluate(model, at, residuals, False)
                every = np.concatenate([data, root @ (at - mean)])
                if (cost := float(every @ every)) < best[0]:
                    best = cost, at.copy()
                return every

            def slope(at: np.ndarray, weight: float = weight) -> np.ndarray:
                data = weight * _evaluate(model, at, residuals, True).reshape(-1, len(at))
                return np.concatenate([data, root])

            limit = {"max_nfev": self.evaluations, "ftol": 1e-4, "xtol": 1e-4, "gtol": 1e-8}
            try:
                found = least_squares(value, z.numpy(), slope, **limit)
            except KeyboardInterrupt:
                vector_to_parameters(torch.from_numpy(best[1]), model.parameters())
                raise
            z = torch.from_numpy(found.x)
            noise = spread(found.x)
            steps += int(found.njev)
            log.info("least squares, %s: residual %.4f after %d steps", stage, noise, steps)
        slopes = torch.from_numpy(found.jac[: -len(z)])
        information = slopes.T @ slopes
        covariance = posterior_covariance(information, prior.root)
        return Fit(covariance, information, prior, noise, steps)


def _evaluate(
    model: LearnedConstants, z: np.ndarray, residuals: Callable[[bool], Tensor], derivative: bool
) -> np.ndarray:
    """Residuals at z, flattened; a roll-out that breaks down is a bad step, not an error."""
    with torch.no_grad():
        vector_to_parameters(torch.from_numpy(z), model.parameters())
        found = residuals(derivative)
    bad = 0.0 if derivative else _BROKEN
    values = np.nan_to_num(found.flatten().numpy(), nan=bad, posinf=bad, neginf=-bad)
    return values if derivative else values.clip(-_BROKEN, _BROKEN)


def _halves(steps: int) -> int:
    """Of q and v, how many say something of an increment: where dq/dt = v, q none of one step."""
    return 1 if steps == 1 else 2


def _require_enough(found: int, constants: int, where: str, remedy: str, earlier: bool) -> None:
    """Refuse fewer residuals than constants, which are met exactly, as if there were no noise.

    After an earlier fit it is a warning: only what has changed is free.

    Raises:
        ValueError: with the counts.
    """
    if found >= constants:
        return
    said = (
        f"{where} give {found} residuals for {constants} constants, expected at least as many: "
        f"fewer are met exactly, as if there were no noise; {remedy}"
    )
    if not earlier:
        raise ValueError(f"least squares: {said}")
    log.warning("least squares: %s", said)
