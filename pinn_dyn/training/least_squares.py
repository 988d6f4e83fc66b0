"""Least-squares fits of models with few parameters, by inverse dynamics and by rollouts."""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal

import scipy
import torch
from pydantic import Field, PositiveFloat
from torch import Tensor
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from pinn_dyn.data.windows import Windows, draw_windows
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.mechanics.arrays import spd_solve
from pinn_dyn.mechanics.sliding import hold
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.progress import Progress
from pinn_dyn.training.constants_fit import (
    UNKNOWN,
    Fit,
    Prior,
    block_scores,
    doubtful_units,
    left_out,
    posterior_covariance,
)
from pinn_dyn.training.filtered_motion import filtered_motion
from pinn_dyn.training.gauss_newton import GaussNewton
from pinn_dyn.training.sensitivity import WindowRollouts

log = logging.getLogger(__name__)

AtLeastTwo = Annotated[int, Field(ge=2)]
"""Number of samples or evaluations: one sample has no spread."""

REST = 0.05
"""Share of the typical speed of a joint below which it is considered at rest."""
_CHEAP = 8  # evaluations of the inverse dynamics in the time of one rollout
_BLOCKS = 30  # blocks of the motion, and neighborhoods of windows
_SPEEDS = 16  # blocks of the speeds of a joint
_CHANGED = 5.0  # prior standard deviation of a changed body, which may be a heavy payload
_SCALE = 100.0  # root of the prior precision of the last mass of a robot without inputs
_LEVEL = 0.95  # level of the one-sided test for a larger validation error
_NOISE = 0.2  # largest relative difference of validation errors that may be noise
_FEWEST_WINDOWS = 10
_EXACT = 1e-3  # tolerance of the inverse dynamics, whose steps are cheap
_IMPROVED = 0.95  # of the validation error, from which longer windows follow
_HELD = 1e3  # root of the precision of constants that are held
_FEWEST_RUNS = 5  # that can be left out: without one of three, a fit differs by more than a step
_SATURATED = 0.01  # filtered share of saturated samples, from which a sample is left out
_DIVERGED = 1e4  # residual of a diverged rollout
IDENTIFICATION = "inverse dynamics"
"""Name of the first stage."""


Residuals = Callable[[bool], Tensor]
"""Residuals of the present model, ``(..., R)``, or their derivatives ``(..., R, P)``."""


