"""The load of an arm from two logs, by train.py and by a run."""

import numpy as np
import pandas as pd
import pytest

import pinn_dyn
from tests.app.entry import NO_FIGURES, run_script
from tests.evaluation.test_payload import ARM, CENTER, INERTIA, MASS, recording

NAMES = {"q": ["shoulder", "elbow"], "v": ["d_shoulder", "d_elbow"], "u": ["tau_s", "tau_e"]}


def frame(seed, load):
    run = recording(seed, load)
    columns = np.hstack([run.t[:, None], run.q, run.v, run.u])
    return pd.DataFrame(columns, columns=["t", *NAMES["q"], *NAMES["v"], *NAMES["u"]])


def test_a_training_identifies_the_load_of_another_log(tmp_path, capsys):
    (tmp_path / "arm.urdf").write_text(ARM)
    frame(0, None).to_csv(tmp_path / "nothing.csv", index=False)
    loaded = frame(1, (MASS, CENTER, INERTIA))
    loaded.to_csv(tmp_path / "with_tool.csv", index=False)
    signals = zip(NAMES.items(), ("rad", "rad/s", "Nm"), strict=True)
    run_script(
        "train.py",
        *("experiment=known", "dataset=csv_log", f"dataset.root={tmp_path}"),
        "dataset.files=nothing.csv",
        *(
            f"dataset.{x}={{columns: [{','.join(names)}], unit: {unit}}}"
            for (x, names), unit in signals
        ),
        *(
            "dataset.validation={seconds: 3.0, piece: 3.0}",
            "dataset.test={seconds: 3.0, piece: 3.0}",
        ),
        *(f"model.structure.urdf={tmp_path / 'arm.urdf'}", "optimizer.rollouts=false"),
        *("payload=with_tool.csv", "data.pairs=20", "data.batch_size=20", "optimizer.samples=800"),
        *("validator.horizon=0.5", NO_FIGURES, f"hydra.run.dir={tmp_path / 'run'}"),
    )
    assert "Load in the frame of lower" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "run" / "payload.csv")
    assert table.value[0] == pytest.approx(MASS, rel=0.02)
    np.testing.assert_allclose(table.value[1:4], CENTER, atol=5e-3)
    again = pinn_dyn.load(tmp_path / "run").identify_payload(loaded)
    np.testing.assert_allclose(again.value, table.value, atol=1e-3)
