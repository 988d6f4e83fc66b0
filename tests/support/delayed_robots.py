"""Robots that are driven by an input that acts late, with noise in what is measured."""

import functools

import numpy as np
import torch
from scipy.integrate import solve_ivp
from scipy.ndimage import gaussian_filter1d

from pinn_dyn.data.logs import Recording
from pinn_dyn.systems import RigidChain
from tests.support.rigid_chains import joint, link, robot


def pendulum(q, v, u):
    """0.5 kg at 0.4 m, with viscous damping."""
    return (u - 0.5 * 9.81 * 0.4 * np.sin(q) - 0.1 * v) / (0.5 * 0.4**2)


def arm_torque(q, v, a):
    """Torques of two rods of 1 and 0.8 kg, 0.5 and 0.4 m, in the vertical plane, ``(T, 2)``."""
    m1, m2, l1, l2 = 1.0, 0.8, 0.5, 0.4
    c, s = (m2 * l1 * l2 / 2 * f(q[:, 1]) for f in (np.cos, np.sin))
    m22 = m2 * l2**2 / 3
    m12 = m22 + c
    m11 = m1 * l1**2 / 3 + m2 * l1**2 + m22 + 2 * c
    tip = np.sin(q.sum(axis=1)) * m2 * 9.81 * l2 / 2
    base = np.sin(q[:, 0]) * 9.81 * (m1 / 2 + m2) * l1
    first = m11 * a[:, 0] + m12 * a[:, 1] - s * (2 * v[:, 0] + v[:, 1]) * v[:, 1] + tip + base
    second = m12 * a[:, 0] + m22 * a[:, 1] + s * v[:, 0] ** 2 + tip
    return np.stack([first, second], axis=1) + 0.3 * v + 0.2 * np.tanh(20 * v)


@functools.cache
def seven_joints():
    """Seven links of 0.25 m that turn about z and y in turn, each lighter than the one before."""
    parts = [link("base")]
    for k in range(1, 8):
        mass = 3.0 / k
        moments = f"{0.01 * mass} 0 {0.011 * mass} 0 0 {0.004 * mass}"
        place = {"xyz": "0 0 0.25", "rpy": "0 0 0", "axis": "0 0 1" if k % 2 else "0 1 0"}
        parts.append(link(f"link{k}", mass, "0.02 0.01 0.12", moments))
        parts.append(
            joint(f"joint{k}", "revolute", f"link{k - 1}" if k > 1 else "base", f"link{k}", **place)
        )
    return RigidChain(robot(*parts))


def seven_regressor(q, v, a):
    """Y of the seven joints, ``(T, 7, 70)``."""
    return seven_joints().regressor(*map(torch.from_numpy, (q, v, a))).numpy()


def seven_torques(q, v, a):
    """Torques of the seven joints, ``(T, 7)``, with friction."""
    rigid = seven_joints().rigid_force(*map(torch.from_numpy, (q, v, a))).numpy()
    return rigid + 0.5 * v + 0.3 * np.tanh(20 * v)


def tendons(q, u):
    """Two bends that follow three motor angles with time constants of 0.15 and 0.2 s."""
    pull = np.array([[1.0, -0.5, -0.5], [0.0, 0.87, -0.87]]) @ u
    return (0.5 * np.tanh(pull) - q - 0.3 * q**3) / np.array([0.15, 0.2])


def sines(rng, count, *, size, lowest=0.1, highest=2.0, number=6):
    """Sums of sines of random frequencies in Hz, ``(..., count)``, and their derivatives, of t."""
    w = 2 * np.pi * rng.uniform(lowest, highest, (number, count))
    phase = rng.uniform(0, 2 * np.pi, (number, count))

    def value(t, order=0):
        angle = w * np.asarray(t)[..., None, None] + phase + order * np.pi / 2
        return size * np.sqrt(2 / number) * (w**order * np.sin(angle)).sum(axis=-2)

    return value


ARMS = {"arm": (2, arm_torque), "seven joints": (7, seven_torques)}
"""Number of joints, and the torques of a motion."""


