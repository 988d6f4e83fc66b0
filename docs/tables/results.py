"""Tables of README.md, docs/results.md and docs/control.md, made of the CSV files in results/."""

from __future__ import annotations

import pandas as pd

from docs.tables.floors import GROUND
from docs.tables.paper import best_floor, floors_of, lost, squared_norm
from docs.tables.text import bold, number, table
from reproduce import ROOT, read_entries, recorded, training_seconds

RESULTS = ROOT / "results"
NAMES = {
    "learned": "the paper's law on learned terms",
    "learned_observer": "the same with the observer",
    "truth": "the paper's law on the truth",
    "computed_torque": "computed torque on the truth",
    "gravity_pd": "PD with true gravity",
    "pd": "PD alone",
}
# Of each row of the README: task, model, entry of ours, of the best black box. An entry is one of
# reproduction.yaml, or a log and its model.
SUMMARY = [
    ("one-segment soft arm, 5 s", "hnn", "soft_arm_1_wide/hnn", "soft_arm_1_wide/mlp"),
    ("", "lnn", "soft_arm_1_wide/lnn_wide", "soft_arm_1_wide/mlp"),
    (
        "two-segment soft arm at 100 Hz, 10 s",
        "lnn",
        "soft_arm_2/lnn_100hz_wide",
        "soft_arm_2/mlp_100hz",
    ),
    ("Panda in PyBullet, its kinematics known, 2 s", "known", "panda/known", "panda/mlp"),
    ("double pendulum, real, 2 s", "lnn", "double_pendulum/lnn", "double_pendulum/mlp"),
    ("tendon-driven trunk, real, 10 s", "lnn", "trunk/lnn", "trunk/mlp"),
]
LOGS = {"double_pendulum": "rad", "panda_gaz": "rad", "soft_neck": "rad", "trunk": "m"}
RIGID = {"double_pendulum": "rad", "ur10e": "rad", "panda_gaz": "rad", "emps": "m"}
WINDOWS = ["window_0.1s_error_mean", "window_1s_error_mean", "error_mean"]


def read_log(name: str) -> pd.DataFrame:
    """The evaluations of networks on one log; its floors are in a file of their own."""
    folders = [RESULTS / "logs" / f"{name}{rest}" for rest in ("", "_mlp")]
    files = [folder / "summary.csv" for folder in folders]
    data = pd.concat([pd.read_csv(path) for path in files if path.is_file()])
    return data[data["model"].isin(_NETWORKS)]


def rows_of(entry: str) -> pd.DataFrame:
    dataset, model = entry.split("/")
    if dataset in LOGS:
        data = read_log(dataset)
        return data[data["model"] == model]
    return recorded(read_entries()[entry])


def summary() -> str:
    """The table of the README: the paper, ours, the best black box and the best floor."""
    entries, rows = read_entries(), []
    for task, model, ours, rival in SUMMARY:
        data, other = rows_of(ours), rows_of(rival)
        mean, best = data["error_mean"].mean(), other["error_mean"].mean()
        floor, lowest = best_floor(ours.split("/")[0])
        square, _, of = squared_norm(data)
        paper = entries.get(ours, {}).get("paper", "–")
        experiment = entries[ours]["train"][0] if ours in entries else f"experiment=logs/{ours}"
        cells = [
            task,
            f"`{model}`",
            paper,
            f"{bold(number(mean), mean < min(best, lowest) and not lost(data))}{lost(data)}",
            f"{square:.1e}{of}",
        ]
        steps = entries.get(ours, {}).get("steps", 1)
        cells += [_effort(data, steps), bold(number(best), best < min(mean, lowest))]
        rows.append([*cells, _effort(other), f"{number(lowest)}, {floor}", f"`{experiment}`"])
    head = ["task", "model", "paper", "ours: mean norm", "squared norm of (q, v)"]
    head += ["pairs, training", "best black box", "pairs, training", "best floor"]
    return table([*head, "trained by"], rows)


def _effort(data: pd.DataFrame, steps: int = 1) -> str:
    """Pairs, and minutes of the processor in the mean over the seeds."""
    minutes = training_seconds(data).mean() / 60
    return f"{int(data['pairs'].iloc[0]) * steps:,}, {number(minutes)} min"


