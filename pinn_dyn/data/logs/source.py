"""Logs of a robot as a data source: read, checked, split, cleaned."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import NonNegativeFloat, PositiveFloat

from pinn_dyn.data.logs import plausibility
from pinn_dyn.data.logs.checks import check_clock, check_rows
from pinn_dyn.data.logs.columns import Columns, described
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.filters import SavitzkyGolayVelocity
from pinn_dyn.data.logs.measurement import Measurement
from pinn_dyn.data.logs.pieces import Cleaned, one_sample_time, pieces_of, summary, trajectory
from pinn_dyn.data.logs.readers import Request, find_files, read_table, run_name
from pinn_dyn.data.logs.recording import Recording, Report, since_start
from pinn_dyn.data.logs.repeats import check_copies, check_repeats
from pinn_dyn.data.logs.splits import Part, default_split, split
from pinn_dyn.data.logs.step import Step
from pinn_dyn.data.logs.table import Table
from pinn_dyn.data.logs.units import UNITS
from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.mechanics import Interpolation

log = logging.getLogger(__name__)


class LogSource(DataSource):
    """Trajectories from logs: CSV, MATLAB, HDF5, NPZ, Parquet, bags of ROS, or data frames.

    Runs are split, or cut with a guard, before the steps: no filter sees both sides of a border.
    Then the steps are applied in order, validation and test are cut into pieces of one length, and
    every trajectory starts at t = 0. A missing velocity that no step derives is derived by
    :class:`SavitzkyGolayVelocity` at its defaults.

    Columns and parts may also be mappings of their arguments, such as
    ``q={"columns": ["q1", "q2"], "unit": "deg"}``.

    Args:
        name: short name, for tables and titles.
        files: names or glob patterns in the folder ``root``; or a data frame in memory, or data
            frames by the name of their run. Messages name the rows of a frame by its index.
        root: folder of the files.
        time: column of the time.
        q: columns of the configuration, N.
        u: columns of the input, M.
        v: columns of the velocity, N, or None.
        max_age: oldest message of another topic of a bag that a row may use, s.
        trajectory: column that tells the runs of a file apart, or None where a file is one run.
        steps: names and steps of the cleaning, in order; None entries are left out.
        validation, test: whole runs, ``{runs: 2, piece: 5.0}``, the ends of runs,
            ``{seconds: 3.0, piece: 3.0}``, or blocks along them, ``{seconds: 3.0, blocks: 4,
            piece: 3.0}``; pieces in s, or ``whole``. See :class:`Part`. Without both,
            :func:`default_split` chooses them.
        guard: time left out between training, validation and test of one run, s.
        shortest: training stretches shorter than this are dropped, s; at least one window.
        seed: seed of the choice of runs where their number is given.
        interpolation: motion of the input between samples.
        labels, input_labels: name and unit of each coordinate and input; None takes the columns.
        configurations: named configurations for learned terms.
        angles: numbers of the coordinates that are angles of joints, for models that know them by
            sine and cosine.

    Raises:
        LogError: on a description that cannot be right; of the files, by :meth:`load`.
    """

    def __init__(
        self,
        *,
        name: str,
        files: str | Sequence[str] | pd.DataFrame | Mapping[str, pd.DataFrame],
        root: str = ".",
        time: Columns | Mapping[str, Any],
        q: Columns | Mapping[str, Any],
        u: Columns | Mapping[str, Any],
        v: Columns | Mapping[str, Any] | None = None,
        trajectory: str | None = None,
        max_age: PositiveFloat = 0.1,
        steps: Mapping[str, Step | None] | None = None,
        validation: Part | Mapping[str, Any] | None = None,
        test: Part | Mapping[str, Any] | None = None,
        guard: NonNegativeFloat = 0.5,
        shortest: NonNegativeFloat = 0.1,
        seed: int = 0,
        interpolation: Interpolation = "linear",
        labels: list[str] | None = None,
        input_labels: list[str] | None = None,
        configurations: Mapping[str, list[float]] | None = None,
        angles: Sequence[int] = (),
    ):
        self.name = name
        self.root = root
        self._frames: dict[str, pd.DataFrame] = {}
        if isinstance(files, pd.DataFrame):
            self._frames = {"frame": files}
        elif isinstance(files, Mapping):
            self._frames = dict(files)
        self.files: str | Sequence[str] = () if self._frames else files  # type: ignore[assignment]
        self.time: Columns = described(Columns, "time", time)
        self.q: Columns = described(Columns, "q", q)
        self.u: Columns = described(Columns, "u", u)
        self.v: Columns | None = None if v is None else described(Columns, "v", v)
        signals = {"time": self.time, "q": self.q, "v": self.v, "u": self.u}
        self._signals = {key: columns for key, columns in signals.items() if columns is not None}
        self._check_columns()
        self.trajectory = trajectory
        self.max_age = max_age
        self.steps = {key: step for key, step in (steps or {}).items() if step is not None}
        if (validation is None) != (test is None):
            raise LogError("expected both validation and test, or neither for the default split")
        self.validation: Any = validation and described(Part, "validation", validation)
        self.test: Any = test and described(Part, "test", test)
        self.guard = guard
        self.shortest = shortest
        self.seed = seed
        self.interpolation = interpolation
        self.labels = labels or self.q.labels
        self.input_labels = input_labels or self.u.labels
        for key, names, columns in (
            ("labels", self.labels, self.q),
            ("input_labels", self.input_labels, self.u),
        ):
            if len(names) != len(columns.columns):
                raise LogError(f"{key} has {len(names)} entries, expected {len(columns.columns)}")
        for step in self.steps.values():
            self.input_labels = step.input_labels(self.input_labels)
        self.system = None
        self.angles = tuple(angles)
        for k in self.angles:
            if not (0 <= k < len(self.q.columns) and self.q.units[k] == "rad"):
                raise LogError(f"angles is {list(angles)}, expected numbers of angles in q, from 0")
        self.configurations = dict(configurations or {})
        self._measurements: list[Measurement] = []
        self._loaded: tuple[Splits, Report, list[Cleaned]] | None = None

    def _check_columns(self) -> None:
        """Check the units of the signals, and that no column holds two of them."""
        self.time.check_units("time", ["s"])
        if len(self.time.columns) > 1:
            raise LogError(f"time has the columns {self.time.columns}, expected one")
        self.q.check_units("q", ["rad", "m", "1"])
        self.u.check_units("u", sorted({unit for unit, _ in UNITS.values()} - {"s"}))
        if self.v is not None and self.v.units != [f"{unit}/s" for unit in self.q.units]:
            raise LogError(f"v has the units {self.v.units}, expected {self.q.units} per second")
        users: dict[str, str] = {}
        for signal, columns in self._signals.items():
            for name in columns.columns:
                if (user := users.setdefault(name, signal)) != signal:
                    raise LogError(f"column {name!r} is in {user} and in {signal}")

    def load(self) -> Splits:
        """Return the cleaned trajectories.

        Raises:
            LogError: on a file that cannot be used; names the file, the place and what to do.
        """
        return self._load()[0]

    @property
    def report(self) -> str:
        """Notes of each step, and all warnings, as Markdown."""
        return self._load()[1].markdown(self.warnings)

    @property
    def measurements(self) -> list[Measurement]:
        """Measurements of the checks that every log passes through when it is read."""
        self._load()
        return self._measurements

    @property
    def warnings(self) -> list[str]:
        """Texts of the measurements that are warnings."""
        return [x.text for x in self.measurements if x.verdict != "ok"]

    @property
    def cleaned(self) -> list[Cleaned]:
        """Every stretch before and after the cleaning: training first, then validation, test."""
        return self._load()[2]

    def recordings(self, frame: pd.DataFrame) -> list[tuple[np.ndarray, Recording, Recording]]:
        """Read the runs of a table with the columns and units of the log, and clean them.

        They are read with the checks of a file and cleaned by the steps of this source, each run
        alone. A frame without the column of the trajectory is one run.

        Args:
            frame: the columns of time, q, u, and v where the log has it.

        Returns:
            For each run the positions of its rows in the frame, these rows in SI units, and the
            run after the cleaning.

        Raises:
            LogError: on a frame that cannot be used, as on a file; or naming a step that needs the
                training runs, or does not leave exactly one stretch of a run.
        """
        if not len(frame):
            raise LogError("the frame has no rows, expected at least two")
        table = Table(frame, "the frame")
        runs = {"the frame": np.ones(len(frame), dtype=bool)}
        if self.trajectory is not None and self.trajectory in frame.columns:
            runs = table.runs(self.trajectory)
        raws = self._recordings(table, runs, Report(self.name), [])
        return [
            (np.flatnonzero(rows), raw, self._clean_alone(raw))
            for rows, raw in zip(runs.values(), raws, strict=True)
        ]

    def _clean_alone(self, raw: Recording) -> Recording:
        """Return a run after all steps, which must keep it in one stretch."""
        clean = raw
        for name, step in self.steps.items():
            parts, text = step.apply(clean)
            if len(parts) != 1:
                raise LogError(
                    f"{raw.place}: steps.{name} leaves {len(parts)} stretches ({text}), expected "
                    "one: pass each in its own frame"
                )
            (clean,) = parts
        if clean.v is None:
            ((clean,), _) = SavitzkyGolayVelocity().apply(clean)
        return clean

    def names(self) -> dict[str, list[str]]:
        self.load()
        return self._names

    def _load(self) -> tuple[Splits, Report, list[Cleaned]]:
        if self._loaded is not None:
            return self._loaded
        report = Report(self.name)
        measurements: list[Measurement] = []
        self._measurements = measurements
        recordings = self._read(report, measurements)
        measurements += plausibility.check_stamps(recordings, self._repairs())
        measurements += plausibility.check_angles(recordings, self.q)
        if self.test is None:
            times = {item.run: item.t for item in recordings}
            self.validation, self.test, self.guard = default_split(times, self.seed)
        parts = split(recordings, self.validation, self.test, guard=self.guard, seed=self.seed)
        measurements += check_copies(parts)
        cleaned = self._clean(parts, report, measurements)
        step = one_sample_time(cleaned)
        stretches = {
            name: [item for part in cleaned if part.split == name for item in part.clean]
            for name in SPLITS
        }
        training = stretches["train"]
        if self.v is not None:
            measurements += plausibility.check_velocities(stretches, self.q, self.v, step)
        measurements += plausibility.check_force_signs(training, self.u, step)
        measurements += plausibility.check_inputs(training, self.u)
        measurements += plausibility.check_rest(training, self.q)
        report.add("Splits", "train", summary(training, step))
        pieces = {"train": training}
        for name, part in (("validation", self.validation), ("test", self.test)):
            pieces[name], note = pieces_of(name, part, cleaned, step)
            report.add("Splits", name, note)
        for name in ("validation", "test"):
            measurements += check_repeats(training, pieces[name], name)
        for text in dict.fromkeys(x.text for x in measurements if x.verdict != "ok"):
            log.warning("%s: %s", self.name, text)
        splits = Splits(
            **{
                name: [trajectory(item, step, self.interpolation) for item in items]
                for name, items in pieces.items()
            }
        )
        self._names = {name: [item.place for item in items] for name, items in pieces.items()}
        self._loaded = splits, report, cleaned
        return self._loaded

    def _repairs(self) -> set[str]:
        return {fault for step in self.steps.values() for fault in step.repairs}

    def _read(self, report: Report, measurements: list[Measurement]) -> list[Recording]:
        recordings: list[Recording] = []
        tables = self._tables()
        for stem, table in tables.items():
            for note in table.notes:
                text = f"{stem}: {note}"
                measurements.append(Measurement("rows", stem, verdict="warning", text=text))
            runs = {stem: np.ones(len(table), dtype=bool)}
            if self.trajectory is not None:
                prefix = f"{stem}:" if len(tables) > 1 else ""
                rows_of_runs = table.runs(self.trajectory)
                runs = {f"{prefix}{run}": rows for run, rows in rows_of_runs.items()}
            recordings += self._recordings(table, runs, report, measurements)
        return recordings

    def _tables(self) -> dict[str, Table]:
        """Return the frames in memory, or read the files, by the name of their run."""
        if self._frames:
            several = len(self._frames) > 1
            return {
                name: Table(frame, f"the frame {name!r}" if several else "the frame")
                for name, frame in self._frames.items()
            }
        names = [name for signal in self._signals.values() for name in signal.columns]
        names += [] if self.trajectory is None else [self.trajectory]
        request = Request(self.time.columns[0], names, self.max_age)
        paths: dict[str, Path] = {}
        tables = {}
        for path in find_files(self.root, self.files):
            stem = run_name(path, self.root)
            if (first := paths.setdefault(stem, path)) is not path:
                raise LogError(f"{first} and {path} are both the run {stem!r}: rename one of them")
            tables[stem] = read_table(path, request)
        return tables

    def _recordings(
        self,
        table: Table,
        runs: Mapping[str, np.ndarray],
        report: Report,
        measurements: list[Measurement],
    ) -> list[Recording]:
        """Convert the runs of a table, masks of its rows, to SI units, and check them."""
        values = {
            signal: columns.to_si(table.numbers(columns.columns, signal))
            for signal, columns in self._signals.items()
        }
        repairs = self._repairs()
        (clock,) = self.time.columns
        recordings = []
        for run, rows in runs.items():
            part = table.select(rows)
            times, remark = since_start(values["time"][rows])
            (t,) = times.T
            check_clock(t, part, clock, repairs)
            signals = {key: x[rows] for key, x in values.items() if key != "time"}
            for signal, x in signals.items():
                columns = self._signals[signal]
                measurements += check_rows(part, t, signal, columns, x, repairs)
            recordings.append(Recording(run, t, signals["q"], signals.get("v"), signals["u"]))
            text = f"{len(t)} rows, {t[-1] - t[0]:.6g} s, from {Path(table.name).name}{remark}"
            report.add("Read", run, text)
        return recordings

    def _clean(
        self,
        parts: dict[str, list[Recording]],
        report: Report,
        measurements: list[Measurement],
    ) -> list[Cleaned]:
        """Apply the steps in order, fitted on the training; drop stretches that are too short."""
        cleaned = [Cleaned(key, raw, [raw]) for key, raws in parts.items() for raw in raws]
        cleaned = self._long_enough("splitting", cleaned, measurements)
        for name, step in self.steps.items():
            cleaned = self._apply(name, step, cleaned, report, measurements)
        if any(item.v is None for part in cleaned for item in part.clean):
            step = SavitzkyGolayVelocity()
            cleaned = self._apply("velocity", step, cleaned, report, measurements)
        return cleaned

    def _apply(
        self,
        name: str,
        step: Step,
        cleaned: Sequence[Cleaned],
        report: Report,
        measurements: list[Measurement],
    ) -> list[Cleaned]:
        result = []
        for part in cleaned:
            clean = []
            for recording in part.clean:
                try:
                    stretches, text = step.apply(recording)
                except ValueError as error:  # also of SciPy, as of too few samples
                    raise LogError(f"{recording.place}, step {name}: {error}") from error
                report.add(f"{name}: {step}", f"{part.split} {recording.place}", text)
                clean += stretches
            result.append(replace(part, clean=clean))
        before, after = (
            [item for part in parts for item in part.clean] for parts in (cleaned, result)
        )
        for text in step.losses(before, after):
            warning = f"{name}: {step}: {text}"
            measurements.append(Measurement("step", name, verdict="warning", text=warning))
        return self._long_enough(name, result, measurements)

    def _long_enough(
        self, name: str, cleaned: Sequence[Cleaned], measurements: list[Measurement]
    ) -> list[Cleaned]:
        """Drop the stretches that a step left shorter than a piece or than ``shortest``.

        Raises:
            LogError: if nothing of a split is left.
        """
        least = {"train": self.shortest}
        for key, piece in (("validation", self.validation.piece), ("test", self.test.piece)):
            least[key] = self.shortest if piece == "whole" else piece
        result = []
        for part in cleaned:
            clean = []
            shortest = least[part.split]
            for item in part.clean:
                # Half a sample: times are rounded.
                if len(item) > 1 and item.duration >= shortest - 0.5 * (item.t[1] - item.t[0]):
                    clean.append(item)
                else:
                    text = (
                        f"{part.split} {item.place} after {name}: {item.duration:.4g} s, shorter "
                        f"than {shortest:g} s (piece or shortest): dropped"
                    )
                    measurements.append(Measurement("length", verdict="warning", text=text))
            result.append(replace(part, clean=clean))
        for split_name, shortest in least.items():
            if not any(part.clean for part in result if part.split == split_name):
                raise LogError(
                    f"{split_name}: after {name} no stretch lasts {shortest:g} s (its piece, or "
                    "shortest): lower it, or loosen the steps (the warnings name the stretches)"
                )
        return result
