"""Write the tables of the README and the documentation from results/results.csv.

    python -m docs.tables

A table stands in its page between ``<!-- table: name -->`` and ``<!-- end -->``.
"""

import re
from collections.abc import Sequence
from functools import partial

import pandas as pd
import yaml

from reproduce import ENTRIES, RESULTS, ROOT, recorded

BASELINES = ["hold position", "constant velocity", "ARX", "EDMDc"]
MODELS = ["identification", "known", "known_and_network", "lnn", "lnn_residual"]
MODELS += ["oscillators", "acceleration", "mlp", "subnet", *BASELINES]
LOGS = ["double_pendulum", "ur10e", "panda_gaz", "emps", "soft_neck", "trunk"]
CONTROL = {  # table: robot, metric, factor, tasks
    "regulation": ["soft_arm_2", "step_error_after_1_s_mean_percent", 1, "regulation"],
    "tracking": ["panda", "rms_error", 1000, "tracking", "helix", "tracking_heavier"],
}
CONTROL["regulation"] += ["regulation_heavier", "regulation_paper_gains"]
CONTROL["tracking"] += ["helix_heavier", "tracking_payload"]
SHORT, LONG = "window_0.1s_error_mean", "window_1s_error_mean"
PAPER = yaml.safe_load(ENTRIES.read_text(encoding="utf-8"))


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with the empty lines that Markdown wants around it."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def number(value: float, best: bool = False, digits: int = 2) -> str:
    """Return a number with its significant digits (0.0018, 0.80, 45), in bold if it is the best."""
    if pd.isna(value) or value == float("inf"):
        return "–"
    exponent = int(f"{value:e}".split("e")[1])
    text = f"{value:.{max(0, digits - 1 - exponent)}f}"
    return f"**{text}**" if best else text


def task(robot: str, prefix: str = "") -> pd.DataFrame:
    """Return the runs on a robot or on a variant such as "panda, beyond": index (model, seed)."""
    data = pd.read_csv(RESULTS).query("robot == @robot").fillna({"seed": 0})
    return data.pivot_table("value", ["model", "seed"], "metric").add_prefix(prefix)


def diverged(runs: pd.DataFrame, metric: str = "error_mean") -> str:
    """Return the number of diverged rollouts behind an error, or nothing."""
    prefix = metric.partition("error")[0]
    count = runs.get(f"{prefix}diverged", pd.Series([0.0])).sum()
    total = runs.get(f"{prefix}trajectories", runs.get("trajectories"))
    return f" ({count:.0f} of {total.sum():.0f} diverged)" if count else ""


def grid(data: pd.DataFrame, columns: Sequence[str], digits: int = 2, mark=MODELS) -> list:
    """Return one row per model: means over the seeds, the best of ``mark`` in bold."""
    order = {name: i for i, name in enumerate(MODELS)}
    rows, best, means = [], {}, data.reindex(columns=columns).groupby("model").mean()
    for c in columns:
        safe = [name for name in means.index if name in mark and not diverged(data.loc[[name]], c)]
        best[c] = means.loc[safe, c].min()
    for name in sorted(means.index, key=lambda name: (name in BASELINES, order.get(name, 4), name)):
        cells = [number(means.loc[name, c], means.loc[name, c] == best[c], digits) for c in columns]
        cells = [x + diverged(data.loc[[name]], c) for x, c in zip(cells, columns, strict=True)]
        rows.append([name if " " in name or name in BASELINES else f"`{name}`", *cells])
    return rows


def best_baseline(robot: str) -> tuple[str, float]:
    """Return the baseline with the smallest error among those without diverged rollouts."""
    errors = task(robot).query("model in @BASELINES and diverged == 0")["error_mean"]
    return errors.idxmin()[0], errors.min()


