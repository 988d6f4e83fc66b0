"""Random serial arms whose dry friction sticks, simulated independently of the package, and logs.

Dynamics by recursive Newton-Euler, steps of 0.5 ms by semi-implicit Euler. Friction is a force
between -c and c that stops a joint if it can (projected Gauss-Seidel), as in MuJoCo. Friction has
no width, so the law of the models is wrong near rest.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from pinn_dyn.mechanics import Signal, Trajectory
from tests.support.rigid_chains import robot

STEP = 5e-4  # s
GRAVITY = 9.81


@dataclass
class Arms:
    """A arms of N joints; the placement ``R, p`` of each joint, its axis, and the body behind it.

    ``moments`` are about the centre. The constants of the drives are ``(A, N)``.
    """

    R: np.ndarray
    p: np.ndarray
    axis: np.ndarray
    mass: np.ndarray
    centre: np.ndarray
    moments: np.ndarray
    armature: np.ndarray
    viscous: np.ndarray
    dry: np.ndarray
    offset: np.ndarray

    def inertial(self, arm: int) -> np.ndarray:
        """The ten inertial parameters of each body about its joint, ``(N, 10)``."""
        m, c = self.mass[arm], self.centre[arm]
        square = (c**2).sum(-1)[:, None, None] * np.eye(3) - c[:, :, None] * c[:, None]
        about = self.moments[arm] + m[:, None, None] * square
        six = about[:, [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
        return np.concatenate([m[:, None], m[:, None] * c, six], axis=1)

    def urdf(self, arm: int) -> str:
        """The text of a URDF, with all digits."""
        parts = ['<link name="base"/>']
        for k, m in enumerate(self.mass[arm]):
            (xx, xy, xz), (_, yy, yz), (_, _, zz) = self.moments[arm, k]
            turn = Rotation.from_matrix(self.R[arm, k]).as_euler("xyz")
            parent = f"body{k - 1}" if k else "base"
            parts.append(
                f'<link name="body{k}"><inertial><origin xyz="{_text(self.centre[arm, k])}"/>'
                f'<mass value="{m!s}"/><inertia ixx="{xx}" ixy="{xy}" ixz="{xz}" iyy="{yy}" '
                f'iyz="{yz}" izz="{zz}"/></inertial></link><joint name="joint{k}" '
                f'type="continuous"><parent link="{parent}"/><child link="body{k}"/>'
                f'<origin xyz="{_text(self.p[arm, k])}" rpy="{_text(turn)}"/>'
                f'<axis xyz="{_text(self.axis[arm, k])}"/></joint>'
            )
        return robot(*parts)


def _text(values: np.ndarray) -> str:
    return " ".join(map(str, values.tolist()))


def random_arms(count: int, joints: int, generator: np.random.Generator) -> Arms:
    """Links of 15 to 45 cm and 0.3 to 4 kg on axes in any direction, with drives to match."""

    def draw(low: float, high: float, *shape: int) -> np.ndarray:
        return generator.uniform(low, high, (count, joints, *shape))

    R = Rotation.from_rotvec(draw(-1.5, 1.5, 3).reshape(-1, 3)).as_matrix()
    axis = generator.normal(size=(count, joints, 3))
    mass, sides = draw(0.3, 4), draw(0.05, 0.35, 3)
    turn = Rotation.from_rotvec(draw(-1.5, 1.5, 3).reshape(-1, 3)).as_matrix()
    turn = turn.reshape(count, joints, 3, 3)
    main = mass[..., None] / 12 * ((sides**2).sum(-1, keepdims=True) - sides**2)
    zero = np.zeros((count, joints))
    arms = Arms(
        R=R.reshape(count, joints, 3, 3),
        p=draw(0.15, 0.45, 1) * _unit(generator.normal(size=(count, joints, 3))),
        axis=_unit(axis),
        mass=mass,
        centre=draw(-0.2, 0.2, 3),
        moments=np.einsum("akij,akj,aklj->akil", turn, main, turn),
        armature=zero,
        viscous=zero,
        dry=zero,
        offset=zero,
    )
    q = generator.uniform(-2, 2, (200, 1, joints)) + np.zeros((1, count, 1))
    mass_matrix, gravity = mass_and_bias(arms, q, 0 * q)
    inertia = mass_matrix.diagonal(axis1=-2, axis2=-1).mean(0)
    force = np.sqrt((gravity**2).mean(0)) + 10 * inertia
    arms.armature = inertia * np.exp(draw(-3.5, 0))
    arms.viscous = force * np.exp(draw(-4, -2))
    arms.dry = force * np.exp(draw(-3.5, -1.5))
    arms.offset = force * draw(-0.1, 0.1)
    return arms


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    z = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.stack([x, y, z], axis=-1)


def mass_and_bias(arms: Arms, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M without armatures ``(*batch, A, N, N)`` and C v + G, by N + 1 inverse dynamics at once."""
    n = q.shape[-1]
    unit = np.eye(n).reshape(n, *[1] * (q.ndim - 1), n) + 0 * q
    a = np.concatenate([0 * q[None], unit])
    v = np.concatenate([v[None], 0 * unit])
    up = np.zeros((n + 1, *q.shape[:-1], 3))
    up[0, ..., 2] = GRAVITY
    tau = _newton_euler(arms, q, v, a, up)
    return np.moveaxis(tau[1:], 0, -1), tau[0]


