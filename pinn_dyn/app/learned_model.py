"""A trained model as users meet it: arrays and data frames in, NumPy arrays and frames out."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import NamedTuple, cast, overload

import numpy as np
import pandas as pd
import torch
from lightning.pytorch.utilities.seed import isolate_rng
from numpy.typing import ArrayLike
from torch import Tensor

from pinn_dyn.app.build import VALIDATION_ERROR, build_source
from pinn_dyn.app.predict_frame import predict_frame
from pinn_dyn.app.run_folder import Run, load_run, require_finished
from pinn_dyn.app.trust import packages
from pinn_dyn.data import LogSource
from pinn_dyn.ensembles import Ensemble
from pinn_dyn.evaluation import half_widths
from pinn_dyn.mechanics import MechanicalSystem, Signal, double_copy
from pinn_dyn.mechanics.arrays import require_finite

Values = ArrayLike | Tensor
_LOGS = ("pinn_dyn.data.logs.LogSource", "pinn_dyn.data.LogSource")


class TermArrays(NamedTuple):
    """The learned terms at configurations ``(*batch, N)``.

    ``M`` mass matrix ``(*batch, N, N)``, ``D`` damping matrix ``(*batch, N, N)``,
    ``G`` potential force ``(*batch, N)``, ``A`` input matrix ``(*batch, N, M)``.
    """

    M: np.ndarray
    D: np.ndarray
    G: np.ndarray
    A: np.ndarray


def load(
    run_folder: str | Path, checkpoint: str = "best", trust: str | Sequence[str] = ()
) -> LearnedModel:
    """The trained model of a run folder.

    Args:
        run_folder: what train.py or :func:`~pinn_dyn.fit` wrote.
        checkpoint: ``"best"``, the one of the smallest validation error, or ``"last"``.
        trust: packages of your own whose classes the run may build: SECURITY.md.

    Raises:
        TypeError: if the folder is no path, or trust no names.
        ValueError: if the folder is no run folder, its training has not ended, a file of it is
            damaged, or another version made it.
    """
    if not isinstance(run_folder, (str, os.PathLike)):
        raise TypeError(f"run_folder is {run_folder!r}, expected the path of a run folder")
    names = [trust] if isinstance(trust, str) else trust
    if not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f"trust is {trust!r}, expected names of packages, as trust=['my_package']")
    folder = Path(run_folder).expanduser()
    try:
        require_finished(folder)
    except OSError as error:
        raise ValueError(f"run_folder is {str(folder)[:80]!r}: {error.strerror}") from error
    trusted = packages(list(names))
    with isolate_rng():  # models draw their first weights when they are built
        return LearnedModel(load_run(folder, checkpoint, trusted))


class LearnedModel:
    """A trained model in float64 and evaluation mode, with the description of its data.

    Numbers are in SI units and radians, but for data frames, which keep the units of their log.

    Attributes:
        folder: the run folder that it came from; fit removes one that is temporary.
        config: the resolved configuration of the training.
        metrics: what the training recorded; ``metrics["validation"]`` has its errors.
        statistics: scales of the training data: means, spreads and ranges of q, v and u, and
            ``step``, the step of the training windows, s.
        model: the model itself, for what works with tensors: control laws, evaluations.
        source: the columns, units and cleaning of the log that it was trained on; None for other
            data.
        labels, input_labels: name and unit of each coordinate and input.
    """

    def __init__(self, run: Run):
        self._run = run
        self.folder = run.folder
        self.config = run.config
        self.metrics = run.metrics
        self.statistics = run.statistics
        self.model = double_copy(run.model).requires_grad_(False)
        dataset = run.config["dataset"]
        is_log = dataset.get("_target_") in _LOGS
        self.source = cast(LogSource, build_source(run.config)) if is_log else None
        named = dataset if self.source is None else vars(self.source)
        size, inputs = self.model.num_coordinates, self.model.num_inputs
        self.labels = list(named.get("labels") or [f"q{k + 1}" for k in range(size)])
        self.input_labels = list(named.get("input_labels") or [f"u{k + 1}" for k in range(inputs)])

    def __repr__(self) -> str:
        name, data = self.config["model_name"], self.config["dataset"].get("name")
        members = f"{self.model.size} members, " if isinstance(self.model, Ensemble) else ""
        state = " and ".join(self.model.state)
        error = self.metrics.get("validation", {}).get(VALIDATION_ERROR)
        return (
            f"LearnedModel({name} of {data}: {members}"
            f"q = ({', '.join(self.labels)}), u = ({', '.join(self.input_labels)}), predicts "
            f"{state}, validation error {'unknown' if error is None else f'{error:.3g}'})"
        )

    @property
    def members(self) -> list[LearnedModel]:
        """The members of an ensemble, each as a model of its own; of a single model it alone."""
        if not isinstance(self.model, Ensemble):
            return [self]
        each = [self.model.member(k) for k in range(self.model.size)]
        return [LearnedModel(replace(self._run, model=model)) for model in each]

    # Predictions.

    @overload
    def predict(self, start: pd.DataFrame) -> pd.DataFrame: ...

    @overload
    def predict(self, start: Values, u: Values | Signal, t: Values | None = None) -> np.ndarray: ...

    def predict(
        self,
        start: pd.DataFrame | Values,
        u: Values | Signal | None = None,
        t: Values | None = None,
    ) -> pd.DataFrame | np.ndarray:
        """The motion from a start under an input, or along a data frame.

        ``predict(start, u, t)``: the states x(t_k), ``(*batch, T, 2N)``. Between its samples the
        input moves as in the training data: on straight lines, unless its log was read otherwise.

        ``predict(frame)``: q and v in the columns, the units and the index of a log. The columns
        are those of the log that the model was trained on, cleaned by the same steps; every run
        starts from its own first row, and of the measured q and v that alone is used. Without
        measured velocities the columns of v are named ``dq1/dt``. Rows between two steps of a
        model that predicts in steps lie on straight lines, and rows that the cleaning drops at an
        end are NaN.

        Args:
            start: (q, v), ``(*batch, 2N)``; (q, p) where ``model.state`` is ``"qp"``. Or a frame.
            u: inputs at the times t, ``(*batch, T, M)``, or a :class:`~pinn_dyn.Signal`.
            t: times, ``(T,)``, s, increasing; None takes those of a Signal.

        Raises:
            TypeError: if u is missing beside a start, or given beside a frame.
            ValueError: on a start, an input or times of the wrong size, times outside the input,
                or a frame without the columns of the log; names what it was.
        """
        if isinstance(start, pd.DataFrame):
            if u is not None or t is not None:
                raise TypeError("predict(frame) takes the inputs from the frame: leave out u and t")
            if self.source is None:
                raise ValueError(
                    f"predict(frame): the model was trained on {self.config['dataset'].get('name')}"
                    ", which is no log with columns: use predict(start, u, t)"
                )
            return predict_frame(self.model, self.source, start)
        if u is None:
            raise TypeError("predict(start) lacks the input: expected predict(start, u, t)")
        x0, times, signal = self._motion(start, u, t)
        return self.model.predict(x0, times, signal).numpy()

    def predict_interval(
        self,
        start: Values,
        u: Values | Signal,
        t: Values | None = None,
        level: float = 0.95,
        factor: float = 1.0,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Between which states the motion lies with the probability ``level``::

            x(t) +- factor c sqrt(1 + 1/E) s(t)

        s is the spread of E predictions: those of the members of an ensemble, or of draws of the
        constants that least squares fitted; c the quantile of Student's t with E - 1 degrees of
        freedom. Neither knows of measurement noise, nor of what no member can say; evaluate.py
        finds the ``factor`` that validation motions needed (``calibration.csv``).

        Args:
            start, u, t: as of :meth:`predict`.
            level: above 0 and below 1.
            factor: on the width.

        Returns:
            The lower and the upper ends, ``(*batch, T, 2N)`` each.

        Raises:
            TypeError: if the model is a single network, which has no spread.
            ValueError: as :meth:`predict`; on a level or a factor that is none.
        """
        if not isinstance(level, Real) or not 0 < level < 1:
            raise ValueError(f"level is {level!r}, expected a probability between 0 and 1")
        if not isinstance(factor, Real) or not 0 < factor < math.inf:
            raise ValueError(f"factor is {factor!r}, expected a positive number")
        members = self._run.members()
        if members is None:
            raise TypeError(
                f"model={self.config['model_name']} is a single network, whose prediction has no "
                "spread: train an ensemble (train.py ensemble=5), or model=known by least squares"
            )
        x0, times, signal = self._motion(start, u, t)
        with torch.no_grad():
            each = double_copy(members).member_increments(x0, times, signal)
            middle = self.model.predict(x0, times, signal)
        width = float(half_widths(len(each), level)) * (1 + 1 / len(each)) ** 0.5
        reach = factor * width * each.std(dim=0)
        return (middle - reach).numpy(), (middle + reach).numpy()

    def _motion(
        self, start: Values, u: Values | Signal, t: Values | None
    ) -> tuple[Tensor, Tensor, Signal]:
        """Start, times and input of a prediction, in one batch."""
        x0 = self._array("start", start, 2 * self.model.num_coordinates, "2N")
        signal, times = self._input(u, t)
        try:
            batch = torch.broadcast_shapes(x0.shape[:-1], signal.batch)
        except RuntimeError as error:
            raise ValueError(
                f"start has the batch {tuple(x0.shape[:-1])} and u {tuple(signal.batch)}: expected "
                "the same, or one of them without"
            ) from error
        signal = signal.mapped(lambda value: value.expand(*batch, *value.shape[-2:]))
        return x0.expand(*batch, -1), times, signal

    def _input(self, u: Values | Signal, t: Values | None) -> tuple[Signal, Tensor]:
        """The input, and the times of the prediction."""
        size = self.model.num_inputs
        if isinstance(u, Signal):
            self._array("u", u.u, size, "M")
            signal = u.to("cpu", torch.float64)
            times = signal.t if t is None else _times(t)
            first, last = float(signal.t[0]), float(signal.t[-1])
            outside = (times < first - 1e-9) | (times > last + 1e-9)
            if outside.any():
                raise ValueError(
                    f"t has the time {float(times[outside][0]):g} s, outside the input, which is "
                    f"known from {first:g} to {last:g} s: give more of it, or other times"
                )
            return signal, times
        if t is None:
            raise TypeError("predict(start, u) lacks the times t of the samples of u")
        times, samples = _times(t), self._array("u", u, size, "M")
        if times.ndim != 1 or samples.ndim < 2 or samples.shape[-2] != times.shape[0]:
            raise ValueError(
                f"u has shape {tuple(samples.shape)} and t {tuple(times.shape)}, expected "
                f"(*batch, T, {size}) and (T,): one input for each time"
            )
        interpolation = self.config["dataset"].get("interpolation", "linear")
        return Signal(times, samples, interpolation), times

    # Terms of the equation of motion.

    @property
    def system(self) -> MechanicalSystem:
        """The model as a mechanical system, on tensors.

        Raises:
            TypeError: if it is a black box or an ensemble.
        """
        if isinstance(self.model, Ensemble):
            raise TypeError(
                "an ensemble has no terms, its mean is no mechanical system: use one of members"
            )
        if not isinstance(self.model, MechanicalSystem):
            raise TypeError(
                f"model={self.config['model_name']} is a black box and has no terms M, D, G and A: "
                "train model=lnn or model=hnn"
            )
        return self.model

    def terms(self, q: Values) -> TermArrays:
        """M(q), D(q), G(q) and A(q) at configurations q ``(*batch, N)``.

        Raises:
            TypeError: if the model is a black box or an ensemble.
            ValueError: on a q of the wrong size.
        """
        terms = self.system.terms(self._coordinates("q", q))
        return TermArrays(*(term.numpy() for term in terms))

    def inverse_dynamics(self, q: Values, v: Values, a: Values) -> np.ndarray:
        """tau = M a + C v + G + D v + F, ``(*batch, N)``, from q, v and a, each ``(*batch, N)``.

        Raises:
            TypeError: if the model is a black box or an ensemble.
            ValueError: on an argument of the wrong size.
        """
        values = {name: self._coordinates(name, x) for name, x in (("q", q), ("v", v), ("a", a))}
        return self.system.inverse_dynamics(*_together(**values)).numpy()

    def forward_dynamics(self, q: Values, v: Values, u: Values) -> np.ndarray:
        """a = M^-1 (A u - C v - G - D v - F), ``(*batch, N)``; u is ``(*batch, M)``.

        Raises:
            TypeError: if the model is a black box or an ensemble.
            ValueError: on an argument of the wrong size.
        """
        x, rate = _together(q=self._coordinates("q", q), v=self._coordinates("v", v))
        force = self._array("u", u, self.model.num_inputs, "M")
        _together(q=x[..., 0], u=force[..., 0])
        return self.system.forward_dynamics(x, rate, force).numpy()

    def _coordinates(self, name: str, value: Values) -> Tensor:
        return self._array(name, value, self.model.num_coordinates, "N")

    def _array(self, name: str, value: Values, size: int, symbol: str) -> Tensor:
        """A float64 tensor ``(*batch, size)`` of finite numbers."""
        tensor = _tensor(name, value)
        if tensor.ndim == 0 or tensor.shape[-1] != size:
            labels = self.input_labels if symbol == "M" else self.labels
            what = "q and v of " if symbol == "2N" and self.model.state == "qv" else ""
            raise ValueError(
                f"{name} has shape {tuple(tensor.shape)}, expected (*batch, {size}): "
                f"{symbol} = {size}, {what}{', '.join(labels)}"
            )
        require_finite(name, tensor)
        return tensor


