"""Results of the check of a log: measurements with verdicts, their page, and stored verdicts."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from markupsafe import Markup

from pinn_dyn import wording
from pinn_dyn.atomic_files import write_whole
from pinn_dyn.data import logs
from pinn_dyn.data.logs import LogSource, Measurement
from pinn_dyn.evaluation.log_figures import cleaning_figure
from pinn_dyn.evaluation.report.page import (
    Section,
    details,
    drawing,
    from_markdown,
    page,
    paragraph,
    preformatted,
    table,
)
from pinn_dyn.identification.rigid_excitation import RigidExcitation
from pinn_dyn.log_check.delay import DelayCurve
from pinn_dyn.log_check.equation import Regressor
from pinn_dyn.log_check.figures import delay_curves, forces, residuals
from pinn_dyn.log_check.runs import Equation


def store(source: LogSource, rigid: Regressor | None, measurements: Sequence[Measurement]) -> None:
    """Keep the texts of what is not ok in the cache."""
    texts = list(dict.fromkeys(x.text for x in measurements if x.verdict != "ok"))
    path = _path(source, rigid)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(texts))


def stored(source: LogSource, rigid: Regressor | None) -> list[str] | None:
    """Return the texts of the last check of the same data and robot; None if there was none."""
    path = _path(source, rigid)
    return json.loads(path.read_text()) if path.exists() else None


def _path(source: LogSource, rigid: Regressor | None) -> Path:
    """Return the file of a log and a robot: the numbers of both, not their names, are its key."""
    key = hashlib.sha256(repr([source.labels, source.input_labels]).encode())
    for part in source.cleaned:
        for item in part.clean:
            for values in (item.t, item.q, item.v, item.u):
                key.update(np.ascontiguousarray(values).tobytes())
    if rigid is not None:
        random = np.random.default_rng(0)
        motion = random.normal(size=(3, 4, len(source.q.columns)))
        key.update(rigid(*motion).round(9).tobytes())
    folder = Path(os.environ.get("PINN_DYN_CACHE", "~/.cache/pinn_dyn")).expanduser()
    return folder / f"check-{key.hexdigest()[:16]}.json"


_ROWS = 50  # of a table in the terminal
_HEADS = {  # of options, in Python
    "model/input=servo": "input=pinn_dyn.models.Servo",
    "model/integrator=rosenbrock": "integrator=pinn_dyn.mechanics.Rosenbrock()",
    "model/friction=coulomb": "friction=pinn_dyn.models.CoulombFriction",
}
_RANK = {"stop": 0, "warning": 1, "ok": 2}
_FORCES = (
    "The equation of motion is fitted to all runs. The residual is the part of an input that the "
    "motion does not explain: friction that depends on the load, contacts, or a fault of the log."
)
_RESIDUALS, _DELAYS = "residuals", "delays"  # names of places in the page
_OF_STATES = (
    "The residual of each force over position and speed of its joint, in all runs: of rigid bodies "
    "with a URDF, else of a generic equation, which has a linear spring at each joint. A curve "
    "over q shows a hose, a stop or wrong kinematics, and with a URDF also a spring. The residual "
    "over v includes the dry friction, whose curve is visible there."
)
_INPUTS = (
    "The curve shows the share of the equation of motion that stays unexplained if an input is "
    "shifted by a delay. The delay is at its minimum. The column ± is half its 95 % interval. "
    "Dry friction is a share of the standard deviation of the input."
)


@dataclass(frozen=True)
class LogCheck:
    """Measurements of a log, and the numbers behind them.

    Attributes:
        source: the log.
        measurements: the measurements, each with its verdict.
        runs, coordinates, inputs: tables of stretches, coordinates and inputs.
        delays: delay curve of each input.
        steps: entries for ``steps`` of the data set in YAML: a filter, if needed.
        delay: ``delay`` of the data set, s, if the measured one calls for a change; None otherwise.
        hold: the inputs are held between samples, where the data set draws lines.
        candidates: models of a training, each with the reason and its options.
        driven: number of the joint that each input drives, of fewer inputs than coordinates.
        rigid: excitation of the base parameters of a rigid robot; None without a structure.
        motion: equation of motion; None if there are too few rows for an equation.
    """

    source: logs.LogSource
    measurements: list[Measurement]
    runs: pd.DataFrame
    coordinates: pd.DataFrame
    inputs: pd.DataFrame
    delays: list[DelayCurve]
    steps: list[str]
    delay: float | list[float] | None
    candidates: list[tuple[str, list[str]]]
    hold: bool = False
    driven: Sequence[int] = ()
    rigid: RigidExcitation | None = None
    motion: Equation | None = None

    @property
    def problems(self) -> list[str]:
        """Reasons why a training makes no sense."""
        return [x.text for x in self.measurements if x.verdict == "stop"]

    @property
    def advice(self) -> list[str]:
        """Models of a training with their reasons and options, one in a line."""
        return [f"A training, as {why}: {_options(x)}" for why, x in self.candidates]

    @property
    def warnings(self) -> list[str]:
        """Texts of the warnings."""
        return [x.text for x in self.measurements if x.verdict == "warning"]

    @property
    def block(self) -> str:
        """Entries to append to the data set, "" if there are none."""
        lines = [f"  {line}" for line in self.steps]
        if self.steps and not self.source.steps:
            lines = [wording.steps(self.steps)]
        lines += [] if self.delay is None else [wording.line("delay", self.delay, "s")]
        if self.hold:
            value = "hold" if wording.IN_YAML.get() else repr("hold")
            reason = "the inputs act half a sample late"
            lines.append(wording.line("interpolation", value, reason))
        return "\n".join(lines)

    def table(self) -> pd.DataFrame:
        """Return one row per measurement, stops and warnings first."""
        frame = pd.DataFrame(self.measurements).rename(
            columns={"name": "measurement", "place": "of", "text": "explanation", "section": "docs"}
        )
        frame.insert(0, "verdict", frame.pop("verdict"))
        return frame.sort_values("verdict", key=lambda x: x.map(_RANK), kind="stable")

    @property
    def verdict(self) -> str:
        """The verdict in one line."""
        count = len(self.findings())
        if self.problems:
            return f"a training makes no sense: {'; '.join(self.problems)}"
        notes = f"{count} warning{'s' * (count != 1)}" if count else "no warnings"
        return f"a training makes sense, {notes}"

    def findings(self) -> list[str]:
        """Return what is not ok, stops first. Equal quantities of several places are one text."""
        groups: dict[tuple[str, str], list[Measurement]] = {}
        bad = sorted(self.measurements, key=lambda x: _RANK[x.verdict])
        for item in (x for x in bad if x.verdict != "ok"):
            groups.setdefault((item.name, _cause(item.text)), []).append(item)
        texts = []
        for items in groups.values():
            first = items[0]
            more = ", ".join(x.place for x in items[1:] if x.place) or f"{len(items) - 1} more"
            also = f" The same: {more}." if len(items) > 1 else ""
            end = "" if first.text.endswith("?") else "."
            texts.append(f"{first.verdict}: {first.text}{end}{also} ({first.section})")
        return texts

    def __str__(self) -> str:
        lines = [f"{self.source.name}: {self.verdict}", *(f"\n{x}" for x in self.findings())]
        tables = {"Coordinates": self.coordinates, "Inputs": self.inputs}
        if self.rigid is not None:
            tables[f"Rigid bodies, not determined: {self.rigid.undetermined}"] = self.rigid.joints
        for title, frame in ((k, x) for k, x in tables.items() if len(x)):
            text = frame.to_string(
                index=False, na_rep="", float_format="{:.3g}".format, max_rows=_ROWS
            )
            lines += ["", title, text]
        ok = sum(x.verdict == "ok" for x in self.measurements)
        lines += ["", f"{ok} of {len(self.measurements)} measurements are ok; the page lists them."]
        if self.block:
            lines += ["", "Append to the data set:", "", self.block]
        # The command line prints whole commands.
        if self.rigid is None and not self.problems and not wording.IN_YAML.get():
            lines += ["", *self.advice]
        return "\n".join(lines)

    def save(self, folder: str | Path, command: str = "") -> Path:
        """Write ``check.html``, ``measurements.csv`` and ``log_report.md``; return the page."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "check.html", check_report(self, command=command))
        write_whole(folder / "measurements.csv", self.table().to_csv(index=False))
        write_whole(folder / "log_report.md", self.source.report)
        return folder / "check.html"


