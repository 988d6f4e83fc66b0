"""Each rule of the check's advice speaks where its measurement is made so, and only there."""

import re
from dataclasses import replace

import numpy as np
import pytest

from pinn_dyn.app.config import composed
from pinn_dyn.data.logs import Butterworth, DelayCurve, LogSource, Recording
from pinn_dyn.evaluation.log_advice import Measured, advice, bandwidth

STEP = 0.01
T = np.arange(0, 40, STEP)


def recording(q, u, noise=0.0):
    noisy = q + noise * np.random.default_rng(0).normal(size=q.shape)
    return Recording("run", T, noisy, np.gradient(q, STEP, axis=0), u)


def sine(hertz, count=1):
    return np.column_stack([np.sin(2 * np.pi * hertz * T + k) for k in range(count)])


def curve(delay):
    return DelayCurve(np.zeros(3), np.ones(3), delay, 0.0, "acceleration")


class Source(LogSource):
    """Without files: the validation lasts as long as it is told."""

    validated = 5.0

    def load(self):
        class Splits:
            validation = (type("Item", (), {"t": np.array([0.0, self.validated])}),)

        return Splits


def measured(q=1, u=1, units=("rad", "Nm"), *, hertz=1.0, noise=0.0, v=True, **changes):
    named = {
        "q": dict(columns=[f"q{k}" for k in range(q)], unit=units[0]),
        "u": dict(columns=[f"u{k}" for k in range(u)], unit=units[1]),
    }
    named |= {"v": dict(columns=[f"v{k}" for k in range(q)], unit=f"{units[0]}/s")} if v else {}
    source = Source(
        name="arm",
        root=".",
        files="*",
        time=dict(columns="t", unit="s"),
        validation=dict(seconds=3.0, piece=3.0),
        test=dict(seconds=9.0, piece=3.0),
        **named,
    )
    training = [recording(sine(hertz, q), sine(hertz, u), noise)]
    given = dict(rest=0.0, outside=0.0, condition=5.0, follows=0.2, noise=np.full(q, noise))
    return Measured(source, training, STEP, [curve(0.0)] * u, **{**given, **changes})


@pytest.mark.parametrize(
    ("found", "line"),
    [
        (measured(outside=0.4), "test: {seconds: 3, blocks: 3, piece: 3.0} # 40 % of the test"),
        (measured(noise=0.005), "Butterworth, cutoff: 4.5} # noise is .* ends at 1.1 Hz"),
        (measured(u=3, units=("rad", "rad"), follows=0.9), "InputRates} # the inputs are"),
        (measured(2, 2), "model=lnn model/input=fixed: 2 inputs in Nm"),
        (measured(2, 2, ("rad", "A")), "model=lnn model/input=constant: 2 inputs in A"),
        (measured(2, 3, ("rad", "N")), "model=lnn: 3 inputs for 2 coordinates"),
        (
            measured(2, 3, ("rad", "rad"), follows=0.9),
            "rosenbrock: the positions of .* 90 %",
        ),
        (measured(2, 2, condition=2e3), "model=known .*condition 2e"),
        (measured(9, 9), "model=known .*40 s for 9 joints"),
        (measured(hertz=0.5), "data.stride=8 data.steps=10: 80 ms a step.* of 0.62 Hz"),
        (measured(), "data.pairs=all: the training has 4000 samples"),
        (measured(rest=0.7), "data.coverage=0.5: the robot rests 70 %"),
        (measured(v=False), "loss.velocity_weight=0.1: the log has no v"),
    ],
    ids=lambda x: x[:24] if isinstance(x, str) else "",
)
def test_a_rule_gives_its_line_with_the_measurement(found, line):
    assert re.search(line.replace("{", r"\{"), advice(found)), advice(found)


def test_what_is_as_it_should_be_needs_no_line():
    text = advice(measured())
    for word in ("test:", "steps:", "coulomb", "coverage", "velocity_weight", "horizon", "angles"):
        assert word not in text
    filtered = measured(noise=0.005)
    filtered.source.steps["filter"] = Butterworth(4.0)
    assert "Butterworth" not in advice(filtered)


def test_delays_that_differ_are_shifted_and_one_may_be_learned():
    found = measured(2, 2)
    both = advice(replace(found, delays=[curve(0.031), curve(0.02)]))
    assert "InputDelay, delay: [0.03, 0.02]} # the inputs act" in both
    assert "learned" not in both
    one = advice(replace(found, delays=[curve(0.03), curve(0.03)]))
    assert "model/delay=learned model.delay.initial=0.03 model.delay.longest=0.1" in one


def test_a_robot_that_rests_while_it_is_driven_has_dry_friction():
    q = np.maximum(np.abs(sine(1.0)) - 0.5, 0.0)
    found = replace(measured(), training=[recording(q, sine(1.0))])
    assert "model/friction=coulomb: the robot rests in 3" in advice(found)


def test_a_joint_that_turns_around_is_an_angle():
    found = replace(measured(), training=[recording(4 * sine(1.0), sine(1.0))])
    assert "'model.angles=[0]': q0 [rad] turns" in advice(found)


def test_a_short_validation_takes_a_short_horizon():
    found = measured()
    found.source.validated = 1.5
    assert "validator.horizon=1.5: " in advice(found)


def test_the_band_of_a_motion_is_found_below_its_noise():
    found = [recording(sine(1.0) + 0.1 * sine(3.0), sine(1.0), noise=0.02)]
    assert bandwidth(found, STEP, np.array([0.02])) == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize(
    "found",
    [
        measured(2, 2, v=False, rest=0.7),
        measured(2, 3, ("rad", "rad"), follows=0.9),
        measured(2, 2, ("rad", "A")),
        measured(2, 2, condition=2e3),
    ],
    ids=["forces", "tendons", "drives", "known"],
)
def test_the_commands_compose(found, tmp_path):
    commands = [x.split() for x in advice(found).splitlines() if x.startswith("# python train")]
    assert len(commands) == 2
    for _, _, script, *words in commands:
        assert script == "train.py"
        words = [x.strip("'") for x in words if not x.startswith("dataset=")]
        words = ["dataset=example_log", "model_name=arm", *words]
        assert composed("train", words)["model"]["_target_"]
