"""The box from which initial states are drawn."""

import numpy as np

from pinn_dyn.data import InitialStates

BOX = dict(q_low=[-1.0, -1.0, 0.1], q_high=[1.0, 1.0, 0.4], v_max=[1.0, 1.0, 0.1])


def test_initial_states_fill_their_box():
    box = InitialStates(**BOX)
    q, v = box.draw(500, np.random.default_rng(0))
    low, high, v_max = (np.array(BOX[key]) for key in ("q_low", "q_high", "v_max"))
    assert ((q >= low) & (q <= high)).all()
    assert (np.abs(v) <= v_max).all()
    assert (np.ptp(q, axis=0) > 0.95 * (high - low)).all()
    assert (np.ptp(v, axis=0) > 0.95 * 2 * v_max).all()
