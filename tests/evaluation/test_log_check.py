"""The check of a log: measurements with verdicts, and the two steps that it measures."""

import functools
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import pinn_dyn
from pinn_dyn.data.bandwidth import bandwidth
from pinn_dyn.data.logs import Butterworth, LogSource, MovingAverage, Recording
from pinn_dyn.log_check import figures
from pinn_dyn.log_check.averages import white_noise
from pinn_dyn.log_check.check import check, verdict
from pinn_dyn.log_check.delay import DelayCurve
from pinn_dyn.models import CoulombFriction
from pinn_dyn.wording import command_line
from tests.support.delayed_robots import resting

RATE = 100.0


def driven(delay=0.0, noise=0.0, seconds=60.0, seed=0, held=False):
    """Two masses on springs that random forces move, as a data frame."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    fine = np.arange(-2.0, seconds + 1, 0.001)
    table = {"t": t}
    for k in (1, 2):
        knots = rng.normal(size=round((seconds + 4) / 0.2))
        force = np.interp(fine, -2.0 + 0.2 * np.arange(len(knots)), knots)
        times = np.floor(fine * RATE + 1e-6) / RATE if held else fine - delay
        acting = np.interp(times, fine, force)
        q, v, motion = 0.0, 0.0, []
        for f in acting:
            v += 0.001 * (4 * f - 3 * q - 0.8 * v)
            q += 0.001 * v
            motion.append(q)
        table[f"q{k}"] = np.interp(t, fine, motion) + noise * rng.normal(size=len(t))
        table[f"u{k}"] = np.interp(t, fine, force)
    return pd.DataFrame(table)


def settings(frame):
    return dict(
        files=frame,
        time=dict(columns="t", unit="s"),
        q=dict(columns=["q1", "q2"], unit="m"),
        u=dict(columns=["u1", "u2"], unit="N"),
        validation=dict(seconds=4.0, piece=2.0),
        test=dict(seconds=8.0, piece=4.0),
    )


def checked(frame, **changes):
    return check(LogSource(**{"name": "masses", **settings(frame), **changes}))


@pytest.fixture(scope="module")
def good():
    return driven(noise=1e-5)


def options(result):
    """Options of a training with a Lagrangian network."""
    return [x for _, parts in result.candidates for x in parts if x.startswith("model/")]


def verdicts(result):
    return {(x.name, x.place): x.verdict for x in result.measurements}


def test_a_good_log_has_no_warning_and_no_step_to_add(good, tmp_path):
    result = checked(good)
    assert set(verdicts(result).values()) == {"ok"}
    assert not result.problems
    assert result.block == ""
    assert "a training makes sense" in str(result)
    page = result.save(tmp_path, "python check.py")
    assert page.stat().st_size > 20_000
    saved = (tmp_path / "measurements.csv").read_text()
    assert saved.startswith("verdict,measurement,of,value,expected,explanation,docs")
    assert (tmp_path / "log_report.md").is_file()


def test_a_delay_is_measured_warned_of_and_given_as_a_step():
    result = checked(driven(delay=0.05, noise=1e-5))
    assert [x.delay for x in result.delays] == pytest.approx([0.05, 0.05], abs=0.006)
    assert verdicts(result)["delay [ms]", "u1"] == "warning"
    assert result.delay == pytest.approx(0.05, abs=0.006)
    again = checked(driven(delay=0.05, noise=1e-5), delay=result.delay)
    assert again.delay is None


def test_forces_that_a_controller_holds_get_the_interpolation_of_the_data_set(language):
    frame = driven(noise=1e-5, held=True)
    result = checked(frame)
    if language == "yaml":
        entries = yaml.safe_load(result.block)
    else:
        entries = eval(f"dict({result.block}\n)")
    assert entries == {"interpolation": "hold"}
    assert checked(frame, **entries).block == ""


@pytest.mark.parametrize(("dry", "late"), [(0.3, 0), (0.0, 3), (0.3, 3)])
def test_joints_that_rest_in_turn_get_their_friction_and_no_false_delay(dry, late):
    item = resting(dry, late=late)
    columns = {"t": item.t} | {f"q{k + 1}": item.q[:, k] for k in range(2)}
    columns |= {f"u{k + 1}": item.u[:, k] for k in range(2)}
    result = checked(pd.DataFrame(columns))
    # A held torque acts half a sample of 5 ms later.
    assert (result.delay is not None) == (late > 0)
    assert np.resize(result.delay or 0.0175, 2) == pytest.approx([0.0175] * 2, abs=0.003)
    assert options(result) == (["model/friction=coulomb"] if dry else [])
    shares = result.inputs["dry friction"].to_numpy()
    assert shares == pytest.approx(dry / item.u.std(axis=0), abs=0.03)


def test_no_filter_smears_dry_friction_where_v_is_measured():
    item, rng = resting(0.3), np.random.default_rng(0)
    columns = {"t": item.t}
    for k in range(2):
        columns[f"q{k + 1}"] = item.q[:, k] + 1e-3 * rng.normal(size=len(item.t))
        columns[f"v{k + 1}"] = np.gradient(item.q[:, k], item.t)
        columns[f"u{k + 1}"] = item.u[:, k]
    frame = pd.DataFrame(columns)
    for v in (None, dict(columns=["v1", "v2"], unit="m/s")):
        result = checked(frame, v=v)
        assert options(result)
        assert any("Butterworth" in x for x in result.steps) == (v is None)


def test_the_options_of_a_training_are_a_model_in_python():
    item = resting(0.3)
    columns = {f"{x}{k + 1}": y[:, k] for x, y in (("q", item.q), ("u", item.u)) for k in range(2)}
    (advice,) = checked(pd.DataFrame({"t": item.t, **columns})).advice
    text = advice.partition(": ")[2]
    model = eval(f"dict({text})", {"functools": functools, "pinn_dyn": pinn_dyn})["model"]
    assert model.keywords == {"friction": CoulombFriction}


def test_the_block_to_copy_extends_the_data_set(language):
    frame = driven(delay=0.05, noise=0.005)
    for steps in ({}, {"first": MovingAverage(3)}):
        result = checked(frame, steps=steps)
        text = "name: masses\n" + ("steps:\n  first: {window: 3}\n" if steps else "")
        if language == "yaml":
            entries = yaml.safe_load(f"{text}{result.block}\n")
        else:  # arguments, or behind the steps that there are
            block = result.block.replace("delay", "), delay") if steps else result.block
            text = f"dict({'cleaning=dict(first=1,' if steps else ''}\n{block}\n)"
            entries = eval(text, {"pinn_dyn": pinn_dyn})
            entries["steps"] = entries.pop("cleaning")
        assert entries["delay"] == result.delay
        assert len(entries.get("steps", {})) == 1


def test_noise_is_measured_and_gives_a_filter_above_the_motion():
    result = checked(driven(noise=0.005))
    assert result.coordinates["noise of q"].to_numpy() == pytest.approx([0.005] * 2, rel=0.1)
    (line,) = [x for x in result.steps if "Butterworth" in x]
    cutoff = float(line.split("cutoff=")[1].split(")")[0])
    assert 2.0 < cutoff < 20.0
    again = checked(driven(noise=0.005), steps={"smooth": Butterworth(cutoff)})
    assert not any("Butterworth" in x for x in again.steps)


def test_inputs_of_another_robot_stop_a_training(good):
    other = driven(noise=1e-5, seed=5)
    result = checked(good.assign(u1=other["u1"], u2=other["u2"]))
    assert "the inputs explain" in result.problems[0]
    assert result.table()["verdict"].iloc[0] == "stop"
    assert "a training makes no sense" in str(result)


def test_a_test_outside_the_training_is_warned_of(good):
    far = good.copy()
    far.loc[len(far) - 800 :, "q1"] += 3.0
    result = checked(far)
    assert verdicts(result)["test outside", "q1 [m]"] == "warning"


@given(st.floats(1e-6, 1e2), st.floats(0.2, 2.0))
def test_white_noise_is_measured_beside_a_smooth_motion(size, frequency):
    t = np.arange(4000) / RATE
    noise = np.random.default_rng(0).normal(size=t.shape)
    x = 10 * size * np.sin(frequency * t) + size * noise
    assert white_noise(x[:, None])[0] == pytest.approx(size, rel=0.15)


def test_the_bandwidth_is_where_the_motion_ends():
    t = np.arange(6000) / RATE
    q = np.sin(2 * np.pi * 4.0 * t) + 1e-4 * np.random.default_rng(0).normal(size=t.shape)
    item = Recording("run", t, q[:, None], None, q[:, None])
    assert bandwidth([item.q], 1 / RATE, np.array([1e-4])) == pytest.approx(4.0, abs=0.3)


def servo_arm(gain=60.0, *, late=0, seconds=30.0, seed=0):
    """Two joints that follow slow targets by position servos; the second rests at first."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE)) / RATE
    table, lag = {"t": t}, late / RATE
    for k in (1, 2):
        frequency, phase = rng.uniform(0.1, 0.8, 4), rng.uniform(0, 6, 4)

        def target(x, frequency=frequency, phase=phase):
            return 0.3 * np.sin(np.outer(x, frequency) * 6.28 + phase).sum(axis=1)

        fine = np.arange(-1, seconds, 0.001)
        q, v, motion = 0.0, 0.0, []
        for u in target(fine - lag):
            v += 0.001 * (gain * (u - q) - 14 * v - 5 * np.sin(q) - 0.2 * np.tanh(v / 0.01))
            q += 0.001 * v
            motion.append(q)
        table[f"q{k}"] = np.interp(t, fine, motion) + 1e-4 * rng.normal(size=len(t))
        table[f"u{k}"] = target(t)
    return pd.DataFrame(table)


