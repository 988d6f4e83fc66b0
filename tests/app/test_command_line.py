"""Mistakes on the command line: what is said, and that nothing is left behind."""

import re
import sys
from datetime import datetime
from subprocess import PIPE, Popen

import pytest
import torch

from pinn_dyn.app.command import COMMANDS, main
from pinn_dyn.app.config import completed, composed
from tests.app.entry import NO_FIGURES, ROOT, TINY, fails, refused_text


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Where runs would be written."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_an_option_that_a_shipped_option_hides_is_refused(elsewhere, capsys):
    """Hydra would read the shipped file without a word."""
    (elsewhere / "conf" / "dataset").mkdir(parents=True)
    (elsewhere / "conf" / "dataset" / "panda.yaml").write_text("defaults: [csv_log, _self_]\n")
    words = ["--config-dir", str(elsewhere / "conf"), "dataset=panda"]
    text = refused_text(capsys, "train.py", *words)
    assert f"{elsewhere / 'conf' / 'dataset' / 'panda.yaml'} is hidden by" in text


@pytest.mark.parametrize(
    ("script", "mistake", "meant"),
    [
        ("train.py", "trainer.step=1", "trainer.steps"),
        ("train.py", "optimiser.lr=0.1", "optimizer"),
        ("train.py", "weight_decay=1", "optimizer.weight_decay"),
        ("check.py", "longest_dely=1", "longest_delay"),
    ],
)
def test_a_misspelt_key_is_answered_with_the_right_one(elsewhere, script, mistake, meant):
    error = fails(script, mistake)
    # Of a dotted name the part that does not exist.
    key = mistake.split("=")[0]
    assert f"no key '{key}'" in str(error) or f"no key '{key.split('.')[0]}'" in str(error)
    assert "did you mean" in str(error)
    assert re.search(rf"[ ]{re.escape(meant)}[ ?]", str(error).split("did you mean")[1])
    assert not list(elsewhere.iterdir())


def test_paths_of_run_folders_need_no_key(elsewhere):
    """Paths of runs without a key, as typed or as a shell expands runs/*."""
    paths = ["runs/a", "runs/it has, commas"]
    assert composed("evaluate", ["horizon=1", *paths])["runs"] == paths
    assert completed("control", ["runs/a"]) == ["++run='runs/a'"]
    assert "'runs/a' matches no run folder" in str(fails("evaluate.py", "runs/a"))


def test_a_data_set_without_a_name_has_that_of_its_file(elsewhere):
    (elsewhere / "conf" / "dataset").mkdir(parents=True)
    log = "files: a.csv\nq: {columns: q, unit: rad}\nu: []\n"
    text = f"defaults: [csv_log, _self_]\n{log}"
    (elsewhere / "conf" / "dataset" / "my_arm.yaml").write_text(text)
    config = composed("train", ["dataset=my_arm"], str(elsewhere / "conf"))
    assert config["dataset"]["name"] == "my_arm"


def test_a_misspelt_key_in_a_sweep_is_answered_before_any_run(elsewhere):
    error = fails("train.py", "-m", "model=lnn,hnn", "data.pair=64,128")
    assert "did you mean data.pairs" in str(error)
    assert not list(elsewhere.iterdir())


@pytest.mark.parametrize(
    ("choice", "options"),
    [("model=lagrange", ["hnn", "lnn", "mlp"]), ("model/damping=none", ["constant", "network"])],
)
def test_a_wrong_option_of_a_group_lists_the_right_ones(elsewhere, capsys, choice, options):
    text = refused_text(capsys, "train.py", choice)
    assert choice.split("=")[1] in text
    for option in options:
        assert option in text
    assert not list(elsewhere.iterdir())


@pytest.mark.parametrize(
    ("words", "key"),
    [(["train.py", *TINY, "model=known"], "model.structure.urdf"), (["evaluate.py"], "runs")],
)
def test_a_missing_value_is_asked_for_by_name(elsewhere, capsys, words, key):
    text = refused_text(capsys, *words)
    assert f"no value for {key}: give it as '{key}=...'" in text
    assert not list(elsewhere.rglob("*.ckpt"))


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("compile=true", "compile is true, but there is no C++ compiler"),
        pytest.param(
            "trainer.accelerator=gpu",
            "trainer: No supported gpu backend",
            marks=pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
        ),
    ],
)
def test_a_missing_compiler_or_device_is_refused_before_data_are_made(
    elsewhere, capsys, monkeypatch, word, message
):
    monkeypatch.setattr("pinn_dyn.run.training.trainer.has_cpp_compiler", lambda: False)
    monkeypatch.setattr(
        "pinn_dyn.run.training.prepared.build_data", lambda *_: pytest.fail("made data")
    )
    assert message in refused_text(capsys, "train.py", *TINY, NO_FIGURES, word)


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_an_installed_command_names_the_command(capsys, monkeypatch, command):
    monkeypatch.setattr("sys.argv", [f"/usr/bin/pinn-dyn-{command}", "--help"])
    with pytest.raises(SystemExit):
        main(command)
    text = capsys.readouterr().out
    assert f"  pinn-dyn-{command} " in text
    assert f"{command}.py" not in text


def test_help_ends_quietly_in_a_pipe_that_closes():
    code = "import sys; sys.argv = ['train.py', '--help']; from pinn_dyn.app.command import train"
    with Popen([sys.executable, "-c", f"{code}; train()"], stdout=PIPE, stderr=PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""


def test_commands_of_the_same_second_write_into_different_folders():
    patterns = [
        pattern
        for path in (ROOT / "conf").rglob("*.yaml")
        for pattern in re.findall(r"\$\{now:(.*?)\}", path.read_text())
    ]
    second = [datetime(2026, 1, 2, 3, 4, 5, microsecond) for microsecond in (1, 2)]
    assert len(patterns) >= 7
    assert all(second[0].strftime(x) != second[1].strftime(x) for x in patterns)