class LeastSquares:
    """Maximum a posteriori fit by Gauss-Newton steps (:class:`~.gauss_newton.GaussNewton`)::

        min over z of  w^2 sum of rho(r(z)) + (z - z_0)^T P (z - z_0)

    z are the standardized parameters of the model, with the prior z_0 = 0 and P = 1. After an
    earlier fit, z_0 is its result and P the inverse of its covariance, except for bodies that have
    ``changed`` since, such as a payload. A fit has two kinds of stages:

    1. Inverse dynamics: r = k^-1 (M a + C v + G + D v + F - A u), in units of the spread of the
       forces, at samples of the motion after a zero-phase low-pass filter of ``cutoff`` Hz. Joints
       at rest are excluded, since dry friction may then have any value up to its level, and drives
       near a saturated sample, for limits in the model. If a joint
       has no input, r is the error of the acceleration instead: zero bodies would have no error of
       the force at such a joint. Without any input, no common factor of the forces changes the
       motion, and the mass of the last body stays that of the prior. If the force is not linear
       in the input, as for drives that saturate, rollouts start from the prior: the force at
       the filtered input is not the filtered force.
    2. Rollouts: r = predicted minus measured increments of the windows, in units of their spread,
       as in the increment loss. The first rollouts use a quarter of the steps of the windows. While
       a stage lowers the validation error by 5 %, windows of twice the length and half the number
       follow.

    A stage of rollouts ends when a step lowers the cost by less than its standard deviation by the
    noise (:meth:`~.gauss_newton.GaussNewton.minimize`), that of the inverse dynamics later.

    The kept stage is the last one whose validation error is not clearly larger than the smallest,
    since later stages fit what is predicted; windows longer than the given ones are kept only if
    the error is smaller. An error is clearly larger if it is 20 % larger, or if
    a paired t-test over V parts of the validation motions is significant (95 %, one-sided). Without
    validation, the last stage is kept.

    rho is the square for the inverse dynamics. The rollouts use soft L1 by default: windows that no
    constants explain, such as after a contact, do not bend the constants. The covariance of z
    follows from sums over blocks (:func:`~.constants_fit.block_scores`): successive samples or
    neighboring windows, and similar speeds of a joint, at which an error of the friction law
    repeats. Optional effects (:meth:`LearnedConstants.absent_parameters`), such as a loss
    by load, stay only if a fit with them has a smaller validation error than one without.

    Args:
        cutoff: cutoff of the filter, Hz, above the frequencies of the motion and below the noise.
        rollouts: true for all stages, false for the identification only.
        samples: number of samples of the inverse dynamics.
        evaluations: largest number of evaluations of the residuals in a stage.
        velocity_weight: weight of the velocity half in the rollouts, as in the loss.
        changed: bodies, such as ``tip`` in ``mass of tip``, that are fitted anew.
        loss: loss of the rollouts, ``"soft_l1"`` or ``"squares"``.
    """

    def __init__(
        self,
        *,
        cutoff: PositiveFloat = 6.0,
        rollouts: bool = True,
        samples: AtLeastTwo = 2000,
        evaluations: AtLeastTwo = 25,
        velocity_weight: PositiveFloat = 1.0,
        changed: Sequence[str] = (),
        loss: Literal["soft_l1", "squares"] = "soft_l1",
    ):
        self.cutoff, self.rollouts, self.samples = cutoff, rollouts, samples
        self.evaluations, self.velocity_weight = evaluations, velocity_weight
        self.changed, self.loss = list(changed), loss

    def fit(
        self,
        model: LearnedConstants,
        trajectories: Sequence[Trajectory],
        windows: Windows | None = None,
        covariance: Tensor | None = None,
        stopped: Fit | None = None,
        validate: Callable[[LearnedConstants], Tensor] | None = None,
        keep: Callable[[Fit], None] = lambda _: None,
    ) -> Fit:
        """Fit the model in place. Its precision does not change.

        Args:
            model: the model to fit.
            trajectories: training trajectories for the inverse dynamics.
            windows: training windows for the rollouts; not needed if ``rollouts`` is false.
            covariance: covariance of the initial z from an earlier fit, ``(P, P)``, if any.
            stopped: interrupted result of this fit, to continue from the present z.
            validate: validation errors ``(V,)`` of a model, to compare the stages.
            keep: function that saves the unfinished result and the present z of the model, called
                between two stages and on an interrupt, with the best z of its stage.

        Raises:
            ValueError: if trajectories are too short for the filter, there are fewer residuals than
                parameters, the covariance does not fit the model, or changed bodies are unknown.
        """
        fit = partial(self._fit, trajectories=trajectories, windows=windows, covariance=covariance)
        fit = partial(fit, stopped=stopped, validate=validate)
        absent = model.absent_parameters()
        if absent is None or validate is None or stopped or covariance is not None:
            return fit(model, keep=keep)
        simple = copy.deepcopy(model)
        second, first = fit(model, keep=keep), fit(simple, absent=absent)
        names = [model.parameter_names()[k] for k in absent.isfinite().nonzero().flatten()]
        text = f"validation errors {first.errors.mean():.4g} without, {second.errors.mean():.4g}"
        if second.errors.mean() < first.errors.mean():
            log.info("least squares keeps %s: %s with", ", ".join(names), text)
            return second
        log.info("least squares leaves out %s: %s with", ", ".join(names), text)
        vector_to_parameters(parameters_to_vector(simple.parameters()), model.parameters())
        return first

    def _fit(
        self,
        model: LearnedConstants,
        trajectories: Sequence[Trajectory],
        windows: Windows | None,
        covariance: Tensor | None,
        stopped: Fit | None,
        validate: Callable[[LearnedConstants], Tensor] | None,
        keep: Callable[[Fit], None] = lambda _: None,
        absent: Tensor | None = None,
    ) -> Fit:
        """Fit all constants, or hold those at the finite values ``absent``, ``(P,)``."""
        count = sum(p.numel() for p in model.parameters())
        precision = next(model.parameters()).dtype
        model.double()
        prior = stopped.prior if stopped else self._prior(model, covariance)
        if absent is not None:
            held = absent.isfinite()
            root = torch.where(held, _HELD, 1.0) * torch.eye(count, dtype=torch.float64)
            prior = Prior(torch.where(held, absent.double(), prior.mean), root @ prior.root)
            vector_to_parameters(prior.mean, model.parameters())
        earlier = covariance is not None
        may_grow = validate is not None
        stages, planned = self._stages(model, prior, trajectories, windows, earlier, may_grow)
        best, number = stopped, (stopped.stopped_in or 0) if stopped else 0
        lowest = best.errors if best else UNKNOWN
        identified = best.identified if best else None
        texts = [f"{best.stage} {lowest.mean():.4g}"] if best and best.stage else []
        try:
            for stage, solve in list(stages.items())[number:]:
                result = solve()
                if stage == IDENTIFICATION:
                    identified = result.z
                errors = UNKNOWN if validate is None else validate(model)
                texts.append(f"{stage} {errors.mean():.4g}")
                worse = _clearly_larger(errors, lowest)
                if number >= planned:  # longer windows must predict better
                    worse = bool(errors.mean() > lowest.mean())
                kept = best if best and worse else result
                grows = errors.mean() < _IMPROVED * lowest.mean()
                lowest = lowest if lowest.mean() <= errors.mean() else errors
                best = replace(kept, stage=kept.stage or stage, errors=lowest)
                number += 1
                if number >= planned and not grows:
                    break
                keep(replace(best, stopped_in=number, identified=identified))
        except (KeyboardInterrupt, SystemExit):
            zero = torch.zeros_like(prior.root)
            covariance = posterior_covariance(zero, prior.root)
            unfinished = best or Fit(covariance, zero, prior, float("nan"), 0)
            keep(replace(unfinished, stopped_in=number, identified=identified))
            raise
        finally:
            model.to(precision)
        assert best is not None
        assert best.z is not None
        vector_to_parameters(best.z.to(precision), model.parameters())
        if validate is not None and len(stages) > 1:
            log.info("least squares keeps %s: validation errors %s", best.stage, ", ".join(texts))
        return replace(best, stopped_in=None, identified=identified)

    def _stages(
        self,
        model: LearnedConstants,
        prior: Prior,
        trajectories: Sequence[Trajectory],
        windows: Windows | None,
        earlier: bool,
        may_grow: bool,
    ) -> tuple[dict[str, Callable[[], Fit]], int]:
        """Return the stages by name, and the number of those before the windows grow."""
        stages: dict[str, Callable[[], Fit]] = {}
        if not self.rollouts or model.identified_by_forces:
            stages[IDENTIFICATION] = partial(self._identify, model, prior, trajectories, earlier)
        if not self.rollouts:
            return stages, len(stages)
        assert windows is not None
        windows = windows.to(torch.device("cpu"), torch.float64)
        count = sum(p.numel() for p in model.parameters())
        steps, size = len(windows.t) - 1, len(windows) * model.num_coordinates
        source = f"{len(windows)} windows of {steps} steps"
        remedy = "use more windows (data.pairs) or longer windows (data.steps)"
        residuals = size * _informative_blocks(steps) * steps
        _require_enough(residuals, count, source, remedy, earlier)
        # Short windows first: from a poor start, long windows diverge or end in a poor minimum.
        short = -(-steps // 4)
        enough = size * _informative_blocks(short) * short >= count
        lengths = [short, steps] if enough and short < steps else [steps]
        parts = [windows.first(length) for length in lengths]
        planned = len(stages) + len(parts)
        for part in [*parts, *(_longer(trajectories, windows) if may_grow else [])]:
            name = f"rollouts of {float(part.t[-1]):.3g} s"
            stages[name] = partial(self._roll_out, name, model, prior, trajectories, part)
        return stages, planned

    def _prior(self, model: LearnedConstants, covariance: Tensor | None) -> Prior:
        z, names = parameters_to_vector(model.parameters()).detach(), model.parameter_names()
        if covariance is None:
            if self.changed:
                raise ValueError(f"changed is {self.changed}, but there is no earlier fit")
            root = torch.eye(len(z)).to(z)
            masses = [k for k, name in enumerate(names) if name.startswith("mass of")]
            if masses and not model.num_inputs:
                log.info("no inputs: all constants are relative to the %s", names[masses[-1]])
                root[masses[-1], masses[-1]] = _SCALE
            return Prior(0 * z, root)
        owners = [name.split(" of ", 1)[-1] for name in names]
        if unknown := [owner for owner in self.changed if owner not in owners]:
            expected = ", ".join(dict.fromkeys(owners))
            raise ValueError(f"changed names {', '.join(unknown)}, expected some of {expected}")
        if covariance.shape != (len(z), len(z)):
            raise ValueError(
                f"the earlier fit has {len(covariance)} constants, this model {len(z)}: use the "
                "friction and the drive gains of the earlier run"
            )
        held = torch.tensor([owner not in self.changed for owner in owners])
        free = torch.diag(_CHANGED**2 * (~held).to(z))
        spread = torch.where(held[:, None] & held, covariance.to(z), free)
        # The inverse would be indefinite by rounding if many constants are known precisely.
        factor = torch.linalg.cholesky(spread)
        root = torch.linalg.solve_triangular(factor, torch.eye(len(z)).to(z), upper=False)
        return Prior(z, root)

    def _identify(
        self, model: LearnedConstants, prior: Prior, runs: Sequence[Trajectory], earlier: bool
    ) -> Fit:
        q, v, a, u = filtered_motion([_marked(model, x) for x in runs], self.cutoff, self.samples)
        inputs = runs[0].u.shape[-1]
        u, saturated = u[:, :inputs], u[:, inputs:]
        moves = (v.abs() > REST * v.std(0)) & (saturated.abs() < _SATURATED)
        if not moves.any():
            raise ValueError(
                "least squares: no joint moves in the training trajectories, or all drives saturate"
            )
        source = f"{len(q)} samples of filtered motion, without joints at rest,"
        remedy = "record longer motions of all joints, or raise optimizer.samples"
        _require_enough(int(moves.sum()), len(prior.mean), source, remedy, earlier)
        samples, passive = model.samples(q, v, a, u), model.has_passive_joints
        with torch.no_grad():
            spread = a.std(0) if passive else model.force_scale(q, v, a, u)

        def errors() -> Tensor:
            force = samples.missing_force()
            if not passive:
                return force / model.drive_gain() / spread
            # Joints at rest have the measured acceleration.
            force = torch.where(moves, force, 0.0)
            return spd_solve(hold(model.mass_matrix(q), ~moves), force) / spread

        def residuals(derivative: bool) -> Tensor:
            error = errors()
            if not derivative:
                return error[moves]
            if passive:
                # The missing force is zero at the predicted acceleration.
                by_z = model.slopes().by_parameters(q, v, a - error * spread, u)
                mass = hold(model.mass_matrix(q), ~moves)
                by_z = torch.linalg.solve(mass, torch.where(moves[..., None], by_z, 0.0))
                return (by_z / spread[:, None])[moves]
            by_gain = (error * spread).unsqueeze(-1) * model.slopes().gain()
            by_z = samples.by_parameters() - by_gain
            return (by_z / (model.drive_gain() * spread).unsqueeze(-1))[moves]

        periods = self.cutoff * sum(run.duration for run in runs)
        blocks = min(int(periods / 2), _BLOCKS)  # of two periods of the cutoff or more
        times = torch.arange(len(q)).mul(blocks).div(len(q), rounding_mode="floor")
        partitions = [times[:, None].expand_as(v)[moves], _speeds(v)[moves]]
        group, limit = max(len(q) / (2 * periods), 1.0), _CHEAP * self.evaluations
        result = self._solve(
            IDENTIFICATION, model, prior, residuals, partitions, group, limit, _EXACT, robust=False
        )
        with torch.no_grad():
            doubt = doubtful_units(*model.force_ratio(q, v, a), errors().std(0))
        if doubt:
            log.warning("least squares: %s", doubt)
        return result

    def _roll_out(
        self,
        stage: str,
        model: LearnedConstants,
        prior: Prior,
        runs: Sequence[Trajectory],
        windows: Windows,
    ) -> Fit:
        scale = windows.statistics().qv_increment_std.clone()
        scale[:, model.num_coordinates :] /= self.velocity_weight**0.5
        x0, measured = windows.start("qv"), windows.increments("qv")
        first = (2 - _informative_blocks(measured.shape[1])) * model.num_coordinates

        rollouts = WindowRollouts(model, windows)

        def residuals(derivative: bool) -> Tensor:
            if derivative:
                return (rollouts.slopes() / scale.unsqueeze(-1))[:, :, first:]
            return ((rollouts.increments() - measured) / scale)[..., first:]

        # Windows that overlap have neighboring starts, and so have similar errors of the model.
        starts = x0 / x0.std(0, correction=0).clamp(min=1e-12)
        _, near = scipy.cluster.vq.kmeans2(
            starts.numpy(), min(_BLOCKS, len(x0)), seed=0, minit="++"
        )
        speeds = _speeds(windows.v).repeat(1, 2)[:, None, first:]
        size = residuals(False).shape
        labels = [torch.from_numpy(near)[:, None, None], speeds]
        partitions = [label.expand(size).flatten() for label in labels]
        origins = _runs_of(windows, runs)[:, None, None].expand(size).flatten()
        parts = [origins == number for number in range(len(runs))]
        return self._solve(
            stage,
            model,
            prior,
            residuals,
            partitions,
            float(size[1]),
            self.evaluations,
            1.0,
            robust=self.loss == "soft_l1",
            parts=parts if len(parts) >= _FEWEST_RUNS else None,
        )

    def _solve(
        self,
        stage: str,
        model: LearnedConstants,
        prior: Prior,
        residuals: Residuals,
        partitions: Sequence[Tensor],
        group: float,
        limit: int,
        tolerance: float,
        robust: bool,
        parts: Sequence[Tensor] | None = None,
    ) -> Fit:
        """Fit from the present z; ``group`` residuals count as one.

        The tolerance is in units of the standard deviation of the cost by the noise. The
        result has fits without each of the ``parts``, see :func:`~.constants_fit.left_out`.
        """
        task = f"least squares, {stage}"
        z = parameters_to_vector(model.parameters()).detach()
        problem = GaussNewton(partial(_evaluate, model, residuals), z, prior, group, robust)

        def report() -> None:
            progress.update(problem.evaluations, f", residual {problem.noise:.4f}")

        with Progress(task, limit, "evaluations or fewer") as progress:
            try:
                success = problem.minimize(limit, tolerance * (2 * len(z)) ** 0.5, report)
            finally:
                vector_to_parameters(problem.z, model.parameters())
        way = "" if success else f", stopped by evaluations={limit} before the minimum"
        log.info("%s: residual %.4f after %d steps%s", task, problem.noise, problem.steps, way)
        scores = block_scores(problem.slopes, problem.data, partitions, prior.root)
        information = problem.slopes.T @ problem.slopes
        covariance = posterior_covariance(information, prior.root, scores)
        result = Fit(
            covariance=covariance,
            information=information,
            prior=prior,
            residual=problem.noise,
            iterations=problem.steps,
            success=success,
            z=problem.z,
            scores=scores,
        )
        if parts is None:
            return result
        fits = left_out(problem.z, problem.slopes, problem.data, parts, prior.root)
        return replace(result, left_out=fits)


def _marked(model: LearnedConstants, run: Trajectory) -> Trajectory:
    """Return a motion whose inputs are followed by 1 where a drive saturates, ``(T, M + N)``."""
    with torch.no_grad():
        u = torch.cat([run.u, model.saturated(run.v.double(), run.u.double())], dim=1).double()
    return replace(run, input=Signal(run.t, u, run.input.interpolation), past=None)


def _evaluate(model: LearnedConstants, residuals: Residuals, z: Tensor, derivative: bool) -> Tensor:
    """Return the residuals at z, or their derivatives. A diverged rollout has large residuals."""
    with torch.no_grad():
        vector_to_parameters(z, model.parameters())
        values = residuals(derivative)
    if derivative:
        return values.reshape(-1, len(z)).nan_to_num(0.0, 0.0, 0.0)
    return (
        values.flatten().nan_to_num(_DIVERGED, _DIVERGED, -_DIVERGED).clamp(-_DIVERGED, _DIVERGED)
    )


def _clearly_larger(errors: Tensor, lowest: Tensor) -> bool:
    excess = errors - lowest
    freedom = max(excess.numel() - 1, 1)
    noise = scipy.stats.t.ppf(_LEVEL, freedom) * excess.std(correction=0) / freedom**0.5
    # A single diverged part has a mean of one standard error, which is not significant.
    return bool(excess.mean() > min(noise, _NOISE * lowest.mean()))


def _runs_of(windows: Windows, runs: Sequence[Trajectory]) -> Tensor:
    """Return the number of the run of each window, ``(B,)``, by the state at its start."""
    states = torch.cat([run.states("qv") for run in runs])
    _, rows = scipy.spatial.cKDTree(states.numpy()).query(windows.start("qv").numpy())
    ends = torch.tensor([len(run.t) for run in runs]).cumsum(0)
    return torch.searchsorted(ends, torch.from_numpy(rows), right=True)


def _longer(trajectories: Sequence[Trajectory], windows: Windows) -> list[Windows]:
    """Return windows that double their length and halve their number, up to half a trajectory."""
    stride = round(float(windows.t[1] / trajectories[0].t.diff()[0]))
    longest, steps = max(len(item.t) for item in trajectories) // 2, 2 * (len(windows.t) - 1)
    count, drawn = len(windows) // 2, []
    history = -float(windows.input.t[0])
    draw = partial(draw_windows, list(trajectories), stride=stride, history=history, seed=None)
    while steps * stride <= longest and count >= _FEWEST_WINDOWS:
        drawn.append(draw(count=count, steps=steps).to(torch.device("cpu"), torch.float64))
        steps, count = 2 * steps, count // 2
    return drawn


def _speeds(v: Tensor) -> Tensor:
    """Return the number of the joint and its block of speed, of equal size, ``(K, N)``."""
    order = v.argsort(dim=0).argsort(dim=0) * _SPEEDS // len(v)
    return order * v.shape[1] + torch.arange(v.shape[1])


def _informative_blocks(steps: int) -> int:
    """Return the number of informative residual blocks: 1 for one-step windows, otherwise 2.

    In one step, dq/dt = v makes the residual of q zero.
    """
    return 1 if steps == 1 else 2


def _require_enough(count: int, constants: int, source: str, remedy: str, earlier: bool) -> None:
    """Check that residuals are no fewer than constants, or warn after an earlier fit."""
    message = (
        f"least squares: {source} give {count} residuals for {constants} constants, expected at "
        f"least as many: {remedy}"
    )
    if count < constants and not earlier:
        raise ValueError(message)
    if count < constants:
        log.warning(message)
