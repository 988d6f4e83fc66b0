"""Tables over runs: what differs between runs, means over seeds, and the best entries."""

import math

import pandas as pd
import pytest

from pinn_dyn.evaluation.tables import (
    best,
    model_names,
    over_seeds,
    summary_columns,
    to_text,
    unbeaten_baselines,
    varied_settings,
)


def config(model="lnn", width=8, lr=0.1, seed=0, **model_settings):
    head = {"_target_": "m.Network", "width": width}
    return {
        "dataset": {"name": "arm", "seed": 3, "cache": f"/tmp/{seed}"},
        "data": {"seed": seed},
        "model": {"damping": head, **model_settings},
        "optimizer": {"lr": lr},
        "scheduler": {"max_lr": lr},
        "model_name": model,
        "seed": seed,
    }


@pytest.mark.parametrize(
    ("configs", "columns"),
    [
        ([config(), config(seed=1)], []),
        ([config(), config(lr=0.2), config(lr=0.2, seed=1)], ["optimizer.lr"]),
        ([config(), config(width=16)], ["model.damping.width"]),
        ([config(), config(width=16, seed=1)], ["model.damping.width"]),
        ([config(friction={"_target_": "F"}), config(seed=1)], ["model.friction._target_"]),
        ([config(start="run-seed0/x"), config(start="run-seed1/x", seed=1)], []),
        ([config(), config("mlp", width=64, hidden=[8])], ["model_name"]),
        (
            [config(), config(width=16), config("mlp", width=64)],
            ["model_name", "model.damping.width"],
        ),
    ],
)
def test_settings_vary_without_seeds_derived_keys_and_sizes_of_other_models(configs, columns):
    assert list(varied_settings(configs)) == columns


def test_runs_are_named_by_their_model_and_its_varied_settings():
    configs = [config(), config(seed=1), config(lr=0.2), config("mlp", lr=0.3)]
    names = model_names(["lnn", "lnn", "lnn", "mlp"], configs)
    assert names == ["lnn optimizer.lr=0.1", "lnn optimizer.lr=0.1", "lnn optimizer.lr=0.2", "mlp"]
    assert model_names(["lnn", "lnn"], configs[:2]) == ["lnn", "lnn"]


@pytest.mark.filterwarnings("error")
def test_a_diverged_seed_makes_a_mean_infinite_and_never_nan():
    runs = pd.DataFrame(
        {
            "model": ["a", "a", "b", "b", "c"],
            "seed": [0, 1, 0, 1, 0],
            "error_mean": [1.0, 3.0, 1.0, math.inf, 4.0],
        }
    )
    table = over_seeds(runs, ["model"])
    assert table["seeds"].tolist() == [2, 2, 1]
    assert table["error_mean"].tolist() == [2.0, math.inf, 4.0]
    assert table["error_mean_std"][0] == pytest.approx(math.sqrt(2))
    text = to_text(table, {"model": "model", "error_mean": "error"})
    assert "2 ± 1.41" in text
    assert "inf" in text
    assert "nan" not in text.lower()
    assert over_seeds(runs[:2], [])["seeds"].tolist() == [2]


def summary(models, baselines=None, lost=()):
    rows = [
        {
            "run": name,
            "seed": None if baseline else 0,
            "baseline": baseline,
            "error_mean": error,
            "error_std": 0.5,
            "diverged": int(name in lost),
        }
        for part, baseline in ((models, False), (baselines or {}, True))
        for name, error in part.items()
    ]
    return pd.DataFrame(rows).astype({"seed": "Int64"})


BASELINES = {"hold position": 0.9, "ARX": 0.3}


@pytest.mark.parametrize(
    ("models", "lost", "winner"),
    [
        ({"lnn": 0.2, "mlp": 0.25}, (), "lnn"),
        # Better than one of two baselines is not enough, and a tie is not better.
        ({"lnn": 0.35, "mlp": 0.5}, (), None),
        ({"lnn": 0.3, "mlp": 0.5}, (), None),
        # The mean leaves diverged rollouts out: such a model does not beat a complete baseline.
        ({"lnn": 0.2, "mlp": 0.5}, ("lnn",), None),
        # A baseline with diverged rollouts is no bar.
        ({"lnn": 0.35, "mlp": 0.5}, ("ARX",), "lnn"),
        ({"lnn": math.inf, "mlp": 0.25}, ("lnn",), "mlp"),
        # Means over other trajectories are no comparison, even if all rows have diverged rollouts.
        ({"lnn": 0.2, "mlp": 0.5}, ("lnn", "mlp", "ARX", "hold position"), "nobody"),
    ],
)
def test_the_best_model_beats_all_baselines(models, lost, winner):
    frame = summary(models, BASELINES, lost)
    none_complete, winner = winner == "nobody", None if winner == "nobody" else winner
    assert frame["run"][best(frame, "error_mean")].tolist() == ([winner] if winner else [])
    sentences = unbeaten_baselines(frame)
    assert len(sentences) == (winner is None and not none_complete)
    assert all("'ARX': error_mean 0.3" in sentence for sentence in sentences)
    text = to_text(frame, summary_columns(frame))
    assert text.count("*") == (winner is not None)
    assert "[ARX]" in text


def test_a_longer_valid_time_is_better_and_other_columns_have_no_best_entry():
    frame = summary({"lnn": 0.2, "mlp": 0.5}).assign(
        valid_time_large=[1.0, 2.0], window_1s_error_mean=[0.4, 0.1], parameters=[10, 20]
    )
    assert frame["run"][best(frame, "valid_time_large")].tolist() == ["mlp"]
    assert frame["run"][best(frame, "window_1s_error_mean")].tolist() == ["mlp"]
    assert not best(frame, "parameters").any()
    assert unbeaten_baselines(frame) == []


def test_an_error_over_the_surviving_rollouts_shows_the_lost_ones():
    frame = summary({"lnn": 0.2, "mlp": 0.5}, BASELINES, lost=("lnn",)).assign(trajectories=4)
    lines = to_text(frame, summary_columns(frame)).splitlines()
    assert "0.2 ± 0.5 (diverged: 1 of 4)" in lines[1]
    assert all("diverged" not in line for line in lines[2:])
