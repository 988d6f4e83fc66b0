"""A log without inputs from the file to the evaluation: check, training, prediction, tables."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.integrate import solve_ivp

import pinn_dyn
from pinn_dyn.models import KnownMechanics
from pinn_dyn.systems import RigidChain
from pinn_dyn.training import LeastSquares
from tests.app.entry import NO_FIGURES, refused_text, run_script

ROD = """<robot name="pendulum"><link name="base"/>
  <link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="q" type="continuous"><parent link="base"/><child link="rod"/>
    <axis xyz="0 1 0"/></joint></robot>"""
"""A pendulum with 0.6 q'' = -9.81 sin q."""


def swings(runs=8, seconds=3.0, friction=0.1):
    t, tables = np.arange(0, seconds, 0.02), []
    for k in range(runs):

        def motion(_, x):
            return [x[1], -(9.81 * np.sin(x[0]) + friction * x[1]) / 0.6]

        x = solve_ivp(
            motion, (0, t[-1]), [0.2 * k - 0.7, 0.7 - 0.3 * (k % 4)], t_eval=t, rtol=1e-9, atol=1e-9
        ).y
        tables.append(pd.DataFrame({"run": f"r{k}", "t": t, "q": x[0], "v": x[1]}))
    return pd.concat(tables, ignore_index=True)


@pytest.fixture
def dataset(tmp_path):
    swings().to_csv(tmp_path / "swings.csv", index=False)
    folder = tmp_path / "conf" / "dataset"
    folder.mkdir(parents=True)
    (folder / "swings.yaml").write_text(
        f"""defaults: [csv_log, _self_]
name: swings
root: {tmp_path}
files: swings.csv
trajectory: run
q: {{columns: q, unit: rad}}
v: {{columns: v, unit: rad/s}}
u: []
validation: {{runs: 1, piece: 1.0}}
test: {{runs: 2, piece: 1.0}}
"""
    )
    return ["--config-dir", str(tmp_path / "conf"), "dataset=swings"]


@pytest.mark.usefixtures("undrawn")
def test_a_log_without_inputs_is_checked_trained_and_evaluated(dataset, tmp_path, capsys):
    run_script("check.py", *dataset, f"hydra.run.dir={tmp_path / 'check'}")
    text = capsys.readouterr().out
    assert "a training makes sense" in text
    small = ["model=lnn", "trainer.steps=2", "trainer.validations=1", "data.pairs=64"]
    small += ["data.batch_size=32", "data.stride=1", "validator.horizon=0.5", NO_FIGURES]
    run_script("train.py", *dataset, *small, f"hydra.run.dir={tmp_path / 'run'}")
    run = pinn_dyn.load(tmp_path / "run")
    assert run.terms([0.3]).A.shape == (1, 0)
    frame = swings(1)
    assert np.isfinite(run.predict(frame).to_numpy()).all()
    steps = run.predict([-0.7, 0.7], None, frame.t[:5])
    np.testing.assert_allclose(steps, run.predict(frame).to_numpy()[:5], atol=1e-9)
    summary = pinn_dyn.evaluate([run]).summary
    assert np.isfinite(summary["error_mean"]).all()
    assert "torque_share" not in summary
    words = [f"run={tmp_path / 'run'}", f"hydra.run.dir={tmp_path / 'control'}"]
    assert "no inputs" in refused_text(capsys, "control.py", *words)


def test_a_passive_pendulum_is_identified_up_to_a_factor():
    """The motion has one constant, m c g / (I + m c²) = 9.81 / 0.6, and one time of decay."""
    run = pinn_dyn.fit(
        swings(),
        q="q",
        v="v",
        u=None,
        run="run",
        model=partial(KnownMechanics, structure=RigidChain(ROD), start="prior"),
        optimizer=LeastSquares(cutoff=5.0, rollouts=False),
    )
    terms = run.terms([np.pi / 2])
    assert terms.G[0] / terms.M[0, 0] == pytest.approx(9.81 / 0.6, rel=2e-3)
    assert terms.D[0, 0] / terms.M[0, 0] == pytest.approx(0.1 / 0.6, rel=2e-2)
    mass = run.system.body_parameters()[0, 0]
    torch.testing.assert_close(mass, torch.tensor(2.0).double(), rtol=0.05, atol=0)
