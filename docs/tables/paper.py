"""Tables of docs/reproduction.md: the paper's figures beside those of results/reproduction.yaml."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import yaml

from docs.tables.floors import FILE, GROUND
from docs.tables.text import bold, commands, number, table
from reproduce import ENTRIES, ROOT, SUMMARY, Entry, read_entries, recorded, training_seconds

_PREDICTED = ("soft_arm_1_wide", "soft_arm_1", "soft_arm_2", "panda")
# Columns of the table of generalization: evaluations of the models of the wide range.
_WIDE = ROOT / "results" / "soft_arm_1_wide"
_ELSEWHERE = {
    "in range": "summary.csv",
    "beyond, 1.3 times": "beyond/summary.csv",
    "steps of 5 ms": "steps/summary.csv",
    "trained on 500 pairs": "few_pairs/summary.csv",
}
# Data set and task, and the folder of their evaluations, with those beyond the range in it.
_BEYOND = {
    ("soft_arm_2", "two-segment soft arm at 100 Hz, 10 s"): "soft_arm_2/100hz_wide",
    ("panda", "Panda in PyBullet, 2 s"): "panda",
}
_PAYLOAD = ROOT / "results" / "panda" / "payload"
_GEOMETRY_KNOWN = "known_system"
"""Knows the arm, so that it says nothing of networks elsewhere."""
FIGURE = ROOT / "docs" / "figures" / "sample_efficiency.png"


def tables() -> dict[str, str]:
    """Every table of the page, by the name of its place."""
    return {
        **{name: prediction_table(name) for name in _PREDICTED},
        **{f"{name}_commands": train_commands(name) for name in _PREDICTED},
        "generalization": generalization_table(),
        "beyond": beyond_table(),
        "payload": payload_table(),
        "hardware": hardware_table(),
        "control": control_table(),
        "terms": terms_table(),
        "sample_efficiency": sample_efficiency_table(),
        "hardware_used": "\n" + yaml.safe_load(ENTRIES.read_text())["hardware"] + ".\n",
    }


def entries_of(group: str) -> dict[str, Entry]:
    """The entries of one table, by the rest of their names."""
    return {
        name.removeprefix(f"{group}/"): entry
        for name, entry in read_entries().items()
        if name.startswith(f"{group}/")
    }


def floors_of(dataset: str, *, ground: bool = False) -> pd.DataFrame:
    """Errors of the floors on a data set, or of the true equation, a row for each."""
    data = pd.read_csv(FILE)
    return data[(data["dataset"] == dataset) & ((data["model"] == GROUND) == ground)].set_index(
        "model"
    )


def best_floor(dataset: str) -> tuple[str, float]:
    """The floor of the smallest mean error over the whole horizon that loses no roll-out."""
    floors = floors_of(dataset)
    errors = floors["error_mean"][floors["diverged"] == 0]
    return str(errors.idxmin()), float(errors.min())


def prediction_table(group: str) -> str:
    """Prediction errors, a row for each entry: means over the seeds, floors below.

    Bold is what is ahead of the paper and of every floor, and loses no roll-out.
    """
    entries = {name: (entry, recorded(entry)) for name, entry in entries_of(group).items()}
    head = ["model", "paper", "ours: mean norm ± std", "squared norm of (q, v), mean ± variance"]
    head += ["each seed", "pairs (paper)", "training, s"]
    rows, (_, lowest) = [], best_floor(group)
    for name, (entry, data) in entries.items():
        mean = data.mean(numeric_only=True)
        paper = float(entry["paper"].split()[0]) if "paper" in entry else float("inf")
        ahead = mean["error_mean"] < min(lowest, paper) and not lost(data)
        square, variance, of = squared_norm(data)
        took = training_seconds(data)
        pairs = f" ({entry['pairs']:,})" if "pairs" in entry else ""
        rows.append(
            [
                name,
                entry.get("paper", "–"),
                f"{bold(number(mean['error_mean']), ahead)} ± {number(mean['error_std'])}"
                f"{lost(data)}",
                f"{square:.1e} ± {variance:.1e}{of}",
                " / ".join(number(value) for value in data.sort_values("seed")["error_mean"]),
                f"{int(data['pairs'].iloc[0]) * entry.get('steps', 1):,}{pairs}",
                f"{took.min():.0f}" + (f"–{took.max():.0f}" if len(took) > 1 else ""),
            ]
        )
    for floor, row in floors_of(group).iterrows():
        error = f"{number(row['error_mean'])} ± {number(row['error_std'])}{lost(row.to_frame().T)}"
        rows.append([str(floor), "–", error, *["–"] * (len(head) - 3)])
    return table(head, rows)


def squared_norm(data: pd.DataFrame) -> tuple[float, float, str]:
    """Mean and variance of the squared norm, of (q, v), or, said in words, of q alone."""
    whole = "state_squared_error_mean" in data and data["state_squared_error_mean"].notna().all()
    name = "state_squared_error" if whole else "squared_error"
    mean, variance = (data[f"{name}_{figure}"].mean() for figure in ("mean", "variance"))
    return mean, variance, "" if whole else " of q"


def generalization_table() -> str:
    """The models of the wide range where they were not trained: means over the seeds."""
    tables = {head: pd.read_csv(_WIDE / file) for head, file in _ELSEWHERE.items()}
    tables = {head: data[data["model"] != _GEOMETRY_KNOWN] for head, data in tables.items()}
    beyond = tables["beyond, 1.3 times"]
    rows = []
    for model in tables["in range"]["model"].unique():
        cells = [_mean_and_median(data, model) for data in tables.values()]
        rows.append(
            [_label(tables["in range"], model), *cells[:2], _left(beyond, model), *cells[2:]]
        )
    truth = [_truth(name) for name in ("soft_arm_1_wide", "soft_arm_1_wide_beyond")]
    rows.append(["true equation", *truth, *["–"] * (len(tables) - 1)])
    head = [f"{name}: mean, median" for name in tables]
    return table(["model", *head[:2], "left the data beyond", *head[2:]], rows)


def beyond_table() -> str:
    """The other simulated robots within their range and beyond it."""
    rows = []
    for (dataset, task), folder in _BEYOND.items():
        files = [ROOT / "results" / folder / rest for rest in (SUMMARY, f"beyond/{SUMMARY}")]
        inside, beyond = (pd.read_csv(path) for path in files)
        # Without models that were not tested beyond.
        inside = inside.merge(beyond[["model", "pairs"]].drop_duplicates())
        for index, model in enumerate(beyond["model"].unique()):
            cells = [_mean_and_median(data, model) for data in (inside, beyond)]
            label = _label(beyond, model)
            rows.append(["" if index else task, label, *cells, _left(beyond, model)])
        truth = (_truth(name) for name in (dataset, f"{dataset}_beyond"))
        rows.append(["", "true equation", *truth, "–"])
    head = [f"{name}: mean, median" for name in list(_ELSEWHERE)[:2]]
    return table(["task", "model", *head, "left the data beyond"], rows)


def payload_table() -> str:
    """The Panda with a load, before its models have seen it and after 2 s of motion with it."""
    before, after = (pd.read_csv(_PAYLOAD / when / SUMMARY) for when in ("before", "after"))
    rows = []
    for model, run in after.set_index("model").iterrows():
        torque = [data.set_index("model")["torque_share"][model] for data in (before, after)]
        took = "–" if run["floor"] else f"{run['training_seconds']:.0f}"
        rows.append(
            [
                _label(after, model),
                _mean_and_median(before, model),
                _mean_and_median(after, model),
                number(run["window_0.5s_error_mean"]),
                "–" if pd.isna(torque).any() else " → ".join(number(value) for value in torque),
                took,
            ]
        )
    head = ["model", "before: mean, median", "after 2 s of motion: mean, median", "over 0.5 s"]
    head += ["torque error, share", "fit, s"]
    return table(head, rows)


def _label(data: pd.DataFrame, model: str) -> str:
    return model if data.set_index("model")["floor"][[model]].iloc[0] else f"`{model}`"


def _mean_and_median(data: pd.DataFrame, model: str) -> str:
    """Errors of a model, bold where they are the smallest of those that lose no roll-out."""
    runs = data[data["model"] == model]
    if runs.empty:
        return "–"
    whole = data[data.groupby("model")["diverged"].transform("sum") == 0]
    figures = []
    for column in ("error_mean", "error_median"):
        lowest = whole.groupby("model")[column].mean().idxmin()
        best = lowest == model and not runs["floor"].any()
        figures.append(bold(number(runs[column].mean()), best))
    return f"{', '.join(figures)}{lost(runs)}"


def _left(data: pd.DataFrame, model: str) -> str:
    """How many predictions left the range of the training data, and when the first did."""
    runs = data[data["model"] == model]
    if not (left := int(runs["left_data"].sum())):
        return "none"
    return f"{left} of {int(runs['trajectories'].sum())}, {runs['left_data_after'].min():.1f} s"


def _truth(dataset: str) -> str:
    """Errors of the true equation in the same steps."""
    row = floors_of(dataset, ground=True)
    figures = (f"{row[column].iloc[0]:.1e}" for column in ("error_mean", "error_median"))
    return f"{', '.join(figures)}{lost(row)}"


def lost(data: pd.DataFrame) -> str:
    """How many roll-outs diverged, if any did."""
    diverged = int(data["diverged"].sum())
    return f", {diverged} of {int(data['trajectories'].sum())} diverged" if diverged else ""


def train_commands(group: str) -> str:
    """What trains the rows of a table, in their order."""
    entries, lines = read_entries(), []
    for entry in entries_of(group).values():
        command = " ".join(["python train.py -m", *entry["train"]])
        # Of each earlier run one: it goes on with the same seed.
        runs = [(k, entries[name]) for name in entry.get("runs", ()) for k in _seeds(entries[name])]
        lines += [
            f"{command} seed={k} "
            f"'start_from=runs/sweep/<date>/{k}_{earlier['select']['model']}-seed{k}'"
            for k, earlier in runs
        ] or [command]
    return commands(lines)


def _seeds(entry: Entry) -> list[str]:
    words = dict(word.split("=", 1) for word in entry["train"])
    return words["seed"].split(",")


def hardware_table() -> str:
    """What the paper measured on robots whose logs are not published."""
    rows = [
        [name, entry["paper"], f"{entry['pairs']:,}", entry["missing"]]
        for name, entry in entries_of("hardware").items()
    ]
    return table(["log, model", "paper", "pairs (paper)", "with such a log"], rows)


def control_table() -> str:
    """Closed loops: the law on learned terms, the same law on the truth, PD alone."""
    rows = []
    for name, entry in entries_of("control").items():
        found = []
        for law in ("learned", "truth", "pd"):
            data = recorded({**entry, "select": {"controller": law}})[entry["metric"]]
            found.append(f"{data.mean():.2g} {entry['unit']}")
        seeds = str(len(recorded(entry)))
        rows.append([f"`{name}`", entry["paper"], f"**{found[0]}**", *found[1:], seeds])
        rows[-1].append(f"`{' '.join(entry['control'])}`")
    head = ["task", "paper", "ours, on learned terms", "on the truth", "PD alone", "seeds"]
    return table([*head, "`control.py`"], rows)


def terms_table() -> str:
    """Relative errors of the learned terms, mean over the seeds, beside the paper's."""
    rows = []
    for model, entry in yaml.safe_load(ENTRIES.read_text())["terms"].items():
        data = pd.concat([pd.read_csv(path) for path in sorted(ROOT.glob(entry["results"]))])
        means = data.groupby(["configuration", "term"])[entry["column"]].mean()
        for configuration, printed in entry["paper"].items():
            cells = [
                f"{100 * means[configuration, term]:.1f} ({theirs:.1f})"
                for term, theirs in zip(entry["terms"], printed, strict=True)
            ]
            inverse = entry["terms"][0] == "M_inverse"
            cells = ["", cells[0], *cells[1:]] if inverse else [cells[0], "", *cells[1:]]
            rows.append([f"`{model}`", f"`{configuration}`", *cells])
    return table(["model", "configuration", "M", "M⁻¹", "D", "G", "A"], rows)


