"""Results of an evaluation on trajectories that no training saw: tables, figures and a page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from pinn_dyn.atomic_files import write_whole
from pinn_dyn.data import DataSource
from pinn_dyn.evaluation.calibration import Calibration
from pinn_dyn.evaluation.figures import (
    ERROR,
    calibration_figure,
    error_figure,
    modes_figure,
    terms_figure,
    trajectory_figure,
)
from pinn_dyn.evaluation.learned_terms import TermComparison
from pinn_dyn.evaluation.prediction import Prediction
from pinn_dyn.evaluation.report.page import Origin, Section, drawing, page, paragraph, table
from pinn_dyn.evaluation.report.prediction_page import (
    constants_parts,
    interval_parts,
    mode_parts,
    summary_parts,
    table_parts,
    term_parts,
    trajectory_parts,
)
from pinn_dyn.evaluation.tables import (
    SEEDS_COLUMNS,
    preferred_run,
    summary_columns,
    to_text,
    unbeaten_baselines,
    with_unit,
    write_table,
)
from pinn_dyn.mechanics import Trajectory
from pinn_dyn.models.modes import Modes
from pinn_dyn.plots import save

SPLITS = {"test": "unseen test trajectories", "validation": "validation trajectories"}
MAX_TRAJECTORIES = 20
"""Largest number of trajectories that the slider offers."""
_TORQUE = (
    "Error of the inverse dynamics on the same motions: RMS of τ̂ − τ with τ = A(q) u, spread of τ, "
    "and their ratio."
)
_PARTS = (
    "RMS of the forces of the parts of a sum along the test motions. A network with a large share "
    "shows that the known mechanics lack something, or have wrong constants."
)


@dataclass
class Evaluation:
    """Results of an evaluation.

    Attributes:
        source: the data set.
        split: ``test`` or ``validation``.
        truth: the K trajectories stacked, q ``(K, T, N)``.
        summary: one row per run and baseline, with all metrics.
        by_model: mean and standard deviation over seeds.
        torque: torque errors, one row per run and joint; empty without mechanical models.
        ensembles: errors and spreads of members, one row per ensemble; empty without ensembles.
        parts: contributions of the parts of sums, one row per run, part and term.
        predictions: rollouts by name of the row, baselines included.
        intervals: calibration by run and window in s; runs without members have none.
        terms: learned terms beside the true ones, by run; empty where the truth is unknown.
        modes: modes of the models of oscillators at the mean input, by run.
        constants: tables of fitted constants, by run.
        origin: command, commit, data and configurations, for the page.
        added: own sections of the page, see :meth:`add_section`.
    """

    source: DataSource
    split: str
    truth: Trajectory
    summary: pd.DataFrame
    by_model: pd.DataFrame
    torque: pd.DataFrame
    ensembles: pd.DataFrame
    parts: pd.DataFrame
    predictions: dict[str, Prediction]
    intervals: dict[str, dict[float, Calibration]]
    terms: dict[str, TermComparison]
    modes: Mapping[str, Modes] = field(default_factory=dict)
    constants: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    origin: Origin | None = None
    added: list[Section] = field(default_factory=list)

    @property
    def models(self) -> dict[str, Prediction]:
        """Rollouts of the trained models."""
        names = self.summary["run"][~self.summary["baseline"]]
        return {name: self.predictions[name] for name in names}

    @property
    def baselines(self) -> dict[str, Prediction]:
        """Rollouts of the baselines."""
        return {k: item for k, item in self.predictions.items() if k not in self.models}

    @property
    def best_baseline(self) -> dict[str, Prediction]:
        """Rollouts of the most accurate baseline with the fewest diverged trajectories."""
        rows = self.summary[self.summary["baseline"]].sort_values(["diverged", "error_mean"])
        return {name: self.predictions[name] for name in rows["run"][:1]}

    @property
    def trajectories(self) -> str:
        """Number and kind of the trajectories, for titles."""
        return f"{len(self.truth.q)} {SPLITS[self.split]}, {self.truth.duration:g} s open loop"

    def __str__(self) -> str:
        lines = [
            f"{self.source.name}: {self.trajectories}",
            to_text(self.summary, summary_columns(self.summary)),
            "* best in its column, and better than all baselines (in brackets)",
            *preferred_run(self.summary),
            *unbeaten_baselines(self.summary),
        ]
        if len(self.by_model) < len(self.summary):
            lines += ["", "over seeds:", to_text(self.by_model, SEEDS_COLUMNS)]
        return "\n".join(lines)

    def figures(self, trajectory: int = 0) -> Iterator[tuple[str, Figure]]:
        """Yield the names of all figures, and the figures; one draws a single ``trajectory``."""
        title = f"{self.source.name}, {self.trajectories}"
        labels = self.source.labels
        name = f"{self.source.name}, {self.split} trajectory {trajectory}, open loop"
        yield "trajectory", self._trajectory_figure(trajectory, name)
        error = with_unit(ERROR, labels)
        figure = error_figure(self.models, baselines=self.baselines, title=title, label=error)
        yield "error", figure
        if self.intervals:
            yield "calibration", calibration_figure(self.intervals, title=title)
        for run, comparison in self.terms.items():
            for k, name in enumerate(comparison.names):
                text = f"{run}: learned and true terms, {name}"
                figure = terms_figure(comparison, configuration=k, title=text)
                yield f"terms_{_stem(run)}_{name}", figure
        for run, modes in self.modes.items():
            text = f"{run}: modes at the mean input"
            yield f"modes_{_stem(run)}", modes_figure(modes, title=text, labels=labels)

    def save(self, folder: str | Path, trajectory: int = 0) -> None:
        """Write the tables as CSV, the figures as PNG, and the page ``report.html``."""
        folder, labels = Path(folder), self.source.labels
        tables = {
            "summary": self.summary,
            "by_model": self.by_model,
            "torque": self.torque,
            "ensembles": self.ensembles,
            "parts": self.parts,
        }
        tables |= {f"terms_{_stem(run)}": x.to_frame() for run, x in self.terms.items()}
        tables |= {f"modes_{_stem(run)}": x.to_frame(labels) for run, x in self.modes.items()}
        for stem, frame in tables.items():
            if len(frame):
                write_table(frame, folder, stem)
        figures = dict(self.figures(trajectory))
        for name, figure in figures.items():
            save(figure, folder / f"{name}.png")
        write_whole(folder / "report.html", self.page(figures, trajectory))

    def add_section(self, title: str, *contents: str | pd.DataFrame | Figure) -> None:
        """Add a section to the page: paragraphs, tables and figures of matplotlib."""
        parts = []
        for content in contents:
            if isinstance(content, Figure):
                parts.append(drawing(content, title))
            elif isinstance(content, pd.DataFrame):
                parts.append(table(content))
            else:
                parts.append(paragraph(content))
        self.added.append(Section(title, parts))

    def page(self, figures: Mapping[str, Figure], trajectory: int = 0) -> str:
        """Return the page as HTML text, with :meth:`figures`; it first shows ``trajectory``."""
        title = f"{self.source.name}: trained models on unseen motions"
        return page(title, self.trajectories, self.sections(figures, trajectory))

    def sections(self, figures: Mapping[str, Figure], trajectory: int = 0) -> list[Section]:
        """Return the sections of the page that have a content, and at the end the added ones."""
        labels = self.source.labels
        terms = [figure for name, figure in figures.items() if name.startswith("terms_")]
        modes = [figures[f"modes_{_stem(run)}"] for run in self.modes]
        parts = {
            "Summary": summary_parts(self.summary, self.by_model, labels),
            "Error over time": [drawing(figures["error"], "error over time")],
            "Trajectories": self._trajectories(trajectory),
            "Constants": constants_parts(self.constants),
            "Torque": table_parts(self.torque, _TORQUE),
            "Parts": table_parts(self.parts, _PARTS),
            "Intervals": interval_parts(figures.get("calibration")),
            "Learned and true terms": term_parts(terms),
            "Modes": mode_parts(self.modes, modes, labels),
        }
        sections = [Section(title, [*content]) for title, content in parts.items()]
        sections = [section for section in sections if section.parts] + self.added
        return sections if self.origin is None else [*sections, self.origin.section()]

    def _trajectories(self, first: int) -> Iterator[Markup]:
        trained = self.summary[~self.summary["baseline"]]
        worst = dict(zip(trained["run"], trained["worst_trajectory"], strict=True))
        median = {}
        for run, prediction in self.models.items():
            order = prediction.error().mean(dim=1).nan_to_num(math.inf).argsort()
            median[run] = int(order[len(order) // 2])
        count = len(self.truth.q)
        offered = dict.fromkeys([first, *worst.values(), *median.values(), *range(count)])
        numbers = list(offered)[:MAX_TRAJECTORIES]
        figures = ((number, self._trajectory_figure(number)) for number in numbers)
        return trajectory_parts(figures, median, worst)

    def _trajectory_figure(self, number: int, title: str = "") -> Figure:
        return trajectory_figure(
            self.truth,
            self.models,
            trajectory=number,
            title=title,
            labels=self.source.labels,
            input_labels=self.source.input_labels,
            baselines=self.best_baseline,
        )


def _stem(run: str) -> str:
    return "".join(c if c.isalnum() or c in "-.=" else "_" for c in run)
