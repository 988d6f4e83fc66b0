"""Logs with one fault each, and clean ones, of the folder ../shared/cases: what the check says."""

import functools
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from hydra.utils import instantiate

from pinn_dyn.data.logs import LogError, LogSource
from pinn_dyn.log_check.check import check
from pinn_dyn.run.training.known_data import match_structure
from pinn_dyn.systems import RigidChain
from pinn_dyn.wording import command_line
from tests.support.composing import compose

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="needs the folder ../shared/cases")

OUTSIDE = r"% of the test is outside the training range"
WANTED = {
    # Name: a pattern of each finding in turn, and of them all the ones that stop a training.
    "00-clean": [],
    "01-clean-coarse-encoder": [],
    "02-clean-one-fast-run": [],
    "03-joint-2-reversed": [r"joint q2 turns the other way in the log: .* q, v and u of it"],
    "04-torques-exchanged": ["the inputs 'tau1' and 'tau2' are exchanged"],
    "05-joints-exchanged": ["the columns of the joints q1 and q2 are exchanged"],
    "06-link-twice-as-long": ["check the kinematics"],
    "07-torque-in-percent": [r"'tau1' is (9\.9|10).* in another unit.*The same: q2"],
    "08-torque-at-the-motor": [r"'tau1' is 0\.0(199|2).* at the motor.*The same: q2"],
    "09-gear-of-3-on-q1": [r"q and v of joint q1 are (3|3\.0\d|2\.9\d) times those of the URDF"],
    "10-homing-offset": [r"q1 is 0\.(49|5)\d* off"],
    "11-current-reversed": ["'tau2' seems to push joint 2 backwards"],
    "12-unsigned-16-bit": "unsigned register of 16 bits",
    "13-action-is-the-next-state": [r"stop: .*'tau1' is 'q1' of the next row.*The same: tau2"],
    "14-zeros-at-the-start": ["q jumps after the first 3 rows"],
    "15-saturated-drive": [r"'tau1' is a command .*about (3|3\.1|3\.2) Nm act.*The same: tau2"],
    "16-torque-clock-fast": [r"the clock of input 'tau1' drifts by 0\.5 %"],
    "17-velocity-late": ["'v1' is 50 ms behind the derivative of 'q1'.*The same: q2, v2"],
    "18-clean-hard-motion": [],
    "19-before-gravity-compensation": ["gravity is missing in the log"],
    "20-coupled-drive": ["the input of joint q1 holds the torques of the joints q2 and q1"],
    "21-moved-by-hand": ["run run_3 .* is 0 there although the robot moves: is it moved by hand"],
    "22-one-run-backwards": ["run run_3 does not fit the rest of the log from 0"],
    "23-lost-rows": [r"in 2 % of the steps .*: rows are lost"],
    "24-drive-off": [r"run run_0 .* from 5.* tau1, tau2 do not act there, is the drive off\?"],
    "25-action-is-the-state": [r"stop: .*'tau1' is 'q1' of the same row.*The same: tau2"],
    "26-unknown-hose": [
        r"'tau1' acts (9\.\d+|10|10\.\d+) ms after it is logged.*The same: tau2",
        "of 'tau2' at joint q2 unexplained.*a spring at joint q2",
    ],
    "27-absolute-angle": [],
    "28-power": ["stop: the inputs explain .* of the motion"],
    "29-torques-at-20-hz": [r"'tau1' is held at 20 Hz: its values repeat for 10 rows"],
}
READ = {
    "50-a-file-for-each-signal": ["the last row is left out", OUTSIDE],
    "51-records-under-one-key": [OUTSIDE],
    "52-bag-without-storage-identifier": [OUTSIDE],
    "53-two-publishers": [r"400 of 2400 .* another publisher \(2000 of j1, j2 and 400 of", OUTSIDE],
}
REFUSED = {
    # Of the older cases: what a file or its description lacks.
    "11-no-header-no-time": r"numbered from 0.*time: \{rate: 100\}",
    "12-header-no-time": r"time: \{rate: 100\}",
    "25-lerobot-names-shorter": "2 names of 'observation.state', which has 3 entries",
    "26-bag-effort-nan": "NaN in all 2400 messages",
    "32-mcap-json": "nothing matches 'a.mcap'",
    "34-urdf-xacro": "xacro",
    "56-hdf5-aloha-no-clock": r"time: \{rate: 100\}",
    "59-csv-vector-cells": "did you mean position_",
}
NOTED = {"28-bag-stamp-zero": ["its times are those of receipt"]}


