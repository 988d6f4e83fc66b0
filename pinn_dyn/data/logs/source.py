"""Logs of a robot as a data source: read, checked, split, cleaned."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pinn_dyn.data.fingerprint import describe
from pinn_dyn.data.logs.checks import (
    check_angles,
    check_clock,
    check_force_signs,
    check_inputs,
    check_rest,
    check_second_clock,
    check_stamps,
    check_unseen_inputs,
    check_velocities,
    check_velocities_of_runs,
)
from pinn_dyn.data.logs.columns import Columns, check_columns, check_units
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.filters import SavitzkyGolayVelocity
from pinn_dyn.data.logs.jumps import Rows, check_rows
from pinn_dyn.data.logs.pieces import (
    Cleaned,
    long_enough,
    one_sample_time,
    pieces_of,
    summary,
    trajectory,
)
from pinn_dyn.data.logs.reader import find_files, read_table, run_name
from pinn_dyn.data.logs.recording import Recording, Report, since_start
from pinn_dyn.data.logs.repairs import RemoveJumps
from pinn_dyn.data.logs.repeats import check_copies, check_repeats
from pinn_dyn.data.logs.splits import Part, default_split, split
from pinn_dyn.data.logs.step import Step
from pinn_dyn.data.logs.table import Table
from pinn_dyn.data.logs.twins import check_twins, check_units_of_runs
from pinn_dyn.data.logs.units import UNITS
from pinn_dyn.data.source import SPLITS, DataSource, Splits
from pinn_dyn.mechanics import Interpolation

# What the trajectories depend on beside the files.
_SETTINGS = (
    *("time", "q", "v", "u", "trajectory", "max_age", "steps", "validation", "test"),
    *("guard", "shortest", "seed", "interpolation"),
)


class LogSource(DataSource):
    """Trajectories from logs: CSV, MATLAB, HDF5, NPZ, Parquet and bags of ROS.

    Runs are split, or cut with a guard, before the steps: no filter sees both sides of a border.
    Then the steps are applied in order, validation and test are cut into pieces of one length, and
    every trajectory starts at t = 0. A missing velocity that no step derives is derived by
    :class:`SavitzkyGolayVelocity` at its defaults.

    Args:
        name: short name, for tables and titles.
        files: names or glob patterns in the folder ``root``; or a data frame in memory, or data
            frames by the name of their run. Messages name the rows of a frame by its index.
        root: folder of the files.
        time: column of the time; a second column is a clock that must agree with the first.
        q: columns of the configuration, N.
        u: columns of the input, M.
        v: columns of the velocity, N, or None.
        max_age: how old a message of another topic of a bag may be at a row, s.
        trajectory: column that tells the runs of a file apart, or None where a file is one run.
        steps: names and steps of the cleaning, in order; None entries are left out.
        validation, test: whole runs, ``{runs: 2, piece: 5.0}``, the ends of runs,
            ``{seconds: 3.0, piece: 3.0}``, or blocks along them, ``{seconds: 3.0, blocks: 4,
            piece: 3.0}``; pieces in s, or ``whole``. See :class:`Part`. Without both,
            :func:`default_split` chooses them.
        guard: time left out between training, validation and test of one run, s.
        shortest: training stretches shorter than this are dropped, s; at least one window.
        seed: draws the runs where their number is given.
        interpolation: how the input moves between samples.
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
        max_age: float = 0.1,
        steps: Mapping[str, Step | None] | None = None,
        validation: Part | Mapping[str, Any] | None = None,
        test: Part | Mapping[str, Any] | None = None,
        guard: float = 0.5,
        shortest: float = 0.1,
        seed: int = 0,
        interpolation: Interpolation = "linear",
        labels: list[str] | None = None,
        input_labels: list[str] | None = None,
        configurations: Mapping[str, list[float]] | None = None,
        angles: Sequence[int] = (),
    ):
        self.name = name
        self.root = root
        self._frames: dict[str, pd.DataFrame] | None = None
        if isinstance(files, pd.DataFrame):
            self._frames = {"frame": files}
        elif isinstance(files, Mapping):
            self._frames = dict(files)
        self.files = () if self._frames is not None else files
        self.time = Columns.from_config("time", time)
        self.q = Columns.from_config("q", q)
        self.u = Columns.from_config("u", u)
        self.v = None if v is None else Columns.from_config("v", v)
        if set(self.time.units) != {"s"}:
            raise LogError(f"time has the unit {self.time.file_units[0]!r}, expected one of time")
        if self.v is not None and self.v.units != [f"{unit}/s" for unit in self.q.units]:
            raise LogError(
                f"v has the SI units {', '.join(self.v.units)}, expected those of q, "
                f"{', '.join(self.q.units)}, per second, in the same order"
            )
        check_units("q", self.q, ("rad", "m", "1"))
        check_units("u", self.u, sorted({unit for unit, _ in UNITS.values()} - {"s"}))
        signals = {"time": self.time, "q": self.q, "v": self.v, "u": self.u}
        self._signals = {key: columns for key, columns in signals.items() if columns is not None}
        check_columns(self._signals)
        self.trajectory = trajectory
        if not max_age > 0:
            raise LogError(f"max_age is {max_age} s, expected more than 0")
        self.max_age = max_age
        self.steps = {key: step for key, step in (steps or {}).items() if step is not None}
        if (validation is None) != (test is None):
            raise LogError("expected both validation and test, or neither for the default split")
        self.validation = test and Part.from_config("validation", validation)
        self.test = test and Part.from_config("test", test)
        if not (0 <= guard < math.inf and 0 <= shortest < math.inf):
            raise LogError(f"guard is {guard} and shortest {shortest} s, expected 0 or more")
        self.guard = guard
        self.shortest = shortest
        self.seed = seed
        self.interpolation = interpolation
        self.labels = labels or self.q.labels
        self.input_labels = input_labels or self.u.labels
        for key, given, count in (
            ("labels", self.labels, len(self.q.columns)),
            ("input_labels", self.input_labels, len(self.u.columns)),
        ):
            if len(given) != count:
                raise LogError(f"{key} has {len(given)} entries, expected {count}")
        for step in self.steps.values():
            self.input_labels = step.input_labels(self.input_labels)
        self.system = None
        self.angles = tuple(angles)
        for k in self.angles:
            if not (0 <= k < len(self.q.columns) and self.q.units[k] == "rad"):
                raise LogError(
                    f"angles is {list(angles)}, expected numbers of columns of q, from 0, that "
                    f"have a unit of angle: their SI units are {', '.join(self.q.units)}"
                )
        self.configurations = dict(configurations or {})
        self._loaded: tuple[Splits, Report, list[Cleaned]] | None = None

    def load(self) -> Splits:
        """The cleaned trajectories.

        Raises:
            LogError: on a file that cannot be used; names the file, the place and what to do.
        """
        return self._load()[0]

    def recordings(self, frame: pd.DataFrame) -> list[tuple[np.ndarray, Recording, Recording]]:
        """The runs of a table with the columns and units of the log, before and after the cleaning.

        They are read with the checks of a file and cleaned alone, by the steps of this source. A
        frame without the column of the trajectory is one run.

        Args:
            frame: the columns of time, q, u, and v where the log has it.

        Returns:
            For each run which rows of the frame are its own, ``(rows,)``, these rows in SI units,
            and what the cleaning made of them.

        Raises:
            LogError: on a frame that cannot be used, as on a file; or naming a step that needs the
                training runs, or leaves other than one stretch of a run.
        """
        if not len(frame):
            raise LogError("the frame has no rows, expected at least two")
        for name, step in self.steps.items():
            if step.learns:
                raise LogError(
                    f"steps.{name}: {step} takes something from the training runs, which a frame "
                    "does not have: give it in the configuration, and train again"
                )
        table = Table(frame, "the frame")
        runs = {"the frame": np.ones(len(frame), dtype=bool)}
        if self.trajectory is not None and self.trajectory in frame.columns:
            runs = table.runs(self.trajectory)
        raws = self._recordings(table, runs, Report(self.name))
        return [
            (np.flatnonzero(rows), raw, self._clean_alone(raw))
            for rows, raw in zip(runs.values(), raws, strict=True)
        ]

    def _clean_alone(self, raw: Recording) -> Recording:
        """A run after all steps, which keep it in one piece."""
        clean = raw
        for name, step in self.steps.items():
            parts, text = step.apply(clean)
            if len(parts) != 1:
                raise LogError(
                    f"{raw.place}: steps.{name} leaves {len(parts)} stretches of it ({text}), "
                    "expected one: give each in a frame of its own"
                )
            (clean,) = parts
        if clean.v is None:
            ((clean,), _) = SavitzkyGolayVelocity().apply(clean)
        return clean

    def fingerprint(self) -> dict[str, object]:
        """Files (name, size, SHA-256), rows, columns, cleaning, and the stretches of each split."""
        if self._frames is not None:
            return {"files": {}, **super().fingerprint()}
        root = Path(self.root).expanduser()
        files = {
            path.relative_to(root).as_posix(): {
                "bytes": path.stat().st_size,
                "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            }
            for found in find_files(self.root, self.files)
            for path in ([found] if found.is_file() else sorted(found.rglob("*")))
            if path.is_file()
        }
        splits: dict[str, list[str]] = {split: [] for split in SPLITS}
        for part in self.cleaned:
            splits[part.split].append(f"{part.raw.place}, {len(part.raw)} rows")
        settings = {key: describe(getattr(self, key)) for key in _SETTINGS}
        return {"files": files, "splits": splits, **settings}

    @property
    def report(self) -> str:
        """What each step did, and all warnings, as Markdown."""
        return str(self._load()[1])

    @property
    def warnings(self) -> list[str]:
        """What looked wrong, a sentence each."""
        return self._load()[1].warnings

    @property
    def cleaned(self) -> list[Cleaned]:
        """Every stretch before and after the cleaning: training first, then validation, test."""
        return self._load()[2]

    def _load(self) -> tuple[Splits, Report, list[Cleaned]]:
        if self._loaded is None:
            report = Report(self.name)
            recordings = self._read(report)
            check_stamps(recordings, list(self.steps.values()), report)
            check_inputs(recordings, self.u, report)
            check_angles(recordings, self.q, report)
            measured = {key: x for key, x in self._signals.items() if key != "time"}
            check_twins(recordings, measured, report)
            check_units_of_runs(recordings, measured, report)
            if self.validation is None or self.test is None:
                times = {item.run: item.t for item in recordings}
                self.validation, self.test, self.guard = default_split(times, self.seed)
            parts = split(recordings, self.validation, self.test, guard=self.guard, seed=self.seed)
            check_copies(parts, report)
            cleaned = self._clean(parts, report)
            step = one_sample_time(cleaned)
            stretches: dict[str, list[Recording]] = {split: [] for split in SPLITS}
            for one in cleaned:
                stretches[one.split] += one.clean
            training = stretches["train"]
            if self.v is not None:
                check_velocities(training, self.q, self.v, step, report)
                check_velocities_of_runs(stretches, self.q, self.v, step, report)
            check_force_signs(training, self.u, step, report)
            check_rest(training, self.q, report)
            report.add("Splits", "train", summary(training, step))
            kept = {"train": training}
            for name, part in (("validation", self.validation), ("test", self.test)):
                kept[name] = pieces_of(name, part, cleaned, step, report)
            check_unseen_inputs(training, kept["validation"] + kept["test"], self.u, report)
            for name in ("validation", "test"):
                check_repeats(training, kept[name], name, report)
            splits = Splits(
                **{
                    name: [trajectory(item, step, self.interpolation) for item in items]
                    for name, items in kept.items()
                }
            )
            self._loaded = splits, report, cleaned
        return self._loaded

    def _read(self, report: Report) -> list[Recording]:
        recordings: list[Recording] = []
        tables = self._tables()
        for stem, table in tables.items():
            for note in table.notes:
                report.warn(f"{stem}: {note}")
            runs = {stem: np.ones(len(table), dtype=bool)}
            if self.trajectory is not None:
                prefix = f"{stem}:" if len(tables) > 1 else ""
                of_table = table.runs(self.trajectory)
                runs = {f"{prefix}{run}": rows for run, rows in of_table.items()}
            recordings += self._recordings(table, runs, report)
        return recordings

    def _tables(self) -> dict[str, Table]:
        """Return the frames in memory, or read the files, by the name of their run."""
        if self._frames is not None:
            several = len(self._frames) > 1
            return {
                name: Table(frame, f"the frame {name!r}" if several else "the frame")
                for name, frame in self._frames.items()
            }
        names = [name for signal in self._signals.values() for name in signal.columns]
        names += [] if self.trajectory is None else [self.trajectory]
        paths: dict[str, Path] = {}
        tables = {}
        for path in find_files(self.root, self.files):
            stem = run_name(path, self.root)
            if (first := paths.setdefault(stem, path)) is not path:
                raise LogError(
                    f"{first} and {path} are both the run {stem!r}: rename one of them, or leave "
                    "it out of 'files'"
                )
            tables[stem] = read_table(path, self.time.columns[0], names, self.max_age)
        return tables

    def _recordings(
        self, table: Table, runs: Mapping[str, np.ndarray], report: Report
    ) -> list[Recording]:
        """Convert the runs of a table, masks of its rows, to SI units, and check them."""
        values = {
            signal: columns.to_si(table.numbers(columns.columns, signal))
            for signal, columns in self._signals.items()
        }
        steps = list(self.steps.values())
        repaired = {signal for x in steps if isinstance(x, RemoveJumps) for signal in x.signals}
        clock, *clocks = self.time.columns
        recordings = []
        for run, rows in runs.items():
            part = table.select(rows)
            times, since = since_start(values["time"][rows])
            t, *second_clocks = times.T
            check_clock(t, part, clock, steps)
            for name, second in zip(clocks, second_clocks, strict=True):
                check_second_clock(t, second, part, (clock, name))
            for signal in ("q", "v", "u"):
                if signal in values:
                    cells = Rows(part, signal, self._signals[signal], values[signal][rows])
                    check_rows(cells, t, report, jumps_are_removed=signal in repaired)
            v = values["v"][rows] if "v" in values else None
            recordings.append(Recording(run, t, values["q"][rows], v, values["u"][rows]))
            source = Path(table.name).name
            text = f"{len(t)} rows, {t[-1] - t[0]:.6g} s, from {source}{since}"
            report.add("Read", run, text)
        return recordings

    def _clean(self, parts: dict[str, list[Recording]], report: Report) -> list[Cleaned]:
        whole = [Cleaned(key, raw, [raw]) for key, raws in parts.items() for raw in raws]
        cleaned = long_enough("splitting", whole, self._shortest(), report)
        for name, step in self.steps.items():
            fitted = step.fit([x for part in cleaned if part.split == "train" for x in part.clean])
            cleaned = self._apply(name, fitted, cleaned, report)
        if any(item.v is None for part in cleaned for item in part.clean):
            cleaned = self._apply("velocity", SavitzkyGolayVelocity(), cleaned, report)
        return cleaned

    def _apply(
        self, name: str, step: Step, cleaned: list[Cleaned], report: Report
    ) -> list[Cleaned]:
        result = []
        for part in cleaned:
            done = []
            for recording in part.clean:
                changed, text = step.apply(recording)
                report.add(f"{name}: {step}", f"{part.split} {recording.place}", text)
                done += changed
            result.append(replace(part, clean=done))
        before, after = (
            [item for part in parts for item in part.clean] for parts in (cleaned, result)
        )
        for text in step.losses(before, after):
            report.warn(f"{name}: {step}: {text}")
        return long_enough(name, result, self._shortest(), report)

    def _shortest(self) -> dict[str, tuple[str, float]]:
        """Name and length in s of the shortest useful stretch of each split."""
        least = {"train": ("shortest", self.shortest)}
        for key, part in (("validation", self.validation), ("test", self.test)):
            assert part is not None
            least[key] = (
                ("shortest", self.shortest)
                if isinstance(part.piece, str)
                else ("its piece", part.piece)
            )
        return least