def _linked(text: str) -> Markup:
    """Return a finding as a link to the figure that shows it."""
    figure = _DELAYS if "after it is logged" in text else _RESIDUALS
    shown = any(word in text for word in ("residual", "unexplained", "after it is logged"))
    if not shown:
        return paragraph(text)
    return Markup('<p><a href="#{}">{}</a></p>').format(figure, text)


def _anchored(name: str, *content: Markup) -> Markup:
    return Markup('<div id="{}">{}</div>').format(name, Markup("").join(content))


def _options(options: Sequence[str]) -> str:
    """Return the options of a training, on the command line or in Python."""
    if wording.IN_YAML.get():
        return shlex.join(options)
    name = options[0].partition("=")[2]
    if name != "lnn":
        return wording.setting("model", name)
    heads = "".join(f", {_HEADS[option]}" for option in options[1:])
    return f"model=functools.partial(pinn_dyn.models.LagrangianNetwork{heads})"


def _cause(text: str) -> str:
    """Return the part of a text that names a cause, without names and numbers of its place."""
    return re.sub(r"[\d.]+|\S*[/\\']\S*", "", text.rpartition(": ")[2])


def check_report(check: LogCheck, *, command: str) -> str:
    """Return the HTML page of a check: verdict, forces, what is not ok, and the rest folded."""
    source = check.source
    verdict = [paragraph(f"{check.verdict[0].upper()}{check.verdict[1:]}.")]
    if check.motion is not None:
        text = "measured forces, the part that the equation of motion explains, and the residual"
        verdict += [paragraph(_FORCES), drawing(forces(check.motion, source.input_labels), text)]
    verdict += [_linked(text) for text in check.findings()]
    if check.block:
        text = "Entries that follow from the measured delay and noise, to append to the data set:"
        verdict += [paragraph(text), preformatted(check.block)]
    if check.rigid is None and not check.problems:
        verdict += [paragraph(text) for text in check.advice]
    cleaning = cleaning_figure(
        source.cleaned[0], title=source.name, labels=source.labels, input_labels=source.input_labels
    )
    measurements = check.table()[["verdict", "measurement", "of", "value", "expected", "docs"]]
    parts = []
    if check.motion is not None and (
        figure := residuals(check.motion, source.q, source.v, source.u)
    ):
        drawn = drawing(figure, "residual of each force over position and speed of its joint")
        parts.append(_anchored(_RESIDUALS, paragraph(_OF_STATES), drawn))
    if check.delays:
        curves = drawing(delay_curves(check.delays, check.inputs["input"]), "residual over delay")
        inputs = [paragraph(_INPUTS), table(check.inputs), curves]
        parts.append(_anchored(_DELAYS, *inputs))
    parts += [
        details("All measurements", table(measurements)),
        details("Clock of each run", table(check.runs)),
        details("Coordinates", table(check.coordinates)),
    ]
    if check.rigid is not None:
        text = (
            f"The regressor of {check.rigid.count} base parameters has the condition number "
            f"{check.rigid.condition:.3g}; below 100 a motion is well conditioned. "
            f"Not determined: {check.rigid.undetermined}."
        )
        parts.append(details("Rigid bodies", paragraph(text), table(check.rigid.joints)))
    drawn = drawing(cleaning, "raw and cleaned signals")
    parts.append(details("Cleaning", drawn, from_markdown(source.report)))
    sections = [Section("Verdict", verdict), Section("Measurements", parts)]
    return page(f"{source.name}: check of the log", command, sections)