@pytest.fixture(autouse=True)
def _worded_for_the_command_line():
    """Blocks are pasted into YAML."""
    with command_line():
        yield


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    """Return the folder of the cases of a script, which it writes at the first call."""

    @functools.cache
    def written(*scripts):
        folder = tmp_path_factory.mktemp(scripts[0])
        for script in scripts:
            command = [sys.executable, "-B", f"{script}.py", str(folder)]
            subprocess.run(command, cwd=CASES, check=True, capture_output=True)
        return folder

    return written


def described(folder, block=""):
    """Return the arguments of the source of a case, with the entries of a block appended."""
    text = (folder / "conf/dataset/x.yaml").read_text() + block
    settings = yaml.safe_load(text)
    del settings["defaults"]
    steps = instantiate(settings.pop("steps", {}), _convert_="all")
    return {"time": {"columns": "t", "unit": "s"}, **settings, "steps": steps}


def checked(folder, block=""):
    source = LogSource(**described(folder, block))
    structure = None
    if "structure: yes" in (folder / "README").read_text() or "urdf" in folder.name:
        structure = match_structure(RigidChain(str(folder / "r.urdf")), source)
    return check(source, structure=structure)


def says(findings, patterns):
    texts = [" ".join(x.split()) for x in findings]
    assert len(texts) == len(patterns), texts
    for text, pattern in zip(texts, patterns, strict=True):
        assert re.search(pattern, text), text


def verified(folder, patterns):
    """Check a case, paste what is printed, and check it again."""
    if isinstance(patterns, str):
        with pytest.raises(ValueError, match=f"(?s){patterns}"):
            checked(folder)
        return
    result = checked(folder)
    says(result.findings(), patterns)
    assert bool(result.problems) == any(x.startswith("stop") for x in patterns)
    cures = ("acts", "is held at")
    if result.block:
        again = checked(folder, f"{result.block}\n")
        assert again.block == ""
        assert not [x for x in again.findings() if any(cure in x for cure in cures)]
    for _, options in result.candidates:
        compose("train", "dataset=example_log", *options)


@pytest.mark.parametrize("case", WANTED)
def test_a_log_gets_its_words_and_no_others(cases, case):
    verified(cases("make_wrong") / case, WANTED[case])


def test_a_log_in_which_all_columns_are_held_gets_steps_that_load(cases, tmp_path):
    """Values of 15 ms in rows of 1 ms."""
    folder = tmp_path / "held"
    shutil.copytree(cases("make_wrong") / "00-clean", folder)
    for path in folder.glob("run_*.csv"):
        frame = pd.read_csv(path)[::3]
        frame = frame.loc[frame.index.repeat(15)]
        frame.assign(t=np.arange(len(frame)) / 1000).to_csv(path, index=False)
    description = folder / "conf/dataset/x.yaml"
    text = description.read_text()
    description.write_text(re.sub("root: .*", f"root: {folder}", text))
    verified(folder, ["q is held at 66.7 Hz: all columns repeat for 15 rows"])


@pytest.mark.parametrize("case", READ)
def test_logs_of_other_recorders_are_read(cases, case):
    pytest.importorskip("rosbags")
    verified(cases("make_readers") / case, READ[case])


@pytest.mark.slow
def test_older_inputs_are_read_or_refused_with_a_cure(cases):
    """Files of other tools, all of one clean arm without a delay."""
    folder = cases("make_cases", "make_urdf", "make_bags", "make_more")
    folders = sorted(folder.iterdir())
    assert len(folders) >= 43
    for case in folders:
        name = case.name
        if name in REFUSED:
            with pytest.raises((LogError, ValueError), match=f"(?s){REFUSED[name]}"):
                checked(case)
            continue
        findings = [x for x in checked(case).findings() if OUTSIDE not in x]
        says(findings, NOTED.get(name, []))
