"""The equal search: the same draws for every model."""

import pandas as pd
import pytest
import yaml

from pinn_dyn.app.config import composed
from pinn_dyn.app.search import with_draw
from tests.app.entry import NO_FIGURES, TINY, run_script

MODELS = ["lnn", "hnn", "mlp", "acceleration"]


def drawn(experiment, draw, *words):
    config = composed(
        "train",
        ["search=equal", f"search.draw={draw}", *experiment.split(), "model_name=x", *words],
    )
    return config, with_draw(config, draw)


def values(part, key):
    """All values of a key, at any depth."""
    if not isinstance(part, dict):
        return []
    own = [part[key]] if key in part else []
    return own + [found for value in part.values() for found in values(value, key)]


@pytest.mark.parametrize("draw", [1, 7])
def test_every_model_gets_the_same_draw(draw):
    found = [drawn(f"experiment=soft_arm_1 model={model}", draw) for model in MODELS]
    optimizers = [
        (after["optimizer"]["lr"], after["optimizer"]["weight_decay"]) for _, after in found
    ]
    assert optimizers == [optimizers[0]] * len(MODELS)
    assert 5e-4 <= optimizers[0][0] <= 1e-2
    assert 1e-4 <= optimizers[0][1] <= 0.3
    layers = [hidden for _, after in found for hidden in values(after["model"], "hidden")]
    assert len(layers) > len(MODELS)
    assert layers == [layers[0]] * len(layers)
    lengths = {after["trainer"]["steps"] / before["trainer"]["steps"] for before, after in found}
    assert len(lengths) == 1
    for _, after in found:
        assert after["trainer"]["steps"] % after["trainer"]["validations"] == 0


def test_heads_of_a_structured_model_are_drawn_and_nothing_else():
    before, after = drawn("experiment=trunk", 0)
    assert after == before
    before, after = drawn("experiment=trunk", 1)
    assert before["model"]["input"]["linear"] == after["model"]["input"]["linear"]
    assert set(map(str, values(after["model"], "activation"))) != set(
        map(str, values(before["model"], "activation"))
    )
    changed = {key for key in before if before[key] != after[key]}
    assert changed == {"model", "optimizer", "trainer"}


def test_a_larger_budget_goes_on_from_a_smaller_one_and_covers_the_range():
    rates = [drawn("model=mlp", k)[1]["optimizer"]["lr"] for k in range(1, 17)]
    assert len(set(rates)) == 16
    assert min(rates) < 1e-3
    assert max(rates) > 5e-3


def test_runs_of_a_search_are_ordinary_ones_told_apart_by_their_draw(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["search=equal", "search.draw=0,3", "model=mlp", "hydra.sweep.dir=sweep"]
    run_script("train.py", "-m", *TINY, NO_FIGURES, *words)
    for config in (tmp_path / "sweep").glob("*/config.yaml"):
        assert set(yaml.safe_load(config.read_text())["search"]) == {"draw"}
    run_script("gather.py", "runs=[sweep]", "sort=val/error_windowed", "hydra.run.dir=gathered")
    table = pd.read_csv(tmp_path / "gathered" / "sweep.csv")
    assert sorted(table["search.draw"]) == [0, 3]
    assert "optimizer.lr" not in table


def test_a_fit_without_a_learning_rate_is_the_same_at_every_draw():
    before, after = drawn("experiment=known dataset=emps model.structure.urdf=x", 1)
    assert after == before
