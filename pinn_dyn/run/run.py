"""Trained models for users: arrays and data frames in, arrays and data frames out."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, overload

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike
from pydantic import PositiveInt
from torch import Tensor

from pinn_dyn.atomic_files import whole
from pinn_dyn.data import DataSource, LogSource, RobotSource, data_changes, store
from pinn_dyn.ensembles import Ensemble, posterior_draws, sampled_models
from pinn_dyn.evaluation.calibration import corrected_width, half_widths
from pinn_dyn.evaluation.external_torque import ExternalTorque
from pinn_dyn.evaluation.metrics import score
from pinn_dyn.evaluation.prediction import model_for_rollouts, predict_with_members
from pinn_dyn.exports.compiled import Compiled
from pinn_dyn.exports.exported_function import Real
from pinn_dyn.exports.watch import Watch
from pinn_dyn.identification.payload import identify_payload
from pinn_dyn.mechanics import (
    ContinuousPredictor,
    MechanicalSystem,
    Predictor,
    Signal,
    stack_until,
)
from pinn_dyn.mechanics.arrays import require_finite
from pinn_dyn.models import KnownMechanics, Statistics
from pinn_dyn.run.configuration.build import build_source
from pinn_dyn.run.export import export, export_samples
from pinn_dyn.run.external_torque import external_torque
from pinn_dyn.run.predict_frame import predict_frame

TRAJECTORIES = "trajectories.pt"
"""File in a run folder: the data of a source that was made in Python."""

Values = ArrayLike | Tensor
_OF_ALL_MEMBERS = "parameters", "training_seconds", "processor_seconds"  # metrics that add up


class TermArrays(NamedTuple):
    """The learned terms at configurations ``(*batch, N)``, see :meth:`Run.terms`."""

    M: np.ndarray
    D: np.ndarray
    G: np.ndarray
    A: np.ndarray


@dataclass(frozen=True, repr=False)
class Run:
    """A trained model with its configuration, its metrics and the identity of its data.

    Numbers are in SI units and radians, except for data frames, which keep the units of their log.

    Attributes:
        folder: the run folder; temporary for a training in Python without one, see :meth:`save`.
        config: configuration of the training as plain values.
        model: the model in float64 and evaluation mode, for tensors.
        statistics: means, spreads and ranges of the training data, and ``step``, the step of the
            training windows, s.
        metrics: record of the training; ``metrics["validation"]`` has the validation errors of the
            model, ``metrics["kept_step"]`` the step at which it was kept, and
            ``metrics["last_validation"]`` the errors of the last step.
        data: identity of the data, see :func:`~pinn_dyn.data.data_identity`; empty if unknown.
        finished: whether the training has ended.
        covariance: covariance of constants that least squares fitted, ``(P, P)``, or None.
        identified: standardized constants before the rollouts of least squares, ``(P,)``, or None.
    """

    folder: Path
    config: dict[str, Any]
    model: Predictor
    statistics: Statistics
    metrics: dict[str, Any]
    data: dict[str, Any]
    finished: bool = True
    covariance: Tensor | None = None
    identified: Tensor | None = None
    _made_in_python: DataSource | None = None
    _temporary: TemporaryDirectory[str] | None = None
    _may_simulate: bool = True
    _copies: dict[int, tuple[Watch, Predictor]] = field(default_factory=dict, init=False)

    def __repr__(self) -> str:
        name, data = self.config["model_name"], self.config["dataset"].get("name")
        count = len(self.model.members)
        members = f"{count} members, " if count > 1 else ""
        return (
            f"Run({name} of {data}: {members}q = ({', '.join(self.labels)}), "
            f"u = ({', '.join(self.input_labels)}), validation error {score(self.metrics)})"
        )

    @cached_property
    def source(self) -> DataSource:
        """The data that the run was trained on."""
        source = self._made_in_python or build_source(self.config)
        if isinstance(source, RobotSource):
            source.may_simulate = self._may_simulate
        return source

    @cached_property
    def log(self) -> LogSource | None:
        """The log that the run was trained on; None without a log."""
        if isinstance(self._made_in_python, LogSource):
            return self._made_in_python
        part = self.config.get("log") or self.config["dataset"]
        if not str(part.get("_target_")).endswith(".LogSource"):
            return None
        source = build_source({"dataset": part})
        assert isinstance(source, LogSource)
        return source

    @property
    def labels(self) -> list[str]:
        """Name and unit of each coordinate."""
        return self._labels("labels", "q", self.model.num_coordinates)

    @property
    def input_labels(self) -> list[str]:
        """Name and unit of each input."""
        return self._labels("input_labels", "u", self.model.num_inputs)

    def _labels(self, key: str, symbol: str, size: int) -> list[str]:
        if self.log is not None:
            return list(getattr(self.log, key))
        return list(self.config["dataset"].get(key) or [f"{symbol}{k + 1}" for k in range(size)])

    @property
    def input_delay(self) -> np.ndarray:
        """Time between an input of the robot and its action, ``(M,)``, s: that of the data set."""
        delay = self.log.input_delay if self.log else self.config["dataset"].get("delay", 0.0)
        return np.resize(np.asarray(delay, dtype=float), self.model.num_inputs)

    @property
    def members(self) -> list[Run]:
        """The members of an ensemble as single models; a single model is its only member."""
        members = self.model.members
        return [self] if len(members) == 1 else [replace(self, model=x) for x in members]

    @property
    def ensemble(self) -> Predictor | None:
        """The members of an ensemble, or draws of the constants that least squares fitted."""
        if len(self.model.members) > 1:
            return self.model
        return None if self.covariance is None else posterior_draws(self.model, self.covariance)

    def save(self, folder: str | Path) -> None:
        """Copy the run folder to a new one, with the data of a source that was made in Python."""
        with whole(Path(folder).expanduser()) as target:
            shutil.copytree(self.folder, target, ignore=shutil.ignore_patterns(".lock"))
            if self._made_in_python is not None and not (target / TRAJECTORIES).exists():
                store(self._made_in_python, target / TRAJECTORIES)

    def sample(self, n: int, seed: int = 0) -> list[Predictor]:
        """Draw robots from the posterior of the constants that least squares fitted.

        Directions that the data do not determine vary within the prior, and every body is
        physically possible, see :func:`~pinn_dyn.ensembles.sampled_models`.

        Args:
            n: number of robots.
            seed: seed of the draws.

        Returns:
            n models of the class of ``model``, in float64 and without gradients. All methods of a
            model work on each, and environments for reinforcement learning take one per copy.

        Raises:
            TypeError: if the run has no covariance of constants.
        """
        if self.covariance is None:
            raise TypeError("the run has no posterior: fit its constants by least squares")
        return sampled_models(self.model, self.covariance, n, seed)

    def export(
        self,
        path: str | Path,
        what: str | None = None,
        *,
        real: Real = "double",
        samples: int = 0,
        seed: int = 0,
    ) -> Path:
        """Write the model to a C, ONNX, CasADi, URDF or MJCF file, see :func:`~.run.export.export`.

        Args:
            path: the file; its ending selects the format.
            what: name of a function to write.
            real: type of the numbers in a ``.c`` or ``.onnx`` file, ``double`` or ``float``.
            samples: number of draws of :meth:`sample` to write instead, as ``arm_00.xml`` and so
                on for the path ``arm.xml``, with their constants in ``arm_samples.csv``.
            seed: seed of the draws.

        Returns:
            The path, or that of the table of the samples.
        """
        if samples:
            return export_samples(self.sample(samples, seed), path)
        about = {"q": self.labels, "u": self.input_labels, "delay": self.input_delay.tolist()}
        statistics = self.statistics
        return export(self.model, path, what, real=real, statistics=statistics, about=about)

    def identify_payload(
        self, loaded: DataSource | pd.DataFrame | str | Sequence[str]
    ) -> pd.DataFrame:
        """Identify the load of the robot in another log, see :func:`~.evaluation.identify_payload`.

        Args:
            loaded: data of the robot with the load; files or frames have the columns of the log.

        Raises:
            TypeError: if the model has no bodies.
            ValueError: if the data cannot be used.
        """
        if not isinstance(self.model, KnownMechanics):
            kind = type(self.model).__name__
            raise TypeError(f"a {kind} has no bodies that carry a load: use a run of model=known")
        if not isinstance(loaded, DataSource):
            part = self.config.get("log") or self.config["dataset"]
            files = "*" if isinstance(loaded, pd.DataFrame) else loaded
            unsplit = {"files": files, "validation": None, "test": None}
            source: Any = build_source({"dataset": {**part, **unsplit}})
            if isinstance(loaded, pd.DataFrame):
                source.files = {"frame": loaded}
            loaded = source
        cutoff = self.config["optimizer"].get("cutoff", 6.0)
        splits = loaded.load()
        runs = [*splits.train, *splits.validation, *splits.test]
        return identify_payload(self.model, self.source.load().train, runs, cutoff=cutoff)

    def external_torque(
        self,
        frame: pd.DataFrame,
        *,
        bandwidth: float = 20.0,
        false_alarms: float = 1.0,
        quiet: pd.DataFrame | None = None,
        link: str | None = None,
        urdf: str | None = None,
        moment: bool = False,
    ) -> ExternalTorque:
        """Find torques that neither drives nor model explain, and contacts, along a data frame.

        The momentum observer (:class:`~pinn_dyn.control.observer.MomentumObserver`) gives the
        external torque of each joint through a low-pass of 1 / bandwidth s: after this time it has
        reached 63 %, and after three times 95 % of a step. Joints at rest show only what their dry
        friction cannot hold. The frame has the columns and units of the log, and is cleaned by the
        same steps.

        Args:
            frame: the log.
            bandwidth: K_O, 1/s.
            false_alarms: expected false alarms per hour, which sets the thresholds.
            quiet: motion without a contact for the thresholds; None for the validation data.
            link: link at which a force acts, for its wrench; see
                :func:`~.evaluation.external_torque.link_wrench`.
            urdf: robot of the link, for models without a structure.
            moment: false for a force at the origin of the link, true for force and moment.

        Raises:
            TypeError: on a black box or an ensemble.
            ValueError: without the columns of a log, a robot of the link, or enough quiet motion.
        """
        if self.log is None:
            raise ValueError("the training data have no columns of a log")
        return external_torque(
            self.system,
            self.log,
            frame,
            quiet=quiet,
            bandwidth=bandwidth,
            false_alarms=false_alarms,
            link=link,
            urdf=urdf,
            moment=moment,
        )

    @overload
    def predict(self, start: pd.DataFrame, *, threads: PositiveInt = 1) -> pd.DataFrame: ...

    @overload
    def predict(
        self, start: Values, u: Values | None, t: Values, threads: PositiveInt = 1
    ) -> np.ndarray: ...

    def predict(
        self,
        start: pd.DataFrame | Values,
        u: Values | None = None,
        t: Values | None = None,
        threads: PositiveInt = 1,
    ) -> pd.DataFrame | np.ndarray:
        """Predict the motion from a start under an input, or along a data frame.

        ``predict(start, u, t)`` simulates the model, and returns the states x(t_k), ``(*batch, T,
        2N)``. The input between its samples is interpolated as in the training data, and acts after
        the ``delay`` of the data set; before the first sample it is constant. With a C compiler, a
        loop in C is built after 1,500 steps of the model (75,000 of a latent state), and all later
        calls use it.

        ``predict(frame)`` returns q and v in the columns, units and index of a log, whose columns
        the frame needs. It is cleaned by the same steps. Every run starts from its first row.
        Without measured velocities the columns of v are ``dq1/dt``. Rows dropped at an end are NaN.

        Args:
            start: (q, v), ``(*batch, 2N)``, or (q, p) if ``model.state`` is ``"qp"``; or a frame.
            u: inputs at the times t, ``(*batch, T, M)``; None for a model without inputs.
            t: increasing times, ``(T,)``, s.
            threads: number of threads that share the motions of a batch.

        Raises:
            TypeError: if the input is missing.
            ValueError: on wrong shapes, values that are not finite, or a frame without the columns.
        """
        if isinstance(start, pd.DataFrame):
            if self.log is None:
                raise ValueError("the training data have no columns of a log: give start, u and t")
            with torch.no_grad():
                return predict_frame(self._for_rollouts(threads), self.log, start)
        x0, times, signal = self._motion(start, u, t)
        with torch.no_grad():
            return self._for_rollouts(threads).predict(x0, times, signal).numpy()

    def predict_interval(
        self,
        start: Values,
        u: Values,
        t: Values,
        level: float = 0.95,
        factor: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the interval that contains the motion with the probability ``level``::

            x(t) +- c sqrt((1 + 1/E) s(t)^2 + m^2)

        s is the spread of E predictions: those of the members of an ensemble, or of draws of the
        constants that least squares fitted. c and m are those that the validation motions need over
        the time of t, see :func:`~.evaluation.calibration.corrected_width`; m of v follows from
        that of q by the spreads of v and q in the training. The width is zero at the start.

        Args:
            start, u, t: see :meth:`predict`.
            level: probability.
            factor: for intervals of the spread alone, without data: m is zero, and c the factor
                times the quantile of Student's t with E - 1 degrees of freedom.

        Returns:
            The lower and the upper ends, ``(*batch, T, 2N)`` each.

        Raises:
            TypeError: if the model is a single network, which has no spread.
        """
        if (ensemble := self.ensemble) is None:
            raise TypeError(
                "a single network has no spread: train several seeds, and take ensemble(runs)"
            )
        x0, times, signal = self._motion(start, u, t)
        with torch.no_grad():
            paths = model_for_rollouts(ensemble).member_increments(x0, times, signal)
            mean = self._for_rollouts().predict(x0, times, signal)
        variance = paths.var(dim=0) * (1 + 1 / len(paths))
        if factor is not None:
            reach = factor * float(half_widths(len(paths), level)) * variance.sqrt()
        else:
            floor, width = self._corrected_width(ensemble, float(times[-1] - times[0]), level)
            reach = width * (variance + floor**2).sqrt()
            reach[..., 0, :] = 0.0
        return (mean - reach).numpy(), (mean + reach).numpy()

    def _corrected_width(
        self, ensemble: Predictor, duration: float, level: float
    ) -> tuple[Tensor, float]:
        """Return the floors of x ``(2N,)`` and c of :func:`.corrected_width`."""
        motions = stack_until(self.source.load().validation)
        step = self.model.fixed_step or self.statistics.step
        window = step * max(int(min(duration, motions.duration) / step + 1e-6), 1)
        prediction = predict_with_members(self.model, ensemble, motions, window=window, step=step)
        floor, width = corrected_width(prediction, level)
        rate = self.statistics.v_std if self.model.state == "qv" else self.statistics.p_std
        return torch.cat([floor, floor * rate / self.statistics.q_std]), float(width)

    def _for_rollouts(self, threads: int = 1) -> Predictor:
        """Return the model with loops in C, copied once for its present numbers and attributes."""
        watch, model = self._copies.get(threads, (None, self.model))
        if watch is None or watch.changed():
            watch = Watch(self.model)
            model = model_for_rollouts(self.model, threads=threads)
            self._copies[threads] = watch, model
        return model

    @cached_property
    def _compiled(self) -> Compiled:
        return Compiled(self.model)

    def _rows(self, name: str, function: Callable[..., Tensor], *parts: Tensor) -> Tensor:
        """Return a function of states and inputs ``(*batch, n)``, in C if that pays off."""
        if any(x.ndim > 1 for x in parts):  # not for a single state, where it takes long
            batch = np.broadcast_shapes(*(x.shape[:-1] for x in parts))
            parts = tuple(x.expand(*batch, -1) for x in parts)
        sizes = [x.shape[-1] for x in parts]

        def of_rows(rows: Tensor) -> Tensor:
            return function(*rows.split(sizes, dim=-1))

        with torch.no_grad():
            return self._compiled.rows(name, of_rows, torch.cat(parts, dim=-1))

    def _motion(
        self, start: Values, u: Values | None, t: Values | None
    ) -> tuple[Tensor, Tensor, Signal]:
        x0 = self._array("start", start, 2 * self.model.num_coordinates, "2N")
        size = self.model.num_inputs
        if t is None or (u is None and size):
            raise TypeError("the input is missing: expected predict(start, u, t)")
        times = _tensor("t", t)
        samples = self._array("u", np.empty((times.numel(), 0)) if u is None else u, size, "M")
        if times.ndim != 1 or samples.ndim < 2 or samples.shape[-2] != len(times):
            shapes = f"u has shape {tuple(samples.shape)} and t {tuple(times.shape)}"
            raise ValueError(f"{shapes}, expected (*batch, T, {size}) and (T,)")
        part = self.config.get("log") or self.config["dataset"]
        signal = Signal(times, samples, part.get("interpolation", "linear"))
        signal = signal.delayed(torch.from_numpy(self.input_delay))
        batch = torch.broadcast_shapes(x0.shape[:-1], signal.batch)
        signal = signal.mapped(lambda value: value.expand(*batch, *value.shape[-2:]))
        return x0.expand(*batch, -1), times, signal

    @property
    def system(self) -> MechanicalSystem:
        """The model as a mechanical system; TypeError for black boxes and ensembles."""
        if not isinstance(self.model, MechanicalSystem):
            kind = "an ensemble" if len(self.model.members) > 1 else "a black box"
            raise TypeError(f"the model is {kind} and has no terms M, D, G and A")
        labels = self.labels, self.input_labels
        if (self.model.labels, self.model.input_labels) != labels:
            self.model.labels, self.model.input_labels = labels
            self.model.dead_time = self.input_delay
        return self.model

    def terms(self, q: Values) -> TermArrays:
        """Return M, D ``(*batch, N, N)``, G ``(*batch, N)`` and A ``(*batch, N, M)`` at q."""
        system, N, M = self.system, self.model.num_coordinates, self.model.num_inputs

        def function(q: Tensor) -> Tensor:
            mass, damping, force, inputs = system.terms(q)
            parts = mass.flatten(-2), damping.flatten(-2), force, inputs.flatten(-2)
            return torch.cat(parts, dim=-1)

        rows = self._rows("terms", function, self._coordinates("q", q))
        mass, damping, force, inputs = rows.split([N * N, N * N, N, N * M], dim=-1)
        shapes = (mass, (N, N)), (damping, (N, N)), (force, (N,)), (inputs, (N, M))
        return TermArrays(*(x.reshape(*x.shape[:-1], *shape).numpy() for x, shape in shapes))

    def inverse_dynamics(self, q: Values, v: Values, a: Values) -> np.ndarray:
        """Return tau = M a + C v + G + D v + F, generalized forces ``(*batch, N)``."""
        parts = [self._coordinates(*item) for item in (("q", q), ("v", v), ("a", a))]
        return self._rows("inverse_dynamics", self.system.inverse_dynamics, *parts).numpy()

    def input_for(self, q: Values, v: Values, a: Values) -> np.ndarray:
        """Return u with A(q) u = tau, see :meth:`MechanicalSystem.input_for`, ``(*batch, M)``."""
        return self.system.input_for(*self._motion_state(q=q, v=v, a=a)).numpy()

    def forward_dynamics(self, q: Values, v: Values, u: Values) -> np.ndarray:
        """Return a = M^-1 (A u - C v - G - D v - F), ``(*batch, N)``; u is ``(*batch, M)``."""
        parts = [self._coordinates("q", q), self._coordinates("v", v)]
        parts.append(self._array("u", u, self.model.num_inputs, "M"))
        return self._rows("forward_dynamics", self.system.forward_dynamics, *parts).numpy()

    def linearize(
        self, q: Values, v: Values, u: Values, *, sample_time: float | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return A and B of the state (q, v), see :meth:`ContinuousPredictor.linearize`.

        Raises:
            TypeError: on a model that has no derivative of its state, or an ensemble.
        """
        if not isinstance(self.model, ContinuousPredictor):
            raise TypeError(
                f"a {type(self.model).__name__} has no dx/dt to linearize: use a member of "
                "run.members, or model=lnn, hnn, known or acceleration"
            )
        position, velocity = self._motion_state(q=q, v=v)
        inputs = self._array("u", u, self.model.num_inputs, "M")
        A, B = self.model.linearize(position, velocity, inputs, sample_time=sample_time)
        return A.numpy(), B.numpy()

    def _motion_state(self, **values: Values) -> tuple[Tensor, ...]:
        return torch.broadcast_tensors(*(self._coordinates(*item) for item in values.items()))

    def _coordinates(self, name: str, value: Values) -> Tensor:
        return self._array(name, value, self.model.num_coordinates, "N")

    def _array(self, name: str, value: Values, size: int, symbol: str) -> Tensor:
        tensor = _tensor(name, value)
        if tensor.ndim == 0 or tensor.shape[-1] != size:
            labels: Sequence[str] = self.input_labels if symbol == "M" else self.labels
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}, expected (*batch, {size}): "
                f"{symbol} = {size} for {', '.join(labels)}"
            )
        return tensor


def ensemble(runs: Sequence[Run]) -> Run:
    """Return the mean of several runs, such as those of a sweep over seeds, as a run::

        run = pinn_dyn.ensemble([pinn_dyn.load(folder) for folder in folders])
        low, high = run.predict_interval(start, u, t)

    Its model is an :class:`~pinn_dyn.ensembles.Ensemble`, and its ``members`` are the runs.

    Raises:
        ValueError: if the runs have different data, or models that do not fit together.
    """
    first = runs[0]
    for run in runs[1:]:
        if changes := data_changes(first.data, run.data):
            raise ValueError(
                f"{run.folder} has other data than {first.folder}: {changes[0]}: the error on test "
                "data of one is not that of the other, train all on the same data"
            )
    metrics = {x: sum(run.metrics.get(x, 0) for run in runs) for x in _OF_ALL_MEMBERS}
    return replace(
        first,
        config={**first.config, "model_name": f"mean of {len(runs)} {first.config['model_name']}"},
        model=Ensemble(run.model for run in runs),
        metrics={**first.metrics, **metrics},
        covariance=None,
    )


def _tensor(name: str, value: Values) -> Tensor:
    if isinstance(value, Tensor):
        tensor = value.detach().cpu().double()
    else:
        array = np.asarray(value)
        if array.dtype.kind in "mM":
            raise ValueError(f"{name} holds dates or durations, expected numbers in SI units")
        tensor = torch.from_numpy(np.array(array, dtype=float))
    require_finite(name, tensor)
    return tensor