def sample_efficiency() -> pd.DataFrame:
    return recorded(read_entries()["study/sample_efficiency"])


def sample_efficiency_table() -> str:
    """Errors against pairs: mean ± standard deviation, and the worst trajectory.

    Floors, which take all of the training data, are below.
    """
    data, floors = sample_efficiency(), floors_of("soft_arm_1")
    sizes = sorted(data["pairs"].unique())
    lowest = data.groupby("pairs")["error_mean"].min().clip(upper=floors["error_mean"].min())
    rows = []
    for model, runs in data.groupby("model", sort=False):
        by_size = runs.set_index("pairs")
        took = training_seconds(runs)
        cells = [
            _errors(by_size.loc[size], lowest[size]) if size in by_size.index else "–"
            for size in sizes
        ]
        rows.append([f"`{model}`", *cells, f"{took.min():.0f}–{took.max():.0f}"])
    for floor, row in floors.iterrows():
        rows.append([str(floor), *["–"] * (len(sizes) - 1), _errors(row), "–"])
    return table(["model", *(f"{size:,} pairs" for size in sizes), "training, s"], rows)


def _errors(row: pd.Series, lowest: float | None = None) -> str:
    mean, std, worst = (number(row[f"error_{name}"]) for name in ("mean", "std", "worst"))
    return f"{bold(mean, row['error_mean'] == lowest)} ± {std}, {worst}"


def draw(path: Path) -> None:
    """The error against the pairs, a line for each model."""
    from pinn_dyn.evaluation import save, sweep_figure

    names = {"pairs": "training pairs", "error_mean": "mean error over 5 s, unseen trajectories"}
    runs = sample_efficiency().rename(columns=names)
    figure = sweep_figure(runs, x=names["pairs"], lines=["model"], y=names["error_mean"])
    (ax,) = figure.axes
    title = "one-segment soft arm, 4,000 training steps each, seed 0"
    ax.set_title(title, loc="right", fontsize="small")  # in the place of the other one
    ax.set_yscale("log")
    save(figure, path)