_PANDA_STEPS = {"identification": 20, "known": 20, "known_and_network": 10}
"""Pairs in a training window, where it is not one."""


def panda() -> str:
    """The Panda in PyBullet over windows of three lengths."""
    data = pd.read_csv(RESULTS / "panda" / "summary.csv")
    columns = ["window_0.05s_error_mean", "window_0.5s_error_mean", "error_mean", "error_median"]
    runs = data.groupby(["model", "pairs"], sort=False)
    means, counts = runs[columns].mean(), runs[["diverged", "trajectories"]].sum()
    floors, rows = floors_of("panda"), []
    lowest = means.min().combine(floors[columns].min(), min)
    for (model, windows), row in means.iterrows():
        cells = [bold(number(row[c]), row[c] == lowest[c]) for c in columns]
        lost, every = counts.loc[(model, windows)]
        diverged = f"{lost} of {every}"
        pairs = int(windows) * _PANDA_STEPS.get(model, 1)
        rows.append([f"`{model}`", f"{pairs:,}", *cells, diverged])
    for label, figures in pd.concat([floors, floors_of("panda", ground=True)]).iterrows():
        diverged = f"{figures['diverged']:.0f} of {figures['trajectories']:.0f}"
        name = "true equation, the same RK4" if label == GROUND else str(label)
        rows.append([name, "–", *(number(figures[c]) for c in columns), diverged])
    head = ["model", "pairs", "0.05 s windows", "0.5 s windows", "2 s", "2 s, median", "diverged"]
    return table(head, rows)


_NETWORKS = ("lnn", "lnn_residual", "acceleration", "mlp")


_FLOORS = ("stands still", "keeps its velocity", "ARX", "EDMDc degree 2")


def logs() -> str:
    """The logs of real robots: means over the seeds, with the smallest and the largest."""
    rows = []
    for name, unit in LOGS.items():
        floors = floors_of(name)
        data = pd.concat([read_log(name), floors.reset_index()])
        rows += _log_rows(name, unit, data, [*_NETWORKS, *floors.index], spread=True)
    return table(["log", "model", "0.1 s windows", "1 s windows", "open loop"], rows)


_RIGID_ROWS = ("identification", "known", "known_and_network", "lnn", "acceleration", "mlp")


def rigid() -> str:
    """Known mechanics on the logs of rigid robots, and what they have to beat."""
    rows = []
    for name, unit in RIGID.items():
        data = _of_log(name)
        torque = data.groupby("model")["torque_share"].mean()
        for row in _log_rows(name, unit, data, [*_RIGID_ROWS, *_FLOORS]):
            share = torque[row[1].strip("`")]
            rows.append([*row, "–" if pd.isna(share) else number(share)])
    head = ["log", "model", "0.1 s windows", "1 s windows", "open loop", "torque error / spread"]
    return table(head, rows)


def _log_rows(
    name: str, unit: str, data: pd.DataFrame, order: list[str], *, spread: bool = False
) -> list[list[str]]:
    """A row for each model and floor of a log: means over the seeds, the smallest bold."""
    means, rows = data.groupby("model")[WINDOWS].mean(), []
    for model in (one for one in order if one in means.index):
        runs, cells = data[data["model"] == model], []
        for column in WINDOWS:
            mean, low, high = means.loc[model, column], runs[column].min(), runs[column].max()
            between = f" ({_precise(low)}–{_precise(high)})" if spread and len(runs) > 1 else ""
            shown = bold(_error(mean), mean == means[column].min())
            cells.append(f"{shown}{between}{_lost(runs, column, mean)}")
        label = model if model in _FLOORS else f"`{model}`"
        rows.append(["" if rows else f"`{name}`, {unit}", label, *cells])
    return rows


def torque() -> str:
    """Torque errors of known mechanics joint by joint, in parts of the spread of each torque."""
    rows = []
    for name in RIGID:
        data = pd.read_csv(RESULTS / "logs" / f"{name}_known" / "torque.csv")
        for index, (model, joints) in enumerate(data.groupby("run", sort=False)):
            shares = ", ".join(f"{share:.2f}" for share in joints["torque_share"])
            rows.append([f"`{name}`" if index == 0 else "", f"`{model}`", shares])
    return table(["log", "model", "joint 1, 2, ..."], rows)


