"""Mistakes in a configuration: each is refused in one line that names the key."""

import pickle

import pytest
import yaml
from omegaconf import OmegaConf

from pinn_dyn.app.config import checked
from pinn_dyn.run.configuration.validation import ConfigError
from tests.support.composing import REQUIRED, compose

# What the generated values below do not try: limits, keys of the program, code, values in lists.
MISTAKES = {
    "train": """
        optimizer._target_=builtins.dict
        scheduler._target_=torch.optim.SGD
        model.integrator._partial_=true
        dataset.excitation.parts=[3]
        dataset.system.segments=0
        dataset.rtol=-1
        data.pairs=1.5
        data.steps=0
        data.coverage=2
        model.angles=[a]
        model.inverse_mass.hidden=[8,x]
        loss.huber=nan
        loss.curriculum=fast
        optimizer.lr=0
        optimizer.weight_decay=-1
        scheduler.warm_up=2
        validator.horizon=0
        callbacks.more={_target_: pinn_dyn.data.Chirp}
        trainer.steps=0
        trainer.precision=16-mixed
        trainer.devices=0
        seed=-1
        compile=1
        resume=[a]
        trust=1
    """,
    "evaluate": """
        runs=[[a]]
        dataset={_target_: os.getcwd}
        split=train
        step=0
        windows=[0]
        thresholds={a: {b: 1}}
        thresholds.small=0
    """,
    "control": """
        gains.velocity=-1
        reference.q=[[0.1], [x]]
        controllers.more={terms: learned}
        controllers.learned.terms=both
        plant={_target_: pinn_dyn.control.Regulation, _partial_: true}
        plant={_target_: pinn_dyn.control.SystemPlant, _partial_: true, rtol: -1}
        plant={_target_: pinn_dyn.control.SystemPlant, _partial_: true, system: 3}
        guard.threshold=-1
        duration=0
        actuator.low=x
        dead_time=-1
    """,
    "gather": "evaluations=[1]",
    "excite": """
        duration=0
        limits.share=1.5
        approach=-1
        start={a: x}
    """,
    "check": """
        longest_delay=0
        longest_delay=[1]
        dataset.q.unit=3
        dataset.test=-1
        dataset.validation.piece={a: 1}
    """,
}
# Mappings with names of the user.
FREE = ("logger.tensorboard.zzz", "robot.zzz", "start", "thresholds.zzz")


@pytest.fixture(scope="module")
def composed():
    """Default configuration of each command, pickled because that is copied faster."""
    return {command: pickle.dumps(compose(command)) for command in REQUIRED}


def places(node, path=""):
    """Yield the path and value of every entry, parts before their entries."""
    for key, value in node.items():
        yield f"{path}{key}", value
        if isinstance(value, dict):
            yield from places(value, f"{path}{key}.")


def wrong_values(config):
    """Yield a path with a value that cannot be right for each entry, and a key that none has."""
    for path, value in places(config):
        if isinstance(value, dict):
            yield f"{path}.zzz", 1
            yield path, 3
            if "_target_" in value:
                yield f"{path}._target_", "pinn_dyn.data.Chirp"
        elif not path.endswith("_"):
            yield path, {"zzz": 1}
            yield path, float("nan")


def accepted(command, pickled, mistakes):
    """Return the mistakes that are accepted, or refused without the key."""
    found = []
    for path, value in mistakes:
        cfg = pickle.loads(pickled)
        OmegaConf.update(cfg, path, value, merge=path.endswith("zzz"))
        try:
            checked(command, cfg)
        except ConfigError as error:
            if path.removesuffix("._target_").split(".")[-1] in str(error):
                continue
            found.append(f"{path}={value}: {error}")
        else:
            found.append(f"{path}={value}")
    return found


@pytest.mark.parametrize("command", MISTAKES)
def test_mistakes_are_refused_by_their_keys(composed, command):
    pairs = [line.strip().partition("=") for line in MISTAKES[command].strip().splitlines()]
    mistakes = [(path, yaml.safe_load(text.replace("nan", ".nan"))) for path, _, text in pairs]
    assert not accepted(command, composed[command], mistakes)


@pytest.mark.parametrize("command", MISTAKES)
def test_every_entry_refuses_values_that_cannot_be_right(composed, command):
    config = OmegaConf.to_container(pickle.loads(composed[command]), resolve=True)
    mistakes = [(path, value) for path, value in wrong_values(config) if path not in FREE]
    assert len(mistakes) > 5
    assert not accepted(command, composed[command], mistakes)