@functools.cache
def log(kind, seed, delay, *, seconds=12.0, rate=100.0, noise=1e-3, highest=2.0, number=6):
    """A recording whose input acts ``delay`` s after it was logged.

    An arm follows sines, and has the torques that they need; the others follow from their input.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(seconds * rate) + 1) / rate
    drawn = {"highest": highest, "lowest": min(0.1, highest), "number": number}
    if kind in ARMS:
        size, torque = ARMS[kind]
        motion = sines(rng, size, size=0.5, **drawn)
        q = motion(t)
        u = torque(*(motion(t + delay, order) for order in range(3)))
    else:
        signal = sines(rng, 1 if kind == "pendulum" else 3, size=1.0, **drawn)
        n = 1 if kind == "pendulum" else 2

        def rate_of_change(t, x):
            u = signal(t - delay)
            if kind == "tendons":
                return tendons(x, u)
            return np.concatenate([x[1:], pendulum(x[:1], x[1:], u)])

        x = solve_ivp(rate_of_change, (0, t[-1]), np.zeros(2), t_eval=t, rtol=1e-6, atol=1e-8)
        q, u = x.y.T[:, :n], signal(t)
    return Recording("run", t, q + noise * np.ptp(q, axis=0) * rng.normal(size=q.shape), None, u)


def motor_arm(seed, delay, *, rate=100.0, seconds=40.0):
    """One to three bends of an arm with inertia, which two to four motors pull by elastic cables.

    The angles of the motors are sines and smooth steps, and act ``delay`` s after they are logged.
    """
    rng, step, margin = np.random.default_rng(seed), 0.002, 0.5
    size, count = ((2, 3), (2, 4), (3, 3), (1, 2), (3, 4))[seed % 5]
    t = np.arange(-margin, seconds + margin, step)
    motors = sines(rng, count, size=0.7, lowest=0.05, highest=1.0)(t)
    held = round(rng.uniform(0.6, 2.0) / step)
    levels = rng.uniform(-1, 1, (len(t) // held + 1, count)).repeat(held, axis=0)[: len(t)]
    motors += gaussian_filter1d(levels, 0.05 / step, axis=0)
    pull = rng.normal(size=(size, count))
    pull /= np.linalg.norm(pull, axis=0)
    pretension, cubic = rng.uniform(0, 2), rng.uniform(0.1, 0.5, size)
    frequency, ratio = 2 * np.pi * rng.uniform(0.8, 3), rng.uniform(0.3, 3)
    q, v, motion = np.zeros(size), np.zeros(size), []
    for u in motors:
        stretch = pretension + u - 0.5 * (q @ pull)
        force = pull @ (stretch + np.sqrt(stretch**2 + 0.05)) / 2 - q - cubic * q**3
        v = (v + step * frequency**2 * force) / (1 + 2 * step * ratio * frequency)
        q = q + step * v
        motion.append(q)
    times = np.arange(round((seconds - margin) * rate)) / rate
    q = np.column_stack([np.interp(times, t, x) for x in np.transpose(motion)])
    u = np.column_stack([np.interp(times + delay, t, x) for x in motors.T])
    return Recording("run", times, q + 1e-3 * np.ptp(q, axis=0) * rng.normal(size=q.shape), None, u)


def resting(dry, *, seconds=60.0, rate=200.0, late=0, seed=0):
    """Two damped joints under gravity that move in turn, with held torques of a controller.

    Dry friction of ``dry`` Nm stops a joint, and holds it. The torque is logged ``late`` samples
    before it acts.
    """
    rng = np.random.default_rng(seed)
    inertia, weight, sub = np.array([0.3, 0.1]), np.array([3.0, 0.8]), 5
    h, n = 1 / (rate * sub), round(seconds * rate)
    # Minimum-jerk motions of 0.6 s, then a rest of 0.6 s, of one joint after the other.
    s = np.arange(n) / rate / 1.2
    goals = np.repeat(rng.uniform(-1.2, 1.2, (int(s[-1]) // 2 + 3, 2)), 2, axis=0)
    goals = np.stack([goals[:-1, 0], goals[1:, 1]], axis=1)
    part = np.minimum(2 * (s % 1), 1)[:, None]
    blend = 10 * part**3 - 15 * part**4 + 6 * part**5
    reference = goals[s.astype(int)] + (goals[s.astype(int) + 1] - goals[s.astype(int)]) * blend
    q, v, motion, torque = np.zeros(2), np.zeros(2), [], []
    for target, target_v in zip(reference, np.gradient(reference, 1 / rate, axis=0), strict=True):
        u = inertia * (400 * (target - q) + 40 * (target_v - v)) + weight * np.sin(q)
        motion.append(q)
        torque.append(u)
        for _ in range(sub):
            free = v + h * (u - weight * np.sin(q) - 0.1 * v) / inertia
            v = np.sign(free) * np.maximum(np.abs(free) - h * dry / inertia, 0.0)
            q = q + h * v
    q, u = np.array(motion), np.array(torque)
    q = q + 2e-5 * rng.normal(size=q.shape)
    return Recording("run", np.arange(n - late) / rate, q[: n - late], None, u[late:])