def intervals() -> str:
    """What the 95 % intervals of predictions hold on the logs of rigid robots."""
    rows = []
    for name in RIGID:
        data = pd.read_csv(RESULTS / "logs" / f"{name}_known" / "calibration.csv")
        for run, windows in data[data["level"] == 0.95].groupby("run", sort=False):
            kind = "ensemble of 5" if run == "lnn" else "fitted constants"
            cells = []
            for column in ("share", "corrected", "factor"):
                unit, scale = ("", 1) if column == "factor" else (" %", 100)
                shown = [number(scale * x) if x < float("inf") else "∞" for x in windows[column]]
                cells.append(", ".join(f"{x}{unit}" for x in shown))
            rows.append([f"`{name}`", f"`{run}`, {kind}", *cells])
    head = ["log", "members from", "as the members say", "width from validation", "factor"]
    return table(head, rows)


_MECHANICAL = ("identification", "known", "known_and_network", "lnn", "lnn_residual")


def verdict() -> str:
    """For each log the best mechanical model beside the best of all rivals and floors."""
    rows, ahead = [], dict.fromkeys(WINDOWS[:2], 0)
    for name, unit in {**RIGID, **LOGS}.items():
        data = _of_log(name)
        cells = []
        for column in WINDOWS[:2]:
            means = data.groupby("model")[column].mean().dropna()
            ours = means[means.index.isin(_MECHANICAL)]
            others = means.drop(ours.index)
            # Within the spread over seeds of either it is a tie.
            runs = data[data["model"].isin([ours.idxmin(), others.idxmin()])]
            spread = runs.groupby("model")[column].agg(lambda x: x.max() - x.min()).max()
            holds = ours.min() <= others.min() + spread
            ahead[column] += holds
            cells += [
                f"{bold(_precise(ours.min()), holds)} (`{ours.idxmin()}`)",
                f"{bold(_precise(others.min()), not holds)} ({others.idxmin()})",
            ]
        rows.append([f"`{name}`, {unit}", *cells])
    head = ["log", "mechanical, 0.1 s", "best rival or floor", "mechanical, 1 s"]
    counts = (
        f"{n} of {len(rows)} after {when}"
        for n, when in zip(ahead.values(), ("0.1 s", "1 s"), strict=True)
    )
    found = table([*head, "best rival or floor"], rows)
    said = "Ahead of every rival and floor, or level with them within the spread over seeds"
    return f"{found}\n{said}: {', '.join(counts)}.\n"


def _of_log(name: str) -> pd.DataFrame:
    """All evaluations of a log with its floors: of networks those of every seed there is."""
    if name not in RIGID:
        return pd.concat([read_log(name), floors_of(name).reset_index()])
    data = pd.read_csv(RESULTS / "logs" / f"{name}_known" / "summary.csv")
    if name not in LOGS:
        return data
    networks = read_log(name).assign(floor=False)
    key = ["model", "seed"]  # networks of both are the same trainings
    return networks.set_index(key).combine_first(data.set_index(key)).reset_index()


def _precise(value: float) -> str:
    """Three digits, as the models of a log are close to each other."""
    return f"{value:#.3g}"


_DIVERGED = 100.0
"""A mean error above it is that of motions that broke down."""


def _error(value: float) -> str:
    return _precise(value) if value < _DIVERGED else "diverged"


def _lost(runs: pd.DataFrame, column: str, mean: float) -> str:
    """How many motions diverged and are in no mean, if any did."""
    name = column.replace("error_mean", "diverged")
    count = int(runs[name].sum()) if name in runs else 0
    if not count or mean >= _DIVERGED:
        return ""
    return f", {count} of {int(runs['trajectories'].sum())} diverged"


def neck() -> str:
    """Ensembles of five on three draws of the neck's runs: errors after 0.1 s and 1 s."""
    files = [RESULTS / "logs" / f"soft_neck_ensembles_draw{k}" / "summary.csv" for k in range(3)]
    draws = [pd.read_csv(path).assign(draw=k) for k, path in enumerate(files)]
    data = pd.concat(draws)
    data["substeps"] = data["run"].str.extract(r"_(\d)$")[0].fillna("–")
    rows = []
    for (model, substeps), runs in data.groupby(["model", "substeps"], sort=False):
        runs = runs.sort_values("draw")
        pairs = [*zip(*(runs[c] for c in WINDOWS[:2]), strict=True)]
        pairs.append(tuple(runs[WINDOWS[:2]].mean()))
        cells = [f"{a:.5f}, {b:.5f}" for a, b in pairs]
        rows.append([f"`{model}`", substeps, *cells])
    head = ["model", "substeps", *(f"`dataset.seed={k}`" for k in range(3)), "mean"]
    return table(head, rows)