@pytest.mark.parametrize("settings", [{}, {"late": 6}, {"gain": 400.0}])
def test_targets_of_servos_are_told_from_forces(settings):
    signals = {name: dict(columns=[f"{name}1", f"{name}2"], unit="rad") for name in "qu"}
    result = checked(servo_arm(**settings), **signals)
    # Servos with light joints are stiff: RK4 diverges at the usual sample times.
    assert {"model/input=servo", "model/integrator=rosenbrock"} <= set(options(result))
    assert result.delay is None
    assert not [text for text in result.warnings if "acts" in text]
    torques = signals | {"u": dict(columns=["u1", "u2"], unit="Nm")}
    assert "model/input=servo" not in options(checked(servo_arm(**settings), **torques))


def test_inputs_in_the_unit_of_the_coordinates_are_no_targets_if_the_robot_does_not_follow():
    """Motors of tendons, or torques without a unit."""
    signals = {name: dict(columns=[f"{name}1", f"{name}2"], unit="m") for name in "qu"}
    result = checked(driven(), **signals)
    assert "model/input=servo" not in options(result)
    assert result.candidates[0][1] == ["experiment=oscillators"]
    assert "model='oscillators'" in str(result)
    with command_line():
        assert "experiment=oscillators" in result.advice[0]


KINDS = {
    "kPa": ["experiment=oscillators"],
    "N": ["model=lnn"],
    "A": ["model=lnn"],
    "1": ["model=lnn", "experiment=oscillators", "model=mlp"],
}


