"""excite.py: a motion for a robot, within the limits on the command line."""

import numpy as np
import pytest
import yaml

from tests.app.entry import ROOT, fails, run_script

ROBOT = f"model.structure.urdf={ROOT / 'examples' / 'double_pendulum.urdf'}"


def test_a_motion_is_designed_within_limits_by_joint(tmp_path, capsys):
    words = [ROBOT, "limits.velocity={elbow: 2}", "limits.high=1.5", "duration=4", "steps=3"]
    run_script("excite.py", *words, f"hydra.run.dir={tmp_path}")
    text = capsys.readouterr().out
    assert "condition number of 13 base parameters" in text
    assert "not checked" in text
    table = np.genfromtxt(tmp_path / "motion.csv", delimiter=",", names=True)
    assert table["t"][-1] == 4
    assert np.abs(table["v_elbow"]).max() <= 1.8
    assert np.abs(table["v_shoulder"]).max() <= 0.9
    assert table["q_elbow"].max() <= 1.5
    message = yaml.safe_load((tmp_path / "joint_trajectory.yaml").read_text())
    assert message["joint_names"] == ["shoulder", "elbow"]
    assert (tmp_path / "motion.png").is_file()


@pytest.mark.parametrize(
    ("word", "message"),
    [("limits.velocity={elbo: 2}", "did you mean elbow"), ("limits.speed=1", "limits.speed")],
)
def test_a_wrong_limit_is_refused_by_name(tmp_path, word, message):
    assert message in str(fails("excite.py", ROBOT, word, f"hydra.run.dir={tmp_path}").code)
