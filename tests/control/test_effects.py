"""Actuator limits and sensor noise."""

import numpy as np
import pytest
import torch

from pinn_dyn.control.effects import Sensor


def test_noise_has_the_standard_deviations_asked_for_and_is_independent():
    sensor = Sensor(q_noise=[0.1, 0.0], v_noise=2.0, seed=3)
    q, v = torch.ones(20_000, 2, dtype=torch.float64), torch.zeros(20_000, 2, dtype=torch.float64)
    q_measured, v_measured = sensor(q, v)
    noise = (q_measured - q).numpy()
    assert noise[:, 0].std() == pytest.approx(0.1, rel=0.03)
    assert noise[:, 0].mean() == pytest.approx(0.0, abs=0.004)
    assert not noise[:, 1].any()
    np.testing.assert_allclose(v_measured.std(0), 2.0, rtol=0.03)
    together = np.corrcoef(np.concatenate([noise[:, :1], v_measured], 1).T)
    np.testing.assert_allclose(together, np.eye(3), atol=0.03)


def test_noise_starts_again_after_a_reset_and_goes_on_without():
    sensor = Sensor(q_noise=1.0, seed=1)
    zero = torch.zeros(1, 2)
    first, second = sensor(zero, zero)[0], sensor(zero, zero)[0]
    sensor.reset()
    assert torch.equal(sensor(zero, zero)[0], first)
    assert not torch.equal(first, second)
    assert not torch.equal(Sensor(q_noise=1.0, seed=2)(zero, zero)[0], first)
