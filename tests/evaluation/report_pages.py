"""Small pages of an evaluation and of a control run for the tests, and a parser of pages."""

from html.parser import HTMLParser

import pandas as pd
import torch

from pinn_dyn.control.closed_loop import ClosedLoopRecord
from pinn_dyn.control.contracts import Motion
from pinn_dyn.data import Splits
from pinn_dyn.evaluation import (
    ControlResult,
    Entry,
    closed_loop_figure,
    closed_loop_metrics,
    controller_comparison_figure,
    evaluate_models,
)
from pinn_dyn.evaluation.baselines import HoldPosition
from pinn_dyn.evaluation.report.control_page import control_report
from pinn_dyn.evaluation.report.page import Origin
from pinn_dyn.mechanics import Predictor, Signal, Trajectory
from pinn_dyn.progress import Progress

ODD = "<img src=x onerror=alert(1)></script> & 'co'"
LABELS = ["Δx [rad]", "Δy [rad]", "δℓ [m]"]
INPUTS = ["τx [Nm]", "τy [Nm]", "f [N]"]


class Page(HTMLParser):
    """The tags of a page with their attributes, its tables, and its text outside scripts."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.tables, self.words = [], [], []
        self.quiet, self.cell = None, False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag in ("script", "style"):
            self.quiet = tag
        elif tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.cell = True
            self.tables[-1][-1].append("")

    def handle_endtag(self, tag):
        if tag == self.quiet:
            self.quiet = None
        elif tag in ("td", "th"):
            self.cell = False

    def handle_data(self, data):
        if self.quiet is None:
            self.words.append(data)
            if self.cell:
                self.tables[-1][-1][-1] += data

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    def table(self, heading):
        """Return the first table with this heading: rows as dicts of texts."""
        for names, *rows in self.tables:
            if heading in names:
                return [dict(zip(names, row, strict=True)) for row in rows]
        raise AssertionError(f"no table has the heading {heading}")


class Source:
    """A data set with names only."""

    name, labels, input_labels = "an arm", LABELS, INPUTS
    system, configurations = None, {}


class Replay(Predictor):
    """The truth with an error of ``rate`` t; the second trajectory breaks down if told so."""

    def __init__(self, truth, rate, broken=False):
        super().__init__(3, 3)
        self.truth, self.rate, self.broken = truth, rate, broken

    def increments(self, x0, t, input):
        if len(t) < len(self.truth.t):  # a window
            return (self.rate * t[:, None]).expand(*x0.shape[:-1], len(t), 6)
        q = self.truth.q - self.truth.q[:, :1] + self.rate * t[:, None]
        if self.broken:
            q[1, 100:] = torch.nan
        return torch.cat([q, torch.zeros_like(q)], dim=-1)


def truth(count=5):
    t = torch.linspace(0, 2, 201, dtype=torch.float64)
    phase = torch.arange(count, dtype=torch.float64)[:, None]
    q = torch.stack([torch.sin(t + phase), torch.cos(2 * t + phase), 0.3 + 0.1 * t + 0 * phase], -1)
    return Trajectory(q, torch.zeros_like(q), Signal(t, torch.cos(3 * q), "hold"))


def origin(runs):
    rows = pd.DataFrame({"run": list(runs), "seed": range(len(runs)), "folder": "runs/x"})
    return Origin({"command": "python evaluate.py", "commit": "abc1234"}, rows, {"Config": "a: 1"})


def evaluation(names=("hnn", "lnn"), source=Source):
    """Evaluate models whose errors are known; the second breaks down on trajectory 1."""
    real = truth()
    data = Splits(
        *(
            [Trajectory(real.q[k], real.v[k], Signal(real.t, real.u[k])) for k in range(5)]
            for _ in range(3)
        )
    )
    entries = [
        Entry(name, Replay(real, 0.01 * (k + 1), broken=k == 1), data, 0.01, name, seed=0)
        for k, name in enumerate(names)
    ]
    baselines = [Entry("hold position", HoldPosition(3, 3), data, 0.01, "hold position")]
    item = evaluate_models(
        entries,
        baselines,
        source,
        real,
        split="test",
        stride=1,
        windows=[0.5],
        thresholds={"large": 0.1},
        progress=Progress(None, 0, "models"),
    )
    item.origin = origin(names)
    return item


def prediction_page(names=("hnn", "lnn"), source=Source, **changes):
    """Return the page, and the evaluation that it was made of."""
    item = evaluation(names, source)
    for name, value in changes.items():
        setattr(item, name, value)
    return item.page(dict(item.figures())), item


def records(names=("learned", "pd"), runs=4):
    """Each law and run settles at another speed; the second law is stopped in run 2."""
    t = torch.linspace(0, 2, 101, dtype=torch.float64)
    laws = {}
    for k, name in enumerate(names):
        goal = torch.tensor([0.5, -0.5, 0.8]) + torch.arange(runs)[:, None, None] / 10
        q_ref = goal.double().expand(runs, len(t), 3)
        speed = 4.0 - k + torch.arange(runs)[:, None, None]
        q = q_ref * (1 - torch.exp(-speed * t[:, None]))
        u = q_ref * torch.cos(t)[:, None]
        stopped = [None] * runs
        if k == 1:
            q, u = q.clone(), u.clone()
            q[2, 60:], u[2, 60:] = torch.nan, torch.nan
            stopped[2] = "1.20 s: A is singular"
        zero = torch.zeros_like(q)
        laws[name] = ClosedLoopRecord(t, q, zero, u, u, Motion(q_ref, zero, zero), stopped)
    return laws


def control_page(names=("learned", "pd"), title="a loop", animation=None):
    """Return the page, and the summary that it was made of."""
    laws = records(names)
    metrics = {name: closed_loop_metrics(item, settled_after=1.0) for name, item in laws.items()}
    result = ControlResult(laws, metrics)
    page = control_report(
        title=title,
        result=result,
        figures={
            "comparison": controller_comparison_figure(laws, title=title),
            "closed_loop": closed_loop_figure(laws, 2, title=title, labels=LABELS),
        },
        labels=LABELS,
        animation=animation,
        origin=origin(names),
    )
    return page, result.table
