"""Every data source keeps the contract, a user's own of a few lines too."""

from pathlib import Path

import numpy as np
import pytest
import torch

from pinn_dyn.data import (
    DataSource,
    InitialStates,
    MultiSine,
    RobotSource,
    SimulatedSource,
    Splits,
    StoredSource,
    TorqueMultiSine,
    store,
)
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.systems import MujocoArm, SoftArm
from pinn_dyn.testing import DataSourceContract
from tests.data.logs_files import motion, source, write
from tests.support.contracts import one_case
from tests.support.simulated_arms import SPATIAL


@one_case
class TestSimulatedSource(DataSourceContract):
    @pytest.fixture(scope="class")
    def cache(self, tmp_path_factory):
        return tmp_path_factory.mktemp("cache")

    def make(self, cache, **changes):
        arguments = dict(
            name="arm",
            system=SoftArm(),
            excitation=MultiSine([0.0, 0.0, -1.0], [0.5, 0.5, 0.1]),
            initial_states=InitialStates([-0.5, -0.5, 0.1], [0.5, 0.5, 0.2], [0.1, 0.1, 0.1]),
            duration=0.1,
            step=0.01,
            train_initial_states=2,
            train_inputs=1,
            validation=1,
            test=1,
            seed=0,
            rtol=1e-6,
            atol=1e-7,
            cache=str(cache),
            labels=["x [rad]", "y [rad]", "l [m]"],
            input_labels=["a [Nm]", "b [Nm]", "c [N]"],
            configurations={"straight": [0.0, 0.0, 0.2]},
        )
        return SimulatedSource(**{**arguments, **changes})

    @pytest.fixture
    def source(self, cache):
        return self.make(cache)

    @pytest.fixture
    def again(self, cache):
        return self.make(cache)

    @pytest.fixture
    def changed(self, cache):
        return self.make(cache, keep_every=2)


@one_case
class TestRobotSource(DataSourceContract):
    @pytest.fixture(scope="class")
    def cache(self, tmp_path_factory):
        return tmp_path_factory.mktemp("cache")

    def make(self, cache, seed=0):
        pytest.importorskip("mujoco", reason="the mujoco extra is not installed")
        return RobotSource(
            name="spatial",
            system=MujocoArm(SPATIAL, v_max=3.0, u_max=20.0),
            excitations=[
                TorqueMultiSine(frequency=[0.1, 1.0], harmonics=2, amplitude=0.2, reach=0.5)
            ],
            duration=0.05,
            step=0.001,
            train=1,
            validation=1,
            test=1,
            seed=seed,
            cache=str(cache),
        )

    @pytest.fixture
    def source(self, cache):
        return self.make(cache)

    @pytest.fixture
    def again(self, cache):
        return self.make(cache)

    @pytest.fixture
    def changed(self, cache):
        return self.make(cache, seed=1)


@one_case
class TestLogSource(DataSourceContract):
    @pytest.fixture
    def source(self, tmp_path):
        write(tmp_path, motion())
        return source(tmp_path, angles=[1])

    @pytest.fixture
    def again(self, tmp_path):
        return source(tmp_path, angles=[1])

    @pytest.fixture
    def changed(self, tmp_path):
        return source(tmp_path, guard=0.6)


class Swings(DataSource):
    """All that a source of one's own needs: attributes, and trajectories in memory."""

    name = "swings"
    labels = ("angle [rad]",)
    input_labels = ("torque [Nm]",)

    def __init__(self, rate=2.0):
        self.rate = rate

    def load(self):
        t = torch.arange(100, dtype=torch.float64) / 50

        def swing(k):
            phase = self.rate * t + k
            a = -(self.rate**2) * phase.sin()
            return Trajectory(
                phase.sin()[:, None], self.rate * phase.cos()[:, None], Signal(t, a[:, None])
            )

        return Splits([swing(0), swing(1)], [swing(2)], [swing(3)])


@one_case
class TestOwnSource(DataSourceContract):
    @pytest.fixture
    def source(self):
        return Swings()

    @pytest.fixture
    def again(self):
        return Swings()

    @pytest.fixture
    def changed(self):
        return Swings(rate=np.pi)


class TestStoredSource(DataSourceContract):
    """It stands for the source whose trajectories it keeps."""

    def make(self, source, folder):
        path = folder / f"{source.rate}.pt"
        store(source, path)
        return StoredSource(str(path), source.name, source.labels, source.input_labels)

    @pytest.fixture
    def source(self, tmp_path):
        return self.make(Swings(), tmp_path)

    @pytest.fixture
    def again(self, tmp_path):
        return self.make(Swings(), tmp_path)

    @pytest.fixture
    def changed(self, tmp_path):
        return self.make(Swings(rate=np.pi), tmp_path)

    def test_the_numbers_are_those_of_the_other_source(self, source):
        for split in ("train", "validation", "test"):
            pairs = zip(getattr(source.load(), split), getattr(Swings().load(), split), strict=True)
            for one, other in pairs:
                for name in ("t", "q", "v", "u"):
                    assert torch.equal(getattr(one, name), getattr(other, name))

    def test_a_file_that_is_cut_short_or_gone_is_named(self, source):
        content = Path(source.path).read_bytes()
        Path(source.path).write_bytes(content[: len(content) // 2])
        with pytest.raises(ValueError, match=r"2\.0\.pt, the data .*, cannot be read"):
            source.load()
        Path(source.path).unlink()
        with pytest.raises(ValueError, match=r"No such file"):
            source.load()