def prediction(group: str) -> str:
    """Return the errors of a robot's entries; bold: ahead of the paper and the baselines."""
    rows, lowest = [], best_baseline(group)[1]
    for name, entry in PAPER["entries"].items():
        if not name.startswith(f"{group}/"):
            continue
        runs, paper = recorded(name), str(entry.get("paper", "–"))
        mean, std, square = runs[["error_mean", "error_std", "squared_error_mean"]].mean()
        ahead = mean < min(lowest, float(paper.split()[0].replace("–", "inf")))
        both = runs.get("state_squared_error_mean", pd.Series([None])).mean(skipna=False)
        seconds = runs.get("training_seconds", pd.Series([0.0])).agg(["min", "max"])
        pairs = f"{runs['pairs'].iloc[0] * entry.get('steps', 1):,.0f}"
        error = number(mean, ahead and not diverged(runs))
        rows.append([f"`{name.split('/')[1]}`", paper, f"{error} ± {number(std)}{diverged(runs)}"])
        rows[-1] += [f"{square:.1e} (q)" if pd.isna(both) else f"{both:.1e}"]
        rows[-1] += [" / ".join(map(number, runs["error_mean"]))]
        rows[-1] += [pairs + (f" ({entry['pairs']:,})" if "pairs" in entry else "")]
        rows[-1] += ["–".join(seconds.map("{:.0f}".format).unique())]
    for row in grid(task(group).query("model in @BASELINES"), ["error_mean"], mark=()):
        rows.append([row[0], "–", row[1], *["–"] * 4])
    head = "model, paper, mean error ± std, squared error, each seed, pairs (paper), seconds"
    return markdown(head.split(", "), rows)


def generalization() -> str:
    """Return errors within and beyond the training range, and after training on 500 pairs."""
    columns = ["in error_mean", "beyond error_mean", "beyond error_median", "few error_mean"]
    rows = []
    for robot in ("soft_arm_1_wide", "soft_arm_2", "panda"):
        parts = {"in ": robot, "beyond ": f"{robot}, beyond", "few ": f"{robot}, 500 pairs"}
        data = pd.concat([task(name, prefix) for prefix, name in parts.items()], axis=1)
        data = data.dropna(subset="beyond error_mean")
        models = [x for x in data.index.unique("model") if x not in [*BASELINES, "true equation"]]
        rows += [[robot, *row] for row in grid(data, columns, mark=models)]
    return markdown(["robot", "model", "in range", "beyond", "beyond, median", "500 pairs"], rows)


def payload() -> str:
    """Return the errors of the Panda's models with a load, before and after a short fit."""
    parts = [task("panda, payload, before", "before "), task("panda, payload, after")]
    head = {"before": "before error_mean", "after": "error_mean", "after, median": "error_median"}
    head |= {"after, 0.5 s": "window_0.5s_error_mean", "torque before": "before torque_share"}
    head |= {"torque after": "torque_share"}
    data = pd.concat(parts, axis=1).dropna(subset="error_mean")
    return markdown(["model", *head], grid(data, list(head.values())))


def terms() -> str:
    """Return the relative errors of the learned terms in %, with the paper's in parentheses."""
    rows = []
    for model, entry in PAPER["terms"].items():
        runs = recorded(f"soft_arm_1/{model}").mean()
        for configuration, printed in entry["paper"].items():
            errors = {x: 100 * runs[f"relative_error_{x}_{configuration}"] for x in entry["terms"]}
            cells = [f"{x:.1f} ({y})" for x, y in zip(errors.values(), printed, strict=True)]
            rows.append([f"`{model}`", f"`{configuration}`", *cells])
    return markdown(["model", "configuration", "M or M⁻¹", "D", "G", "A"], rows)


def sample_efficiency() -> str:
    """Return the mean error against the number of training pairs."""
    sizes = ["500", "2000", "8000", "45000"]
    errors = [recorded(f"sample_efficiency/{x}")["error_mean"].droplevel("robot") for x in sizes]
    rows = grid(pd.concat(errors, axis=1, keys=sizes), sizes, mark=["hnn", *MODELS])
    return markdown(["model", *(f"{size} pairs" for size in sizes)], rows)