def _together(**values: Tensor) -> tuple[Tensor, ...]:
    """Values of one batch.

    Raises:
        ValueError: if their batches differ.
    """
    try:
        return torch.broadcast_tensors(*values.values())
    except RuntimeError as error:
        shapes = ", ".join(f"{name} {tuple(value.shape)}" for name, value in values.items())
        raise ValueError(f"the batches differ: {shapes}; expected one for all") from error


def _times(t: Values) -> Tensor:
    """Finite times, s."""
    times = _tensor("t", t)
    require_finite("t", times)
    return times


def _tensor(name: str, value: Values) -> Tensor:
    """Real numbers in float64.

    Raises:
        ValueError: if they are none.
    """
    try:
        array = value.detach().cpu() if isinstance(value, Tensor) else np.asarray(value)
        if np.iscomplexobj(array):
            raise TypeError("they are complex")
        if np.ma.is_masked(value):  # whose hidden entries would be read
            raise TypeError("some are masked")
        if isinstance(array, np.ndarray) and array.dtype.kind in "mM":
            raise TypeError("they are dates or durations, not seconds")
        if isinstance(array, Tensor):
            return array.double()
        return torch.from_numpy(np.array(array, dtype=float))
    except (TypeError, ValueError) as error:
        shown = " ".join(repr(value).split())[:80]
        raise ValueError(f"{name} is {shown}, expected real numbers: {error}") from error
