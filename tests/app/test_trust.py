"""Run folders from strangers: nothing that their configurations name is run, or written to."""

import copy
import math
import shutil
import time

import pytest
import torch
import yaml

from pinn_dyn.app import trust
from pinn_dyn.app.config import CONF
from pinn_dyn.app.run_folder import load_run
from pinn_dyn.app.schema import ConfigError
from tests.app.entry import refused_text, run_script

MARK = "was_here"


def foreign(run, folder, change):
    """A copy of a run whose configuration somebody has changed; its checkpoint says the same."""
    shutil.copytree(run, folder)
    config = yaml.safe_load((folder / "config.yaml").read_text())
    change(config)
    (folder / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    for name in ("best", "last"):
        path = folder / "checkpoints" / f"{name}.ckpt"
        saved = torch.load(path, weights_only=True)
        saved["hyper_parameters"]["config"] = copy.deepcopy(config)
        torch.save(saved, path)
    return folder


def calls(mark):
    """What would leave the mark, in many ways, each a ``_target_`` with its arguments."""
    touch = f"touch {mark}"
    code = f"open({mark!r}, 'w')"
    return [
        ("os.system", {"command": touch}),
        ("posix.system", {"command": touch}),
        ("os.popen", {"cmd": touch}),
        ("os.mkdir", {"path": mark}),
        ("os.makedirs", {"name": mark}),
        ("os.mknod", {"path": mark}),
        ("os.symlink", {"src": "/", "dst": mark}),
        ("subprocess.run", {"args": ["touch", mark]}),
        ("subprocess.Popen", {"args": ["touch", mark]}),
        ("subprocess.check_output", {"args": ["touch", mark]}),
        ("subprocess.getoutput", {"cmd": touch}),
        ("builtins.exec", {"_args_": [code]}),
        ("builtins.eval", {"_args_": [code]}),
        ("builtins.open", {"file": mark, "mode": "w"}),
        ("builtins.__import__", {"name": "antigravity"}),
        ("io.open", {"file": mark, "mode": "w"}),
        ("pathlib.Path.touch", {"self": {"_target_": "pathlib.Path", "_args_": [mark]}}),
        ("pathlib.Path.mkdir", {"self": {"_target_": "pathlib.Path", "_args_": [mark]}}),
        ("shutil.copytree", {"src": str(CONF), "dst": mark}),
        ("shutil.rmtree", {"path": mark}),
        ("shutil.os.system", {"command": touch}),
        ("runpy.run_path", {"path_name": mark}),
        ("code.interact", {}),
        ("pickle.loads", {"_args_": ["x"]}),
        ("pickle.load", {"file": mark}),
        ("pandas.read_pickle", {"filepath_or_buffer": mark}),
        ("joblib.load", {"filename": mark}),
        ("numpy.load", {"file": mark, "allow_pickle": True}),
        ("numpy.save", {"file": mark, "arr": [1]}),
        ("numpy.savetxt", {"fname": mark, "X": [1]}),
        ("torch.load", {"f": mark, "weights_only": False}),
        ("torch.save", {"obj": 1, "f": mark}),
        ("torch.hub.load", {"repo_or_dir": mark, "model": "x", "source": "local"}),
        ("torch.jit.load", {"f": mark}),
        ("torch.utils.cpp_extension.load", {"name": "x", "sources": [mark]}),
        ("torch.optim.os.system", {"command": touch}),
        ("torch.serialization.os.system", {"command": touch}),
        ("lightning.pytorch.callbacks.os.system", {"command": touch}),
        ("lightning.pytorch.utilities.os.mkdir", {"path": mark}),
        ("lightning.pytorch.callbacks.LambdaCallback", {"setup": {"_target_": "os.system"}}),
        ("hydra.utils.get_object", {"path": "os.system"}),
        ("hydra.utils.get_class", {"path": "subprocess.Popen"}),
        ("hydra.utils.get_method", {"path": "os.system"}),
        ("hydra.utils.instantiate", {"config": {"_target_": "os.mkdir", "path": mark}}),
        ("hydra.utils.call", {"config": {"_target_": "os.mkdir", "path": mark}}),
        ("hydra._internal.utils._locate", {"path": "os.system"}),
        ("omegaconf.OmegaConf.save", {"config": {"a": 1}, "f": mark}),
        ("functools.partial", {"_args_": ["os.system", touch]}),
        ("operator.methodcaller", {"_args_": ["system", touch]}),
        ("importlib.import_module", {"name": "antigravity"}),
        ("pinn_dyn.app.run_folder.write_config", {"folder": mark, "config": {}}),
        ("pinn_dyn.app.command.main", {"command": "train"}),
        ("pinn_dyn.app.run_folder.os.system", {"command": touch}),
        ("pinn_dyn.data.cache.os.system", {"command": touch}),
        ("pinn_dyn.data.cache.load_or_make", {"folder": mark, "name": "x"}),
        ("pinn_dyn.data.cache._write", {"path": mark, "arrays": {}, "description": 1}),
        ("pinn_dyn.data.simulation.subprocess.run", {"args": ["touch", mark]}),
        ("pinn_dyn.data.logs.source.Path.touch", {"self": mark}),
        ("pinn_dyn.evaluation.save", {"figure": 1, "path": mark}),
        ("pinn_dyn.evaluation.write_table", {"table": 1, "folder": mark, "name": "x"}),
        ("pinn_dyn.control.export_law", {"law": 1, "path": mark}),
        ("pinn_dyn.control.load_law", {"path": mark}),
        ("pinn_dyn.training.fit", {"model": 1}),
        ("pinn_dyn.systems.SoftArm.__init__.__globals__", {}),
        ("pinn_dyn.models.LagrangianNetwork.load_state_dict", {}),
        ("pinn_dyn.models.torch.save", {"obj": 1, "f": mark}),
        ("pinn_dyn.data.__class__", {}),
        ("pinn_dyn", {}),
        ("pinn_dyn.data", {}),
        ("", {}),
        (".", {}),
        ("...os.system", {"command": touch}),
        (" os.system", {"command": touch}),
        ("os.system\n", {"command": touch}),
        ("${oc.env:HOME}", {}),
        (["os", "system"], {"command": touch}),
        ({"_target_": "os.system"}, {"command": touch}),
        (7, {}),
        (None, {}),
    ]


CALLS = range(len(calls("")))


def at_the_top(config, part):
    config["dataset"] = part


def as_an_argument(config, part):
    config["dataset"]["system"]["mass"] = part


def in_a_list(config, part):
    config["dataset"]["excitation"]["parts"].append([[part]])


def in_a_model(config, part):
    config["model"]["damping"] = {**part, "_partial_": True}


def beside_all_others(config, part):
    config["nobody_reads_this"] = {"deep": {"down": [part]}}


PLACES = [at_the_top, as_an_argument, in_a_list, in_a_model, beside_all_others]


@pytest.mark.parametrize("index", CALLS, ids=[str(name) for name, _ in calls("")])
def test_nothing_foreign_is_run(tmp_path, lnn_run, index):
    """At one place of five in turn, so that every place sees a sixth of the tricks."""
    mark = tmp_path / MARK
    target, arguments = calls(str(mark))[index]
    place = PLACES[index % len(PLACES)]
    run = foreign(lnn_run, tmp_path / "run", lambda c: place(c, {"_target_": target, **arguments}))
    with pytest.raises(ConfigError, match=r"may name the classes of pinn_dyn|an expression|_args_"):
        load_run(run, "best")
    assert not mark.exists()


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("key", ["_args_", "_recursive_", "_convert_", "_call_", "__class__", 3])
def test_other_keys_of_hydra_are_refused(tmp_path, lnn_run, place, key):
    part = {"_target_": "pinn_dyn.systems.SoftArm", key: ["os.system"]}
    run = foreign(lnn_run, tmp_path / "run", lambda config: place(config, part))
    with pytest.raises(ConfigError, match="which no configuration of a run has"):
        load_run(run, "best")


@pytest.mark.parametrize("command", ["evaluate", "control", "resume", "start_from"])
def test_every_program_says_why(tmp_path, monkeypatch, capsys, lnn_run, command):
    monkeypatch.chdir(tmp_path)
    part = {"_target_": "os.mkdir", "path": str(tmp_path / MARK)}
    run = foreign(lnn_run, tmp_path / "run", lambda config: as_an_argument(config, part))
    words = {
        "evaluate": ["evaluate.py", f"runs=[{run}]"],
        "control": ["control.py", f"run={run}", "reference.q=[0,0,0]"],
        "resume": ["train.py", f"resume={run}"],
        "start_from": ["train.py", "model=lnn", f"start_from={run}", "trainer.steps=4"],
    }
    if command == "start_from":
        from tests.app.entry import TINY

        words[command][2:] = [*words[command][2:3], *TINY]
    text = " ".join(refused_text(capsys, *words[command], "hydra.run.dir=out").split())
    assert "dataset.system.mass._target_ is 'os.mkdir'" in text
    assert "trust=os" in text
    assert not (tmp_path / MARK).exists()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda c: c["dataset"].update(name="../../out"), "dataset.name"),
        (lambda c: c["dataset"].update(name=".."), "dataset.name"),
        (lambda c: c["dataset"].update(name=7), "dataset.name"),
        (lambda c: c.update(model_name="../out"), "model_name"),
        (lambda c: c["dataset"]["configurations"].update({"../x": [0, 0, 0]}), "configurations"),
        (lambda c: c["model"].update(cache="/tmp/x"), "where something is written"),
        (
            lambda c: c["callbacks"].update(
                more={"_target_": "lightning.pytorch.callbacks.ModelCheckpoint", "dirpath": "/tmp"}
            ),
            "callbacks.more.dirpath is '/tmp'",
        ),
        (
            lambda c: c["logger"].update(
                mlflow={
                    "_target_": "lightning.pytorch.loggers.MLFlowLogger",
                    "tracking_uri": "https://example.org",
                }
            ),
            "logger.mlflow.tracking_uri",
        ),
        (lambda c: c["trainer"].update(default_root_dir="/"), "trainer.default_root_dir"),
        (lambda c: c["dataset"].update(name="${oc.env:HOME}"), "an expression"),
        (lambda c: c.pop("model"), "model is None"),
        (lambda c: c.update(seed="x"), "seed is 'x'"),
        (lambda c: c["model"].update(substeps=0), "model.substeps is 0"),
        (lambda c: c["model"].update(substeps="many"), "model.substeps is 'many'"),
        (lambda c: c["model"].update(nothing=1), "takes no 'nothing'"),
    ],
)
def test_what_leads_out_of_the_folder_or_fits_nothing_is_refused(
    tmp_path, lnn_run, change, expected
):
    run = foreign(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match=expected):
        load_run(run, "best")