def long_rollout() -> str:
    """50,000 steps of the one-segment arm."""
    data = pd.read_csv(RESULTS / "soft_arm_1" / "long_rollout.csv")
    columns = ["error_first_half", "error_second_half", "error_worst"]
    rows = []
    for _, row in data.iterrows():
        mean = f"{number(row['error_mean'])} ± {number(row['error_std'])}"
        rows.append([f"`{row['model']}`", mean, *(number(row[c]) for c in columns)])
    return table(["model", "mean ± std", "first 5 s", "last 5 s", "worst trajectory"], rows)


def _controlled(robot: str, run: str) -> pd.DataFrame:
    path = RESULTS / "control" / robot / run / "summary.csv"
    return pd.read_csv(path).set_index("controller")


def regulation() -> str:
    """Set points of the two-segment arm."""
    nominal = [_controlled("soft_arm_2", f"regulation_seed{seed}") for seed in range(3)]
    soft = _controlled("soft_arm_2", "regulation_paper_gains")
    heavier = _controlled("soft_arm_2", "regulation_heavier")
    found = [
        *(
            (f"learned terms, seed {k}", "200 / 20", run.loc["learned"])
            for k, run in enumerate(nominal)
        ),
        ("true terms", "200 / 20", nominal[0].loc["truth"]),
        ("PD alone", "200 / 20", nominal[0].loc["pd"]),
        ("learned, the arm 20 % heavier", "200 / 20", heavier.loc["learned"]),
        ("true terms of the lighter arm, the same", "200 / 20", heavier.loc["truth"]),
        ("learned terms, the paper's gains", "10 / 50", soft.loc["learned"]),
    ]
    rows = []
    for name, gains, row in found:
        mean, worst = (row[f"step_error_after_1_s_{c}_percent"] for c in ("mean", "worst"))
        settled = row["settling_time_worst_s"]
        rows.append([name, gains, f"{number(mean)} %", f"{number(worst)} %"])
        rows[-1] += [f"{number(row['overshoot_worst_percent'])} %", f"{row['input_peak']:.0f}"]
        rows[-1].append("never" if settled == float("inf") else f"{settled:.2f} s")
    head = ["law on", "K_P / K_D", "step error, mean", "worst", "overshoot, worst", "largest input"]
    return table([*head, "settled within 2 %, worst"], rows)


def tracking() -> str:
    """Sines and a helix of the Panda in PyBullet: RMS and largest errors, in mrad."""
    runs = ["tracking", "helix", "tracking_heavier", "helix_heavier"]
    runs += ["tracking_payload", "tracking_other_inertia"]
    found = [(name, "panda", controller) for controller, name in NAMES.items()]
    found[2:2] = [
        ("the paper's law on known mechanics", "panda_known", "learned"),
        ("the same with the observer", "panda_known", "learned_observer"),
        ("the paper's law on known mechanics and a network", "panda_sum", "learned"),
        ("the same with the observer", "panda_sum", "learned_observer"),
    ]
    rows = []
    for name, robot, controller in found:
        errors = [_controlled(robot, run).loc[controller] for run in runs]
        cells = (f"{number(1000 * e.rms_error)}, {number(1000 * e.max_error)}" for e in errors)
        rows.append([name, *cells])
    head = ["law", "sines", "helix", "sines, 20 % heavier", "helix, 20 % heavier"]
    return table([*head, "sines, 1 kg in the hand", "sines, other inertias"], rows)


TABLES = {
    "README.md": lambda: {"summary": summary()},
    "docs/results.md": lambda: {
        "summary": summary(),
        "panda": panda(),
        "logs": logs(),
        "rigid": rigid(),
        "torque": torque(),
        "intervals": intervals(),
        "verdict": verdict(),
        "neck": neck(),
        "long_rollout": long_rollout(),
    },
    "docs/control.md": lambda: {"regulation": regulation(), "tracking": tracking()},
}
