"""The tables and the figure of docs/reproduction.md, made of results/.

    python docs/reproduction_tables.py     writes them into the page, after results/ has changed

What a row is, and which files its figures come from, is in results/reproduction.yaml.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pandas as pd
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # for reproduce.py, whatever folder this is called from

from reproduce import ENTRIES, Entry, read_entries, recorded, training_seconds  # noqa: E402

PAGE = ROOT / "docs" / "reproduction.md"
FIGURE = ROOT / "docs" / "figures" / "sample_efficiency.png"
PLACE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def filled(page: str) -> str:
    """The page with every table made anew."""
    tables = {
        "soft_arm_1": prediction_table("soft_arm_1"),
        "soft_arm_2": prediction_table("soft_arm_2"),
        "panda": prediction_table("panda"),
        "hardware": hardware_table(),
        "control": control_table(),
        "terms": terms_table(),
        "sample_efficiency": sample_efficiency_table(),
        "hardware_used": "\n" + yaml.safe_load(ENTRIES.read_text())["hardware"] + ".\n",
    }
    if missing := tables.keys() - {match[2] for match in PLACE.finditer(page)}:
        raise ValueError(f"the page has no place for the tables {', '.join(sorted(missing))}")
    return PLACE.sub(lambda match: f"{match[1]}{tables[match[2]]}\n{match[3]}", page)


def entries_of(table: str) -> dict[str, Entry]:
    """The entries of one table, by the rest of their names."""
    return {
        name.removeprefix(f"{table}/"): entry
        for name, entry in read_entries().items()
        if name.startswith(f"{table}/")
    }


def markdown(head: list[str], rows: list[list[str]]) -> str:
    """A table, with the empty lines that Markdown wants around it."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def prediction_table(table: str) -> str:
    """Prediction errors, a row for each entry: means over the seeds."""
    head = ["model", "paper", "ours: mean norm ± std", "squared norm, mean ± variance"]
    head += ["each seed", "pairs (paper)", "training, s", "command"]
    rows = []
    for name, entry in entries_of(table).items():
        data = recorded(entry)
        paper = [entry.get("paper", "–"), f"`{command(entry)}`"]
        pairs = f" ({entry['pairs']:,})" if "pairs" in entry else ""
        if data.empty:
            rows.append([name, paper[0], "not run", "", "", pairs.strip(), "", paper[1]])
            continue
        mean = data.mean(numeric_only=True)
        diverged = int(data["diverged"].sum())
        lost = f", {diverged} of {int(data['trajectories'].sum())} diverged" if diverged else ""
        took = training_seconds(data)
        rows.append(
            [
                name,
                paper[0],
                f"**{number(mean['error_mean'])}** ± {number(mean['error_std'])}{lost}",
                f"{mean['squared_error_mean']:.1e} ± {mean['squared_error_variance']:.1e}",
                " / ".join(number(value) for value in data.sort_values("seed")["error_mean"]),
                f"{data['pairs'].iloc[0]:,}{pairs}",
                f"{took.min():.0f}" + (f"–{took.max():.0f}" if len(took) > 1 else ""),
                paper[1],
            ]
        )
    return markdown(head, rows)


def number(value: float) -> str:
    """Two digits, as many as the seeds agree in at best."""
    return f"{value:.{max(0, 1 - _exponent(value))}f}"


def _exponent(value: float) -> int:
    return int(f"{value:e}".split("e")[1])


def command(entry: Entry) -> str:
    return " ".join(["python train.py -m", *entry["train"]])


def hardware_table() -> str:
    """What the paper measured on robots whose logs are not published."""
    rows = [
        [name, entry["paper"], f"{entry['pairs']:,}", entry["missing"]]
        for name, entry in entries_of("hardware").items()
    ]
    return markdown(["log, model", "paper", "pairs (paper)", "with such a log"], rows)


def control_table() -> str:
    """Closed loops: the law on learned terms, the same law on the truth, PD alone."""
    rows = []
    for name, entry in entries_of("control").items():
        found = []
        for law in ("learned", "truth", "pd"):
            data = recorded({**entry, "select": {"controller": law}})[entry["metric"]]
            found.append(f"{data.mean():.2g} {entry['unit']}")
        seeds = str(len(recorded(entry)))
        rows.append([name, entry["paper"], f"**{found[0]}**", *found[1:], seeds])
        rows[-1].append(f"`python control.py {' '.join(entry['control'])} run=...`")
    head = ["task", "paper", "ours, on learned terms", "on the truth", "PD alone", "seeds"]
    return markdown([*head, "command"], rows)


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
    return markdown(["model", "configuration", "M", "M⁻¹", "D", "G", "A"], rows)


def sample_efficiency() -> pd.DataFrame:
    return recorded(read_entries()["study/sample_efficiency"])


def sample_efficiency_table() -> str:
    """Errors against pairs: mean ± standard deviation, and the worst trajectory."""
    data = sample_efficiency()
    sizes = sorted(data["pairs"].unique())
    rows = []
    for model, runs in data.groupby("model", sort=False):
        by_size = runs.set_index("pairs")
        took = training_seconds(runs)
        cells = [_errors(by_size.loc[size]) if size in by_size.index else "–" for size in sizes]
        rows.append([f"`{model}`", *cells, f"{took.min():.0f}–{took.max():.0f}"])
    return markdown(["model", *(f"{size:,} pairs" for size in sizes), "training, s"], rows)


def _errors(row: pd.Series) -> str:
    mean, std, worst = (number(row[f"error_{name}"]) for name in ("mean", "std", "worst"))
    return f"**{mean}** ± {std}, {worst}"


def draw(path: Path) -> None:
    """The error against the pairs, a line for each model."""
    from pinn_dyn.evaluation import save
    from pinn_dyn.evaluation.sweep_figures import sweep_figure

    names = {"pairs": "training pairs", "error_mean": "mean error over 5 s, unseen trajectories"}
    runs = sample_efficiency().rename(columns=names)
    figure = sweep_figure(runs, x=names["pairs"], lines=["model"], y=names["error_mean"])
    (ax,) = figure.axes
    title = "one-segment soft arm, 4,000 training steps each, seed 0"
    ax.set_title(title, loc="right", fontsize="small")  # in the place of the other one
    ax.set_yscale("log")
    save(figure, path)


if __name__ == "__main__":
    PAGE.write_text(filled(PAGE.read_text()))
    draw(FIGURE)
    print(f"wrote {PAGE} and {FIGURE}")