def test_the_folder_does_not_choose_the_cache(tmp_path, lnn_run):
    elsewhere = str(tmp_path / "elsewhere")
    run = foreign(lnn_run, tmp_path / "run", lambda c: c["dataset"].update(cache=elsewhere))
    assert "cache" not in load_run(run, "best").config["dataset"]


# --- the user's own classes -----------------------------------------------------------------------

OWN = """
import os, pathlib
from pinn_dyn.systems import SoftArm

class MyArm(SoftArm):
    pass
"""


@pytest.fixture
def my_package(tmp_path, monkeypatch):
    (tmp_path / "my_arms.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("my_package")
def test_an_own_class_is_built_where_its_package_is_trusted(tmp_path, lnn_run):
    def change(config):
        config["dataset"]["system"]["_target_"] = "my_arms.MyArm"

    run = foreign(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match="trust=my_arms"):
        load_run(run, "best")
    assert load_run(run, "best", ("my_arms",)).folder == run
    for name in ("my", "my_arm", "other"):
        with pytest.raises(ConfigError, match="may name the classes"):
            load_run(run, "best", (name,))


@pytest.mark.usefixtures("my_package")
@pytest.mark.parametrize("target", ["my_arms.os.system", "my_arms.pathlib.Path", "my_arms.SoftArm"])
def test_trust_ends_where_the_package_ends(target):
    assert not trust.may_build(target, ("my_arms",))


@pytest.mark.usefixtures("my_package")
def test_trust_is_given_on_the_command_line(tmp_path, monkeypatch, lnn_run):
    monkeypatch.chdir(tmp_path)

    def change(config):
        config["dataset"]["system"]["_target_"] = "my_arms.MyArm"
        config["trust"] = "my_arms"  # of no use there

    run = foreign(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match="trust=my_arms"):
        load_run(run, "best")
    given = ["trust=my_arms", "horizon=0.1", "windows=[]", "hydra.run.dir=out"]
    run_script("evaluate.py", f"runs=[{run}]", *given)
    assert (tmp_path / "out" / "summary.csv").is_file()


def test_everything_that_conf_names_may_be_built():
    """So a run of our own configurations is never refused."""
    found = set()
    for path in CONF.rglob("*.yaml"):
        for _, part in trust._mappings(_plain(yaml.safe_load(path.read_text())), ""):
            if "_target_" in part:
                found.add(part["_target_"])
    found.discard("pinn_dyn.app.sweep.SweepCallback")  # of Hydra, in no run's configuration
    assert len(found) > 50
    assert not [name for name in sorted(found) if not trust.may_build(name, ())]


def _plain(value):
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items() if key != "hydra"}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    return None if isinstance(value, str) and "${" in value else value