def _newton_euler(
    arms: Arms, q: np.ndarray, v: np.ndarray, a: np.ndarray, acceleration: np.ndarray
) -> np.ndarray:
    n = q.shape[-1]
    turns, forces, torques = [], [], []
    w = dw = np.zeros_like(acceleration)
    for k in range(n):
        z, p, c = arms.axis[:, k], arms.p[:, k], arms.centre[:, k]
        sine, cosine = np.sin(q[..., k, None, None]), np.cos(q[..., k, None, None])
        skew = _cross(np.eye(3)[None], z[:, None])  # row i: e_i x z
        about = cosine * np.eye(3) + sine * skew + (1 - cosine) * z[:, :, None] * z[:, None]
        E = (arms.R[:, k] @ about).swapaxes(-1, -2)  # parent to child
        acceleration = _turn(E, acceleration + _cross(dw, p) + _cross(w, _cross(w, p)))
        w, dw = _turn(E, w), _turn(E, dw)
        spin = z * v[..., k, None]
        dw = dw + z * a[..., k, None] + _cross(w, spin)
        w = w + spin
        mass = arms.mass[:, k, None]
        force = mass * (acceleration + _cross(dw, c) + _cross(w, _cross(w, c)))
        inertia = arms.moments[:, k]
        torque = _turn(inertia, dw) + _cross(w, _turn(inertia, w)) + _cross(c, force)
        turns.append(E)
        forces.append(force)
        torques.append(torque)
    force = torque = 0.0 * acceleration
    tau = []
    for k in reversed(range(n)):
        force, torque = force + forces[k], torque + torques[k]
        tau.append((arms.axis[:, k] * torque).sum(-1))
        back = turns[k].swapaxes(-1, -2)
        force, torque = _turn(back, force), _turn(back, torque)
        torque = torque + _cross(arms.p[:, k], force)
    return np.stack(tau[::-1], axis=-1)


def _turn(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]


def simulated(
    arms: Arms, runs: int, seconds: float, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """q and u at all steps, ``(T, R, A, N)``, of a stiff controller on sines with pauses."""
    count, n = arms.mass.shape
    steps = int(seconds / STEP)
    t = STEP * np.arange(steps)
    time = t + 0.2 * np.sin(2 * np.pi * t / 5)
    reference = np.zeros((steps, runs, count, n))
    for f in (0.17, 0.31, 0.53, 0.83, 1.2):
        phase = generator.uniform(0, 2 * np.pi, (runs, count, n))
        size = generator.uniform(0.2, 1, (runs, count, n)) * 0.35 / f**0.5
        reference += size * np.sin(2 * np.pi * f * time[:, None, None, None] + phase)
    # Each joint pauses for 0.4 s now and then, and starts smoothly.
    pause = generator.uniform(size=(steps // 800 + 1, runs, count, n)) < 0.15
    hold = np.repeat(pause, 800, axis=0)[:steps].astype(float)
    slow = sosfiltfilt(butter(2, 3, fs=1 / STEP, output="sos"), 1 - hold, axis=0)
    speed = np.gradient(reference, STEP, axis=0) * slow.clip(0, 1)
    reference = reference[:1] + np.cumsum(speed, axis=0) * STEP
    acceleration = np.gradient(speed, STEP, axis=0)
    q, v, impulse = reference[0].copy(), 0 * reference[0], 0 * reference[0]
    limit = STEP * arms.dry
    qs, us = np.empty_like(reference), np.empty_like(reference)
    for k in range(steps):
        mass, bias = mass_and_bias(arms, q, v)
        mass = mass + arms.armature[..., None] * np.eye(n)
        wanted = acceleration[k] + 20 * (speed[k] - v) + 100 * (reference[k] - q)
        u = _turn(mass, wanted) + bias
        qs[k], us[k] = q, u
        inverse = np.linalg.inv(mass + STEP * arms.viscous[..., None] * np.eye(n))
        free = _turn(inverse, _turn(mass, v) + STEP * (u + arms.offset - bias))
        v = free - _turn(inverse, impulse)
        for _ in range(8):
            for i in range(n):
                new = (impulse[..., i] + v[..., i] / inverse[..., i, i]).clip(
                    -limit[:, i], limit[:, i]
                )
                v = v - inverse[..., i] * (new - impulse[..., i])[..., None]
                impulse[..., i] = new
        q = q + STEP * v
    return qs, us


def logs(
    q: np.ndarray,
    u: np.ndarray,
    rate: float,
    generator: np.random.Generator,
    noise: tuple[float, float] = (2e-4, 0.01),
) -> list[Trajectory]:
    """Noisy logs of q, v by filtered differences, and u, of runs ``(T, R, N)`` of an arm.

    ``noise`` is that of q in rad, and that of u as a share of its spread.
    """
    stride = round(1 / rate / STEP)
    t = torch.arange(len(q[::stride]), dtype=torch.float64) / rate
    result = []
    for run in range(q.shape[1]):
        clean, force = q[::stride, run], u[::stride, run]
        measured = clean + noise[0] * generator.normal(size=clean.shape)
        low_pass = butter(2, 20 if rate > 50 else 0.4 * rate, fs=rate, output="sos")
        v = sosfiltfilt(low_pass, np.gradient(measured, 1 / rate, axis=0), axis=0)
        force = force + noise[1] * force.std(0) * generator.normal(size=force.shape)
        values = (torch.from_numpy(np.ascontiguousarray(x)) for x in (measured, v, force))
        a, b, c = values
        result.append(Trajectory(a, b, Signal(t, c)))
    return result