def summary() -> str:
    """Return the table of the README."""
    rows = []
    for name, ours, rival in PAPER["summary"]:
        errors = [recorded(entry)["error_mean"].mean() for entry in (ours, rival)]
        baseline, lowest = best_baseline(ours.split("/")[0])
        cells = [number(x, x == min(*errors, lowest)) for x in (*errors, lowest)]
        paper = str(PAPER["entries"][ours].get("paper", "–"))
        rows.append([name, f"`{ours}`", paper, *cells[:2], f"{cells[2]} ({baseline})"])
    return markdown(["task", "model", "paper", "ours", "black box", "baseline"], rows)


def panda_windows() -> str:
    """Return the Panda's errors over windows of three lengths."""
    columns = {"0.05 s": "window_0.05s_error_mean", "0.5 s": "window_0.5s_error_mean"}
    columns |= {"2 s": "error_mean", "2 s, median": "error_median"}
    return markdown(["model", *columns], grid(task("panda"), [*columns.values()]))


def logs() -> str:
    """Return errors and durations on the logs; the spread is that of seeds, in the 1 s windows."""
    rows = []
    for log in LOGS:
        data = task(log).query("model in @MODELS")
        runs = data.groupby("model")[LONG]
        spread = (runs.max() - runs.min()).replace(0, None)
        seconds = data.reindex(columns=["processor_seconds", "training_seconds"]).bfill(axis=1)
        duration = seconds.iloc[:, 0].groupby("model").mean()
        for row in grid(data, [SHORT, LONG, "error_mean", "torque_share"], digits=3):
            name = row[0].strip("`")
            row.insert(3, number(spread[name]))
            rows.append([log, *row, number(duration[name])])
    head = ["log", "model", "0.1 s", "1 s", "spread", "open loop", "torque error", "processor, s"]
    return markdown(head, rows)


def windows() -> str:
    """Return errors and processor times of fits on several numbers of windows, and of ``auto``."""
    rows, columns = [], [SHORT, LONG, "error_mean", "processor_seconds"]
    for log in ("double_pendulum", "ur10e"):
        data = task(f"{log}, windows")
        data = pd.concat([data, task(log).query("model == 'known'")])
        for count, runs in data.groupby("pairs"):
            spread = (runs[LONG].max() - runs[LONG].min()) or float("nan")
            text = f"{count:.0f}" + (" (auto)" if "known" in runs.index else "")
            means = [number(runs[name].mean(), digits=3) for name in columns]
            rows.append([log, text, *means[:2], number(spread), *means[2:]])
    head = ["log", "windows", "0.1 s", "1 s", "spread", "open loop", "processor, s"]
    return markdown(head, rows)


def intervals() -> str:
    """Return the share of errors within 95 % intervals, raw and scaled on validation data."""
    columns = [f"window_{t}_within_95{kind}" for kind in ("", "_corrected") for t in ("0.1s", "1s")]
    data = {log: task(log).reindex(columns=columns).dropna() for log in LOGS}
    rows = [[log, *row] for log in LOGS for row in grid(data[log], columns, mark=())]
    return markdown(["log", "model", "0.1 s", "1 s", "0.1 s, scaled", "1 s, scaled"], rows)


def control(name: str) -> str:
    """Return an error of the controllers on several tasks."""
    robot, metric, scale, *tasks = CONTROL[name]
    data = pd.concat([scale * task(f"{robot}, {x}")[metric] for x in tasks], axis=1, keys=tasks)
    head = ["terms, law", *(x.replace("_", " ") for x in tasks)]
    return markdown(head, grid(data, tasks, mark=data.index.unique("model")))


def filled(page: str) -> str:
    """Return a page with all of its tables made anew, each by the function of its name."""
    place = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
    robots = ("soft_arm_1_wide", "soft_arm_1", "soft_arm_2", "panda")
    make = globals() | {name: partial(prediction, name) for name in robots}
    make |= {name: partial(control, name) for name in CONTROL}
    return place.sub(lambda match: f"{match[1]}{make[match[2]]()}\n{match[3]}", page)


if __name__ == "__main__":
    for path in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]:
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
