"""Run folders from strangers: nothing that their configurations name is run, or written to."""

import pytest

from pinn_dyn.run.configuration.validation import ConfigError
from pinn_dyn.run.run_folder import load_run
from tests.support.foreign_runs import foreign

MARK = "was_here"


def calls(mark):
    """Return ways to leave the mark, each a ``_target_`` with its arguments."""
    touch = f"touch {mark}"
    code = f"open({mark!r}, 'w')"
    return [
        ("os.system", {"command": touch}),
        ("os.mkdir", {"path": mark}),
        ("subprocess.run", {"args": ["touch", mark]}),
        ("builtins.exec", {"_args_": [code]}),
        ("builtins.open", {"file": mark, "mode": "w"}),
        ("builtins.__import__", {"name": "antigravity"}),
        ("pathlib.Path.touch", {"self": {"_target_": "pathlib.Path", "_args_": [mark]}}),
        ("shutil.rmtree", {"path": mark}),
        ("numpy.load", {"file": mark, "allow_pickle": True}),
        ("torch.load", {"f": mark, "weights_only": False}),
        ("lightning.pytorch.callbacks.os.system", {"command": touch}),
        ("lightning.pytorch.callbacks.LambdaCallback", {"setup": {"_target_": "os.system"}}),
        ("hydra.utils.instantiate", {"config": {"_target_": "os.mkdir", "path": mark}}),
        ("functools.partial", {"_args_": ["os.system", touch]}),
        ("pinn_dyn.run.run_folder.write_config", {"folder": mark, "config": {}}),
        ("pinn_dyn.data.logs.source.Path.touch", {"self": mark}),
        ("pinn_dyn.systems.SoftArm.__init__.__globals__", {}),
        (".", {}),
        ("${oc.env:HOME}", {}),
        (["os", "system"], {"command": touch}),
        ({"_target_": "os.system"}, {"command": touch}),
        (None, {}),
    ]


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


@pytest.mark.parametrize("place", range(len(PLACES)), ids=[place.__name__ for place in PLACES])
def test_nothing_foreign_is_run(tmp_path, lnn_run, place):
    """Each place sees a fifth of the tricks."""
    mark = tmp_path / MARK
    for number, (target, arguments) in enumerate(calls(str(mark))[place :: len(PLACES)]):
        part = {"_target_": target, **arguments}
        run = foreign(lnn_run, tmp_path / f"{number}", lambda c, x=part: PLACES[place](c, x))
        message = r"may name the classes of pinn_dyn|an expression|_args_"
        with pytest.raises(ConfigError, match=message):
            load_run(run, "best")
        assert not mark.exists(), target


@pytest.mark.parametrize(
    ("place", "key"),
    zip(
        [*PLACES, at_the_top],
        ["_args_", "_recursive_", "_convert_", "_call_", "__class__", 3],
        strict=True,
    ),
)
def test_other_keys_of_hydra_are_refused(tmp_path, lnn_run, place, key):
    part = {"_target_": "pinn_dyn.systems.SoftArm", key: ["os.system"]}
    run = foreign(lnn_run, tmp_path / "run", lambda config: place(config, part))
    with pytest.raises(ConfigError, match="which no configuration of a run has"):
        load_run(run, "best")


CHANGES = [
    (lambda c: c["dataset"].update(name="../../out"), "dataset.name"),
    (lambda c: c["dataset"].update(name=".."), "dataset.name"),
    (lambda c: c.update(model_name="../out"), "model_name"),
    (lambda c: c["dataset"]["configurations"].update({"../x": [0, 0, 0]}), "configurations"),
    (lambda c: c["model"].update(cache="/tmp/x"), "where something is written"),
    (
        lambda c: c["callbacks"].update(
            more={"_target_": "lightning.pytorch.callbacks.ModelCheckpoint", "dirpath": "/tmp"}
        ),
        "callbacks.more.dirpath is '/tmp'",
    ),
    (lambda c: c["logger"]["tensorboard"].update(version="../x"), "logger.tensorboard.version"),
    (lambda c: c["trainer"].update(default_root_dir="/"), "trainer.default_root_dir"),
    (lambda c: c["dataset"].update(name="${oc.env:HOME}"), "the expression"),
    (lambda c: c["model"]["integrator"].update(substeps=0), "integrator.substeps is 0"),
    (lambda c: c["model"].update(nothing=1), "no key 'model.nothing'"),
]


@pytest.mark.parametrize(("change", "message"), CHANGES)
def test_what_leads_out_of_the_folder_or_fits_nothing_is_refused(
    tmp_path, lnn_run, change, message
):
    run = foreign(lnn_run, tmp_path / "run", change)
    with pytest.raises(ConfigError, match=message):
        load_run(run, "best")


def test_the_folder_does_not_choose_the_cache(tmp_path, lnn_run):
    elsewhere = str(tmp_path / "elsewhere")
    run = foreign(lnn_run, tmp_path / "run", lambda c: c["dataset"].update(cache=elsewhere))
    assert "cache" not in load_run(run, "best").config["dataset"]
