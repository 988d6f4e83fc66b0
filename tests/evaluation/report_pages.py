"""Small pages of both kinds for the tests, and what a page holds, read without a browser."""

from html.parser import HTMLParser

import pandas as pd
import torch

from pinn_dyn.control.contracts import Motion
from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.evaluation import (
    Prediction,
    RunResult,
    closed_loop_metrics,
    compare_terms,
    comparison_table,
    grouped_table,
    rollout_metrics,
    summary_table,
)
from pinn_dyn.evaluation.report import (
    Origin,
    StabilityResult,
    control_report,
    prediction_report,
)
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.systems import SoftArm

ODD = "<img src=x onerror=alert(1)></script> & 'co'"
LABELS = ["Δx [rad]", "Δy [rad]", "δℓ [m]"]
INPUTS = ["τx [Nm]", "τy [Nm]", "f [N]"]


class Page(HTMLParser):
    """The tags of a page with their attributes, its tables, and its text outside scripts."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.tables, self.words = [], [], []
        self.quiet = self.cell = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.tags.append((tag, attributes))
        if tag in ("script", "style"):
            self.quiet = tag
        elif tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.cell = ["", attributes.get("title")]
            self.tables[-1][-1].append(self.cell)

    def handle_endtag(self, tag):
        if tag == self.quiet:
            self.quiet = None
        elif tag in ("td", "th"):
            self.cell = None

    def handle_data(self, data):
        if self.quiet is None:
            self.words.append(data)
            if self.cell is not None:
                self.cell[0] += data

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    def table(self, heading):
        """The first table that has this heading: rows as dicts of (text, all digits)."""
        for first, *rows in self.tables:
            names = [text for text, _ in first]
            if heading in names:
                return [dict(zip(names, row, strict=True)) for row in rows]
        raise AssertionError(f"no table has the heading {heading}")


def origin(runs=("hnn", "lnn")):
    rows = pd.DataFrame({"run": list(runs), "seed": range(len(runs)), "folder": "runs/x"})
    return Origin({"command": "python evaluate.py", "commit": "abc1234"}, rows, {"Config": "a: 1"})


def truth(count=5):
    t = torch.linspace(0, 2, 201, dtype=torch.float64)
    phase = torch.arange(count, dtype=torch.float64)[:, None]
    q = torch.stack([torch.sin(t + phase), torch.cos(2 * t + phase), 0.3 + 0.1 * t + 0 * phase], -1)
    return Trajectory(q, torch.zeros_like(q), Signal(t, torch.cos(3 * q), "hold"))


def predictions(real, names=("hnn", "lnn")):
    """Of each name another error, which the second name loses on trajectory 1."""
    found = {}
    for k, name in enumerate(names):
        q_hat = real.q + 0.01 * (k + 1) * real.t[:, None]
        if k == 1:
            q_hat[1, 100:] = torch.nan
        found[name] = Prediction(real.t[::2], q_hat[:, ::2], real.q[:, ::2])
    return found


def summary_of(found, floors=()):
    return summary_table(
        [
            RunResult(
                name,
                name,
                0,
                rollout_metrics(item.q_hat, item.q, item.t, thresholds={"small": 0.01}).to_dict(),
                {"pairs": 8000},
                floor=name in floors,
            )
            for name, item in found.items()
        ]
    )


def comparisons_of(names):
    arm, heavier = SoftArm(segments=1).double(), SoftArm(segments=1, mass=0.36).double()
    q = torch.tensor([[0.8, 0.2, 0.3], [1.2, -0.2, 0.15]], dtype=torch.float64)
    return {name: compare_terms(heavier, arm, q, names=["bent", "more"]) for name in names}


def prediction_page(names=("hnn", "lnn"), floors=(), **changes):
    """The page, without figures of the terms, and the summary that it was made of."""
    real = truth()
    found = predictions(real, (*names, *floors))
    summary = summary_of(found, floors)
    arguments = {
        "title": "an arm",
        "trajectories": f"{real.q.shape[0]} unseen test trajectories",
        "summary": summary,
        "grouped": grouped_table(summary),
        "notes": [],
        "truth": real,
        "predictions": found,
        "trajectory": 0,
        "labels": LABELS,
        "input_labels": INPUTS,
        "comparisons": {},
        "joints": pd.DataFrame(),
        "constants": {},
        "parts": pd.DataFrame(),
        "intervals": {},
        "origin": origin(names),
    }
    return prediction_report(**arguments | changes), summary


def records(names=("learned", "pd"), runs=4):
    """Each law and run settles at another speed; the second law is stopped in run 2."""
    t = torch.linspace(0, 2, 101, dtype=torch.float64)
    found = {}
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
        found[name] = ClosedLoopRecord(t, q, zero, u, u, Motion(q_ref, zero, zero), stopped)
    return found


def control_page(names=("learned", "pd"), **changes):
    """The page, and the summary that it was made of."""
    found = records(names)
    metrics = {name: closed_loop_metrics(r, settled_after=1.0) for name, r in found.items()}
    first = next(iter(metrics.values()))
    points = pd.DataFrame(
        {
            "bound": [1e-3, 2e-3, 3e-3, float("inf")],
            "holds": [True, True, True, False],
            "measured_error": [5e-4, 1e-3, 4e-3, 1e-3],
        }
    )
    summary = comparison_table(metrics)
    arguments = {
        "title": "a loop",
        "summary": summary,
        "coordinates": first.per_coordinate(),
        "inputs": first.per_input(),
        "records": found,
        "run": 0,
        "held": True,
        "labels": LABELS,
        "input_labels": INPUTS,
        "animation": None,
        "stability": StabilityResult("# Stability\n\n| a | b |\n|---|---|\n| A_L | 2 |\n", points),
        "origin": origin(names),
    }
    return control_report(**arguments | changes), summary
