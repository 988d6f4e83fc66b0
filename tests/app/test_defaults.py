"""One set of defaults: the command line trains each model as Python does."""

import inspect
import pkgutil
from functools import partial

import pytest
import torch

import pinn_dyn
from pinn_dyn.app.config import CONF, composed
from pinn_dyn.models import (
    KnownAndNetwork,
    KnownMechanics,
    KnownSystem,
    NextStateMLP,
    NoFriction,
)
from pinn_dyn.run.configuration.build import built, described
from pinn_dyn.run.run_folder import with_structures
from pinn_dyn.systems import RigidChain, SoftArm, TendonArm
from pinn_dyn.training import SOAP, LeastSquares
from tests.app.entry import ROOT

ARM = str(ROOT / "examples" / "emps.urdf")
GUESS = SoftArm(mass=1.0, stiffness=10.0, damping=1.0)
MODELS = sorted(path.stem for path in (CONF / "model").glob("*.yaml"))
KNOWN = partial(KnownMechanics, structure=RigidChain(ARM))
BUILDERS = {
    "known": KNOWN,
    "known_and_network": partial(KnownAndNetwork, known=KNOWN),
    "known_system": partial(KnownSystem, structure=GUESS),
}
"""The models with a structure, whose builders are no names."""
STRUCTURES = {
    "known": [f"model.structure.urdf={ARM}"],
    "known_and_network": [f"model.known.structure.urdf={ARM}"],
}
LEAST_SQUARES = ("known", "known_system")
COMPARED = ("seed", "compile", "threads", "trainer", "model")
COMPARED += ("data", "loss", "optimizer", "scheduler", "validator")


def completed(part):
    """A description whose objects have all arguments of their constructors."""
    if isinstance(part, list):
        return [completed(item) for item in part]
    if not isinstance(part, dict):
        return part
    values = {k: x for k, x in part.items() if k not in ("_target_", "_partial_")}
    target = pkgutil.resolve_name(part["_target_"]) if "_target_" in part else None
    if target is not None:
        arguments = inspect.signature(target).parameters
        usual = {k: p.default for k, p in arguments.items() if p.default is not p.empty}
        values = {**described(usual), **values}
    if values.get("integrator", 0) is None:
        values["integrator"] = {"_target_": "pinn_dyn.mechanics.RK4"}
    return {"class": target, **{k: completed(x) for k, x in values.items()}}


def of_python(monkeypatch, source, model, **arguments):
    """The configuration that Python records, without a training."""
    configs = []

    def stop(folder, config, overwrite):
        configs.append(config)
        raise InterruptedError

    monkeypatch.setattr("pinn_dyn.run.training.train.claimed", stop)
    monkeypatch.setattr(
        "pinn_dyn.run.training.known_data.turning", lambda source: []
    )  # needs no data
    with pytest.raises(InterruptedError):
        pinn_dyn.train(source, model, **arguments)
    (config,) = configs
    return config


def assert_equal_parts(found, expected):
    for name in COMPARED:
        assert completed(found[name]) == completed(expected[name]), name


@pytest.mark.parametrize("dataset", ["soft_arm_1", "emps"])
@pytest.mark.parametrize("model", MODELS)
def test_the_command_line_and_python_train_alike(monkeypatch, model, dataset):
    words, arguments = [f"dataset={dataset}", f"model={model}", "model_name=x"], {}
    if model in LEAST_SQUARES:
        words.append("optimizer=least_squares")
        arguments = {"optimizer": LeastSquares()}
    config = composed("train", [*words, *STRUCTURES.get(model, [])])
    config["trainer"].pop("_target_")
    if model == "known_system":  # with numbers for each segment, as Python describes it
        config["model"]["structure"] = described(built(config["model"]["structure"]))
    monkeypatch.setattr(
        "pinn_dyn.run.training.train.match_model", lambda model, source: (model, {})
    )
    builder = BUILDERS.get(model, model)
    recorded = of_python(monkeypatch, pinn_dyn.dataset(dataset), builder, **arguments)
    assert_equal_parts(with_structures(config), recorded)


@pytest.mark.parametrize("dataset", ["soft_arm_1", "emps"])
def test_named_parts_have_the_settings_of_the_command_line(monkeypatch, dataset):
    """The other loss and optimizer; windows as of a log are those of a log."""
    words = [f"dataset={dataset}", "model=lnn", "loss=midpoint", "optimizer=soap", "model_name=x"]
    config = composed("train", words)
    config["trainer"].pop("_target_")
    source = pinn_dyn.dataset(dataset)
    assert_equal_parts(
        config, of_python(monkeypatch, source, "lnn", loss="midpoint", optimizer=SOAP)
    )
    as_log = composed("train", ["dataset=soft_arm_1", "data=multi_step", "model_name=x"])
    on_log = composed("train", ["dataset=emps", "model_name=x"])
    for name in ("data", "trainer"):
        assert as_log[name] == on_log[name], name


def test_settings_of_a_caller_are_kept_and_the_others_are_the_defaults(monkeypatch):
    """Steps determine the validations, as on the command line."""
    chain = RigidChain(ARM)
    model = partial(KnownMechanics, structure=chain, friction=NoFriction)
    source = pinn_dyn.dataset("emps")
    config = of_python(monkeypatch, source, model, steps=52, trainer={"accelerator": "gpu"})
    assert config["model"]["friction"]["_target_"] == "pinn_dyn.models.NoFriction"
    words = ["dataset=emps", "trainer.steps=52", "trainer.accelerator=gpu", "model_name=x"]
    expected = composed("train", words)["trainer"]
    assert {k: x for k, x in expected.items() if k != "_target_"} == config["trainer"]
    assert (config["trainer"]["validations"], config["trainer"]["gradient_clip_val"]) == (13, 1.0)
    model = partial(NextStateMLP, hidden=[8])
    config = of_python(monkeypatch, source, model)
    assert config["model"]["activation"] == "silu"


@pytest.mark.parametrize("robot", [SoftArm(2, mass=[0.2, 0.3]), TendonArm(2, tendons=4)], ids=repr)
def test_a_robot_is_built_again_from_its_description(robot):
    again = built(described(robot))
    assert described(again) == described(robot)
    for name, value in robot.named_buffers():
        torch.testing.assert_close(again.get_buffer(name), value, rtol=0, atol=0)