@pytest.mark.parametrize("unit", KINDS)
def test_the_unit_of_the_inputs_selects_the_models(unit):
    result = checked(driven(), u=dict(columns=["u1", "u2"], unit=unit))
    assert [x[1][0] for x in result.candidates] == KINDS[unit]
    assert all(reason in str(result) for reason, _ in result.candidates)


def test_the_figures_have_the_units_of_the_log_and_the_mean_of_the_residual():
    """A spring that only pulls on one side stays in the residual over q."""
    frame = driven(noise=1e-5)
    frame["u1"] += 2.0 * np.maximum(frame["q1"] - 1.0, 0)
    frame[["q1", "q2"]] *= 1000
    result = checked(frame, q=dict(columns=["q1", "q2"], unit="mm"))
    figure = figures.residuals(result.motion, result.source.q, None, result.source.u)
    grid = np.reshape(figure.axes, (2, 2))
    assert [ax.get_xlabel() for ax in grid[0]] == ["q1 [mm]", "d/dt q1 [mm/s]"]
    x, mean = grid[0, 0].lines[1].get_data()
    assert 1000 < np.abs(x).max() < 5000
    assert np.ptp(mean) > 3 * np.ptp(grid[1, 0].lines[1].get_data()[1])


def test_the_curve_of_the_other_equation_is_drawn_where_it_differs():
    d = np.arange(-2, 20) * 0.01
    curves = [
        DelayCurve(d, (d - x) ** 2 + 0.1, x, 1e-3, form) for x, form in ((0.05, "a"), (0.1, "b"))
    ]
    both = replace(curves[0], other=curves[1])
    figure = figures.delay_curves([both], ["u1"])
    assert [line.get_label() for line in figure.axes[0].lines if line.get_label()[0] != "_"] == [
        "u1",
        "u1, b",
    ]


def test_a_training_asks_the_verdict_of_the_same_numbers(tmp_path, monkeypatch):
    monkeypatch.setenv("PINN_DYN_CACHE", str(tmp_path))
    frame = driven(delay=0.05, noise=1e-5)
    source = checked(frame).source
    assert "after it is logged" in verdict(source)[0]
    same = LogSource(**settings(frame), name="another name")
    assert verdict(same) == verdict(source)
    changed = LogSource(**settings(frame.assign(u1=frame["u1"] + 1e-9)), name="masses")
    assert verdict(changed) == []
