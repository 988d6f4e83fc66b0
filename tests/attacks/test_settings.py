"""Mistakes in a configuration: each is refused in one line that names the key."""

import pickle

import pytest
import yaml
from omegaconf import OmegaConf

from pinn_dyn.app.config import ConfigError, checked
from tests.support.composing import REQUIRED, compose

MISTAKES = {
    "train": """
        data=null
        trainer=x
        optimizer=0.1
        model={hidden: [8]}
        dataset._target_=os.system
        dataset._target_=pinn_dyn.mechanics.RK4
        model._target_=pinn_dyn.data.Chirp
        loss._target_=pinn_dyn.data.Chirp
        optimizer._target_=builtins.dict
        validator._target_=pinn_dyn.data.Chirp
        scheduler._target_=torch.optim.SGD
        trainer._target_=pinn_dyn.data.Chirp
        model.inverse_mass._target_=pinn_dyn.mechanics.RK4
        model.inverse_mass._partial_=false
        model.integrator._partial_=true
        model.integrator._partial_=3
        dataset.system._target_=pinn_dyn.data.Chirp
        dataset.excitation.parts=[3]
        callbacks.figures._target_=builtins.dict
        callbacks.more={}
        callbacks.more={_target_: pinn_dyn.data.Chirp}
        logger.tensorboard._target_=pinn_dyn.data.Chirp
        logger.tensorboard=null
        dataset.rtol=-1
        dataset.system.segments=0
        dataset.system.nodes=0
        dataset.atol=0
        dataset.duration=-1
        data.pairs=0
        data.steps=0
        data.stride=-1
        data.coverage=2
        data.batch_size=0
        optimizer.eps=-1
        optimizer.maximize=true
        optimizer.params=[1]
        scheduler.total_steps=3
        scheduler.optimizer=3
        scheduler.warm_up=2
        trainer.gradient_clip_val=0
        trainer.gradient_clip_algorithm=x
        trainer.accelerator=tpu
        trainer.accelerator=3
        trainer.precision=64-true
        trainer.precision=16-mixed
        trainer.devices=0
        trainer.devices=x
        trainer.num_nodes=0
        trainer.strategy=3
        trainer.profiler=x
        trainer.limit_val_batches=0
        trainer.fast_dev_run=true
        trainer.accumulate_grad_batches=2
        trainer.inference_mode=true
        trainer.detect_anomaly=x
        callbacks.figures.every_n_validations=0
        seed=abc
        seed=1.5
        seed=-1
        seed=true
        seed=null
        name=3
        threads=0
        ensemble=0
        ensemble=2.5
        compile=yes please
        compile=1
        start_from=3
        resume=[a]
        trust=1
        sede=1
        dataset.duration=long
        dataset.duration=nan
        dataset.duration=inf
        dataset.step=null
        dataset.train_inputs=ten
        dataset.test=1.5
        dataset.labels=x
        dataset.labels=[1,2,3]
        dataset.configurations.bent=x
        dataset.system=3
        dataset.system.segments=one
        dataset.system.mass=nan
        dataset.nothing=1
        dataset.pairing=both
        dataset.compile=maybe
        data=1
        data.pairs=1.5
        data.coverage=nan
        data.batches_per_epoch=3
        model.integrator.substeps=0
        model.integrator.substeps=half
        model.hidden=[8]
        model.angles=x
        model.angles=[a]
        model.inverse_mass=3
        model.inverse_mass.hidden=8
        model.inverse_mass.hidden=[8,x]
        model.inverse_mass.hidden=[0]
        model.inverse_mass.epsilon=small
        model.potential.quadratic=1
        loss.huber=nan
        loss.curriculum=fast
        loss.velocity_weight=x
        loss.hubber=1
        optimizer.lr=0
        optimizer.lr=-0.1
        optimizer.lr=nan
        optimizer.lr=fast
        optimizer.weight_decay=-1
        scheduler.warm_up=x
        validator.horizon=nan
        validator.horizon=0
        validator.horizon=two
        validator.window=0
        validator.step=x
        callbacks.figures.every_n_validations=x
        logger.tensorboard=1
        trainer.steps=ten
        trainer.steps=0
        trainer.validations=0
        trainer.max_epochs=3
        trainer.gradient_clip_val=x
        trainer.acelerator=cpu
        trainer.callbacks=[]
    """,
    "evaluate": """
        runs=[[a]]
        dataset=3
        dataset={_target_: os.getcwd}
        windows=[null]
        thresholds={a: {b: 1}}
        runs=3
        runs=null
        checkpoint=first
        split=train
        horizon=nan
        horizon=0
        horizon=far
        step=0
        step=x
        windows=[text]
        windows=[0]
        windows=1
        thresholds.small=x
        thresholds.small=0
        trajectory=-1
        trajectory=first
        threads=0
        horizn=1
    """,
    "control": """
        gains.force=1
        gains.velocity=-1
        reference.q=[[0.1], [x]]
        gains.position=true
        controllers.pd=3
        controllers.more={}
        controllers.more={terms: learned}
        controllers.pd.law=3
        controllers.learned.terms=both
        controllers.learned.law=3
        controllers.learned.law._target_=pinn_dyn.control.SystemPlant
        controllers.learned.law._target_=builtins.dict
        controllers.learned.observer=3
        controllers.learned.observer={}
        controllers.learned.observr={}
        reference.q=x
        reference._target_=pinn_dyn.control.SystemPlant
        reference._target_=builtins.dict
        plant=simulator
        plant={_target_: pinn_dyn.control.Regulation, _partial_: true}
        plant={_target_: os.getcwd}
        plant={_target_: pinn_dyn.control.SystemPlant, _partial_: true, rtol: -1}
        plant={_target_: pinn_dyn.control.SystemPlant, _partial_: true, system: 3}
        actuator._target_=builtins.dict
        sensor._target_=pinn_dyn.control.Actuator
        initial_states={_target_: pinn_dyn.data.Chirp}
        guard.threshold=-1
        guard.threshhold=1
        guard.fallback=stop
        export_real=half
        exported_law=[x]
        stability={}
        stability={region: a}
        stability={region: a, q_low: [x], q_high: [1], samples: 5}
        stability={region: [a], q_low: [0], q_high: [1], samples: 5}
        run=[x]
        checkpoint=none
        member=-1
        gains=3
        gains.position=x
        gains.position=nan
        duration=0
        rate=0
        rate=fast
        samples_rate=0
        initial_states=3
        initial_states={q_low: [0]}
        runs=0
        runs=[x]
        seed=x
        robot=3
        actuator=3
        actuator.low=x
        actuator.lowest=1
        sensor.q_noise=x
        delay=x
        delay=-1
        stability=3
        export=3
        settled_after=-1
        trajectory=x
        animate=1
        ruun=x
    """,
    "gather": """
        runs=[null]
        evaluations=[1]
        runs=3
        evaluations=3
        sort=3
        plot=[x]
        sorted=x
    """,
    "excite": """
        duration=0
        frequency=x
        start={a: x}
        limits.share=1.5
        limits.velocity=x
        limits.speed=1
        limits.low=[x]
        steps=0
        approach=-1
        rate=0
        model.structure.urdf=3
    """,
    "check": """
        longest_delay=0
        longest_delay=null
        longest_delay=[1]
        dataset=3
        dataset._target_=pinn_dyn.data.Chirp
        dataset.files=3
        dataset.steps=3
        dataset.guard=x
        dataset.q.unit=3
        dataset.q.columns=nan
        dataset.test=-1
        dataset.test.runs=x
        dataset.validation.piece={a: 1}
    """,
}
CASES = [
    (command, mistake.strip())
    for command, mistakes in MISTAKES.items()
    for mistake in mistakes.strip().splitlines()
]


@pytest.fixture(scope="module")
def composed():
    """Default configuration of each command, pickled because that is copied faster."""
    return {command: pickle.dumps(compose(command)) for command in REQUIRED}


@pytest.mark.parametrize(("command", "mistake"), CASES)
def test_a_mistake_is_refused_by_its_key(composed, command, mistake):
    key, _, text = mistake.partition("=")
    cfg = pickle.loads(composed[command])
    OmegaConf.update(cfg, key, yaml.safe_load(text.replace("nan", ".nan").replace("inf", ".inf")))
    with pytest.raises(ConfigError) as caught:
        checked(command, cfg)
    assert key.split(".")[-1] in str(caught.value)
