"""Data source that reads, checks, splits and cleans logs of a robot."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from pydantic import NonNegativeFloat, PositiveFloat

from pinn_dyn.data.logs.check import plausibility
from pinn_dyn.data.logs.check.checks import check_repeats
from pinn_dyn.data.logs.cleaning import clean, long_enough
from pinn_dyn.data.logs.clock import InputDelay
from pinn_dyn.data.logs.columns import UNITS, Columns, validated
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.measurement import Measurement
from pinn_dyn.data.logs.pieces import Cleaned, one_sample_time, pieces_of, summary, trajectory
from pinn_dyn.data.logs.reading import Layout
from pinn_dyn.data.logs.recording import Recording, Report
from pinn_dyn.data.logs.splits import Part, default_split, fitting, split
from pinn_dyn.data.logs.stamps import Clock
from pinn_dyn.data.logs.step import Step
from pinn_dyn.data.logs.table import Table
from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.mechanics import Interpolation

log = logging.getLogger(__name__)


class _LoadedLog(NamedTuple):
    splits: Splits
    names: dict[str, list[str]]
    cleaned: list[Cleaned]
    report: Report


class LogSource(DataSource):
    """Trajectories from logs: CSV, MATLAB, HDF5, NPZ, Parquet, bags of ROS, or data frames.

    Runs are split, or cut with a guard, before the cleaning steps. A filter therefore never uses
    samples on both sides of a border. A missing velocity is derived by
    :class:`SavitzkyGolayVelocity`. Columns and parts may be mappings, such as
    ``q={"columns": ["q1", "q2"], "unit": "deg"}``.

    Args:
        name: short name for tables and titles; None for the name of the first file.
        files: names or glob patterns in the folder ``root``; or a data frame, or data frames by the
            name of their run. Files with parts of the columns are joined.
        root: folder of the files.
        time: columns of the time, or ``{rate: 100}`` for a log without time, see :class:`Clock`.
        q: columns of the configuration, N.
        u: columns of the input, M; None or [] for a robot without inputs.
        v: columns of the velocity, N, or None. If their names match those of q, they are sorted in
            the order of q.
        max_age: largest age of a message of another topic, or of a value in a slower column, in a
            row, s.
        sep: separator of the cells of a text file; None detects the separator.
        trajectory: column that names the run of a row, or None if each file is a single run.
        long: column that names the joint, for a log with a row per joint and time. The other
            columns are then ``<name>/<joint>``.
        steps: cleaning steps by name, in order; entries with None are left out.
        delay: dead time of the inputs, s, one number or M; adds a last step :class:`InputDelay`.
        validation, test: whole runs, ``{runs: 2, piece: 5.0}``, or the ends of runs,
            ``{seconds: 3.0, piece: 3.0}``, see :class:`Part`; None for :func:`default_split`.
        guard: time that is left out between training, validation and test in a run, s.
        shortest: shortest training stretch, s; at least the length of a window. Shorter stretches
            are dropped.
        seed: seed of the choice of runs.
        interpolation: interpolation of the input between samples.
        angles: indices of the coordinates that are angles of joints.

    Raises:
        LogError: if columns, units or parts do not match. :meth:`load` raises errors of the files.
    """

    def __init__(
        self,
        *,
        name: str | None = None,
        files: str | Sequence[str] | pd.DataFrame | Mapping[str, pd.DataFrame],
        root: str = ".",
        time: Clock | Mapping[str, Any] | str,
        q: Columns | Mapping[str, Any],
        u: Columns | Mapping[str, Any] | Sequence[str] | None,
        v: Columns | Mapping[str, Any] | None = None,
        trajectory: str | None = None,
        long: str | None = None,
        max_age: PositiveFloat = 0.1,
        sep: str | None = None,
        steps: Mapping[str, Step | None] | None = None,
        delay: NonNegativeFloat | Sequence[NonNegativeFloat] = 0.0,
        validation: Part | Mapping[str, Any] | None = None,
        test: Part | Mapping[str, Any] | None = None,
        guard: NonNegativeFloat = 0.5,
        shortest: NonNegativeFloat = 0.1,
        seed: int = 0,
        interpolation: Interpolation = "linear",
        angles: Sequence[int] = (),
    ):
        self.files = {"frame": files} if isinstance(files, pd.DataFrame) else files
        paths = [self.files] if isinstance(self.files, str) else list(self.files)
        first = "frame" if isinstance(self.files, Mapping) else Path(paths[0]).stem
        self.name = name or re.sub(r"[^\w-]+", "", first) or "log"
        self.root = root
        if isinstance(time, str):
            time = {"columns": time}
        self.time: Clock = validated(Clock, "time", time)
        self.q: Columns = validated(Columns, "q", q)
        self.u: Columns = validated(Columns, "u", u or {"columns": [], "unit": []})
        self.v: Columns | None = None
        if v is not None:
            self.v = validated(Columns, "v", v).in_order_of(self.q.columns)
        signals = {"q": self.q, "v": self.v, "u": self.u}
        self._signals = {key: columns for key, columns in signals.items() if columns is not None}
        self._check_units()
        self.trajectory = trajectory
        self.steps = {key: step for key, step in (steps or {}).items() if step is not None}
        self.delay = delay
        repairs = {fault for step in self.steps.values() for fault in step.repairs}
        self._layout = Layout(self.time, self._signals, trajectory, long, max_age, sep, repairs)
        if (validation is None) != (test is None):
            raise LogError("set both validation and test, or neither for the default split")
        self.validation: Any = validation and validated(Part, "validation", validation)
        self.test: Any = test and validated(Part, "test", test)
        self.guard = guard
        self.shortest = shortest
        self.seed = seed
        self.interpolation = interpolation
        self.angles = tuple(angles)
        if not {*angles} <= {k for k, unit in enumerate(self.q.units) if unit == "rad"}:
            raise LogError(
                f"angles is {list(angles)}, expected indices (from 0) of coordinates in rad"
            )
        self.labels = self.q.labels
        self.input_labels = self.u.labels
        for step in self.steps.values():
            self.input_labels = step.input_labels(self.input_labels)

    def _check_units(self) -> None:
        self.q.check_units("q", ["rad", "m", "1"])
        self.u.check_units("u", sorted({unit for unit, _ in UNITS.values()} - {"s"}))
        if self.v is not None and self.v.units != [f"{unit}/s" for unit in self.q.units]:
            raise LogError(f"v has the units {self.v.units}, expected {self.q.units} per second")
        names = pd.Index([x for columns in self._signals.values() for x in columns.columns])
        if names.has_duplicates:
            raise LogError(f"column {names[names.duplicated()][0]!r} is twice in q, v and u")

    @property
    def cleaning(self) -> dict[str, Step]:
        """Cleaning steps, with the shift of the inputs by the delay."""
        return self.steps | ({"input delay": InputDelay(self.delay)} if np.any(self.delay) else {})

    @property
    def input_delay(self) -> np.ndarray:
        delays = [x.delay for x in self.steps.values() if isinstance(x, InputDelay)]
        return sum((np.resize(x, len(self.input_labels)) for x in delays), super().input_delay)

    def load(self) -> Splits:
        """Return the cleaned trajectories.

        Raises:
            LogError: if a file is not usable.
        """
        return self._loaded.splits

    def names(self) -> dict[str, list[str]]:
        return self._loaded.names

    @property
    def cleaned(self) -> list[Cleaned]:
        """All stretches before and after the cleaning, in the order training, validation, test."""
        return self._loaded.cleaned

    @property
    def measurements(self) -> list[Measurement]:
        """Measurements of the checks that are made for every log."""
        return self._loaded.report.measurements

    @property
    def warnings(self) -> list[str]:
        """Texts of all measurements with a warning."""
        return self._loaded.report.warnings

    @property
    def report(self) -> str:
        """Warnings, and notes of each step, as Markdown."""
        return self._loaded.report.markdown()

    def recordings(self, frame: pd.DataFrame) -> list[tuple[np.ndarray, Recording, Recording]]:
        """Read the runs of a frame with the columns and units of the log, and clean each run.

        Returns:
            For each run: the indices of its rows in the frame, the rows in SI units, and the run
            after the cleaning.

        Raises:
            LogError: as :meth:`load`, or if the steps split or drop a run.
        """
        table, report = Table(frame, "the frame"), Report(self.name)
        column = self.trajectory
        runs = table.runs(column if column and column in table else None, "the frame")
        raws = self._layout.recordings(table, runs, report)
        cleaned = clean([Cleaned("", raw, [raw]) for _, raw in raws], self.cleaning, report)
        for part in cleaned:
            if (count := len(part.clean)) != 1:
                raise LogError(
                    f"{part.raw.place}: the cleaning gives {count} stretches, expected one"
                )
        return [
            (rows, part.raw, part.clean[0]) for (rows, _), part in zip(raws, cleaned, strict=True)
        ]

    @cached_property
    def _loaded(self) -> _LoadedLog:
        report = Report(self.name)
        recordings = self._layout.read(self.files, self.root, report)
        measurements = report.measurements
        if self.test is None:
            times = {item.run: item.t for item in recordings}
            self.validation, self.test, self.guard = default_split(
                times, self.seed, float(self.input_delay.max(initial=0.0))
            )
        lead = float(np.max(self.delay))
        parts = split(
            recordings, self.validation, self.test, guard=self.guard, seed=self.seed, lead=lead
        )
        cleaned = [Cleaned(key, raw, [raw]) for key, raws in parts.items() for raw in raws]
        self.validation = fitting(self.validation, parts["validation"], lead, report)
        self.test = fitting(self.test, parts["test"], lead, report)
        pieces = {"train": "whole", "validation": self.validation.piece, "test": self.test.piece}
        limits = {key: self.shortest if x == "whole" else x for key, x in pieces.items()}
        cleaned = long_enough("splitting", cleaned, limits, report)
        cleaned = clean(cleaned, self.cleaning, report, limits)
        stretches = {
            name: [item for part in cleaned if part.split == name for item in part.clean]
            for name in SPLITS
        }
        training = stretches["train"]
        everything = [item for items in stretches.values() for item in items]
        step = one_sample_time(everything)
        if self.v is not None:
            measurements += plausibility.check_velocities(everything, self.q, self.v, step)
            raws = [part.raw for part in cleaned if len(part.raw) > 1]
            measurements += plausibility.check_lost_rows(raws, self.q)
        measurements += plausibility.check_inputs(training, self.q, self.u)
        measurements += plausibility.check_rest(stretches, self.q)
        report.add("Splits", "train", summary(training, step))
        rollouts, earlier = {"train": training}, training
        for name, part in (("validation", self.validation), ("test", self.test)):
            rollouts[name], note = pieces_of(name, part, stretches[name], step)
            report.add("Splits", name, note)
            measurements += check_repeats(earlier, rollouts[name], name)
            earlier = [*earlier, *stretches[name]]
        for text in report.warnings:
            log.warning("%s: %s", self.name, text)
        names = {name: [item.place for item in items] for name, items in rollouts.items()}
        splits = {
            name: [trajectory(item, step, self.interpolation) for item in items]
            for name, items in rollouts.items()
        }
        return _LoadedLog(Splits(**splits), names, cleaned, report)