# --- damaged and hostile files --------------------------------------------------------------------

BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{','.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(20)
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (BOMB, "values once its aliases are written out"),
        ("a: &a [*a]\n", "values once its aliases are written out"),
        ("a: &a {b: *a}\n", "values once its aliases are written out"),
        ("x: " + "[" * 5000 + "]" * 5000, "30 levels deep"),
        ("x: " + "y" * 2_000_000, "expected a configuration of at most"),
        ("- a list\n", "holds no configuration"),
        ("", "holds no configuration"),
        ("1: 2\n", "holds no configuration"),
        ("a: [1, 2\n", "cannot be read"),
        ("\x00\x01\x02", "cannot be read"),
        ("x: !!python/object/apply:os.system ['true']\n", "cannot be read"),
        ("x: !!python/name:os.system\n", "cannot be read"),
        ("x: *nothing\n", "cannot be read"),
    ],
    ids=range(13),
)
def test_a_hostile_file_ends_in_a_sentence(tmp_path, text, expected):
    (tmp_path / "config.yaml").write_text(text)
    start = time.perf_counter()
    with pytest.raises(ConfigError, match=expected) as caught:
        load_run(tmp_path, "best")
    assert time.perf_counter() - start < 10
    assert str(tmp_path) in str(caught.value)


