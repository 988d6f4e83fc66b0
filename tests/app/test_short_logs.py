"""Known mechanics on seconds of data, in Python, with the default windows."""

from functools import partial

import numpy as np
import pandas as pd
import pytest

import pinn_dyn
from pinn_dyn.evaluation import RolloutValidator
from pinn_dyn.models import KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.support.rigid_chains import joint, link, robot

ROD = robot(
    link("base"),
    link("rod", 1.0),
    joint("swing", "continuous", "base", "rod", xyz="0 0 0", rpy="0 0 0", axis="0 1 0"),
)


def short_log(seconds, rate):
    """A pendulum of 0.3 kg m^2, 2 Nm and 0.1 Nms/rad by small steps."""
    t, h = np.arange(seconds * rate) / rate, 1 / rate / 20
    q, v, rows = 0.5, 0.0, []
    for k in range(len(t)):
        u = np.sin(5 * t[k]) + np.cos(3 * t[k])
        rows.append((t[k], q, v, u))
        for step in range(20):
            at = t[k] + step * h
            v += h * (np.sin(5 * at) + np.cos(3 * at) - 2 * np.sin(q) - 0.1 * v) / 0.3
            q += h * v
    return pd.DataFrame(rows, columns=["t", "q", "v", "tau"])


def test_seconds_of_a_log_give_the_constants(tmp_path):
    run = pinn_dyn.fit(
        short_log(2, 50),
        q="q",
        v="v",
        u="tau",
        model=partial(KnownMechanics, structure=RigidChain(ROD)),
        optimizer=LeastSquares(cutoff=8.0, evaluations=6),
        folder=tmp_path / "run",
    )
    table = pd.read_csv(tmp_path / "run" / "constants.csv", dtype=str).set_index("name")
    assert float(table.value["viscous friction of swing"]) == pytest.approx(0.1, rel=0.2)
    digits = table.value.str.replace(r"e.*|[-.]", "", regex=True).str.lstrip("0")
    assert (digits.str.len() <= 4).all()
    again = pinn_dyn.load(tmp_path / "run")  # built from its description
    assert float(again.model.mass_matrix(again.statistics.q_mean[None])) == pytest.approx(
        0.3, rel=0.05
    )
    assert run.metrics["validation"]["val/error_mean"] < 0.02


@pytest.mark.parametrize("is_useless", [False, True])
def test_a_model_behind_constant_velocity_is_named(caplog, is_useless):
    """A torque that is noise predicts no motion."""
    log = short_log(6, 50)
    if is_useless:
        log["tau"] = np.random.default_rng(0).normal(scale=10, size=len(log))
    pinn_dyn.fit(
        log,
        q="q",
        v="v",
        u="tau",
        model=partial(KnownMechanics, structure=RigidChain(ROD)),
        optimizer=LeastSquares(cutoff=8.0, rollouts=False),
    )
    warning = "predicts the validation motions no better than constant velocity"
    assert (warning in caplog.text) == is_useless
    assert ("probable cause: the noise of its torque" in caplog.text) == is_useless


def test_a_fit_refuses_what_no_trainer_has_and_names_what_it_does_not_use(caplog):
    fit = partial(
        pinn_dyn.fit,
        short_log(2, 50),
        q="q",
        v="v",
        u="tau",
        model=partial(KnownMechanics, structure=RigidChain(ROD)),
        optimizer=LeastSquares(cutoff=8.0, rollouts=False, evaluations=2),
        validator=partial(RolloutValidator, horizon=0.1),
    )
    with pytest.raises(ValueError, match=r"no key 'acelerator': did you mean accelerator\?$"):
        fit(trainer={"acelerator": "cpu"})
    fit(trainer={"accelerator": "cpu", "gradient_clip_val": 1.0, "precision": "bf16-mixed"})
    text = "least squares does not use"
    assert [x for x in caplog.messages if text in x] == [f"{text} trainer.precision"]