def damaged(run, folder, change):
    shutil.copytree(run, folder)
    path = folder / "checkpoints" / "best.ckpt"
    change(path)
    return folder


def flip(path):
    """One bit of a stored weight, with the archive's directory left whole."""
    data = bytearray(path.read_bytes())
    position = data.find(b"best/data/0") + 300
    data[position] ^= 0x40
    path.write_bytes(data)


def cut(path):
    path.write_bytes(path.read_bytes()[:-200])


def with_nan(path):
    saved = torch.load(path, weights_only=True)
    key = next(key for key in saved["state_dict"] if key.startswith("model."))
    saved["state_dict"][key] = torch.full_like(saved["state_dict"][key], math.nan)
    torch.save(saved, path)


def of_another_data_set(path):
    saved = torch.load(path, weights_only=True)
    saved["hyper_parameters"]["config"]["dataset"]["system"]["segments"] = 2
    torch.save(saved, path)


def of_another_model(path):
    saved = torch.load(path, weights_only=True)
    saved["hyper_parameters"]["config"]["model"]["mass"]["hidden"] = [8]
    torch.save(saved, path)


def without_parts(path):
    torch.save({"state_dict": {}}, path)


def a_pickle(path):
    torch.save({"state_dict": Path, "hyper_parameters": {}}, path)


class Path:
    """Stands for any class: with weights_only it is not even looked up."""


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (flip, "cannot be read, it may be cut short: .* has another checksum"),
        (cut, "cannot be read, it may be cut short"),
        (with_nan, "holds weights that are NaN"),
        (of_another_data_set, "another data set .*segments is 1, the checkpoint has 2"),
        (of_another_model, "another model .*mass.hidden is"),
        (without_parts, "is no checkpoint that train.py wrote"),
        (a_pickle, "cannot be read"),
        (lambda path: path.write_bytes(b""), "cannot be read"),
        (lambda path: path.unlink(), "does not exist; .* has last"),
    ],
)
def test_a_damaged_checkpoint_is_refused_by_name(tmp_path, lnn_run, change, expected):
    run = damaged(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match=expected) as caught:
        load_run(run, "best")
    assert str(run / "checkpoints" / "best.ckpt") in str(caught.value)


def test_the_comparison_comes_before_the_model_is_built(tmp_path, monkeypatch, lnn_run):
    monkeypatch.setattr(
        "pinn_dyn.app.run_folder.build_predictor", lambda *_: pytest.fail("it was built")
    )
    with pytest.raises(ConfigError, match="another model"):
        load_run(damaged(lnn_run, tmp_path / "run", of_another_model), "best")
