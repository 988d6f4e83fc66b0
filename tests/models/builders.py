"""Small models with non-trivial weights, and the data scales that they are built from."""

from dataclasses import replace
from functools import partial

import torch

from pinn_dyn.models import (
    AccelerationMLP,
    Bounded,
    ChainPotential,
    CholeskyFactor,
    ConstantCholesky,
    ConstantInput,
    CoulombFriction,
    CoupledOscillators,
    FixedCholesky,
    FixedInput,
    HamiltonianNetwork,
    LagrangianNetwork,
    LearnedVelocity,
    NetworkCholesky,
    NetworkInput,
    NetworkPotential,
    NextStateMLP,
    NoFriction,
    NonlinearInput,
    Positive,
    Scales,
    Statistics,
    SubspaceEncoder,
)

STEP = 0.02


def make_statistics(n, m, step=STEP):
    """Scales that are all different from one and from each other."""
    rows = torch.arange(1, n + 1, dtype=torch.float64)
    columns = torch.arange(1, m + 1, dtype=torch.float64)
    increment = torch.cat([0.02 * rows.sqrt(), 0.03 * rows.rsqrt()])
    return Statistics(
        q_mean=0.1 * rows - 0.3,
        q_std=0.6 + 0.1 * rows,
        q_low=-2.0 - 0.1 * rows,
        q_high=1.9 + 0.2 * rows,
        v_std=1.5 - 0.2 * rows,
        p_std=0.7 + 0.1 * rows,
        u_mean=0.2 * columns - 0.5,
        u_std=0.8 + 0.15 * columns,
        qv_increment_std=torch.stack([increment, 2 * increment]),
        qp_increment_std=torch.stack([0.7 * increment, 1.4 * increment]),
        step=step,
    )


def make_scales(n, m, value=1.0, angles=(), prior=False, **statistics):
    """Scales of a head; the value is one number or a list, ``statistics`` replace the usual."""
    value = torch.as_tensor(value, dtype=torch.float64)
    data = make_statistics(n, m)
    if "q_mean" in statistics:  # then of normal data, nearly
        reach = 3 * statistics["q_std"]
        statistics |= {
            "q_low": statistics["q_mean"] - reach,
            "q_high": statistics["q_mean"] + reach,
        }
    data = replace(data, **statistics)
    return Scales(data, value, tuple(angles), prior=prior)


def perturb(model, seed=0, spread=0.3):
    """Move every parameter off its start: that start is near a diagonal, constant matrix."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += spread * torch.randn(
                parameter.shape, generator=generator, dtype=torch.float64
            ).to(parameter)
    return model


def positive_matrix(n):
    """A symmetric positive definite matrix with entries off the diagonal."""
    values = torch.full((n, n), 0.1, dtype=torch.float64) + torch.diag(torch.arange(1.0, n + 1))
    return values.tolist()


def input_values(n, m):
    """A full N x M matrix."""
    return (0.2 * torch.arange(n * m).reshape(n, m) - 0.5).tolist()


class InverseOf(CholeskyFactor):
    """The Cholesky factor of M(q)^-1 for another head's M(q)."""

    def __init__(self, head):
        super().__init__()
        self.head = head

    def factor(self, q):
        return torch.linalg.cholesky(torch.linalg.inv(self.head.matrix(q)))

    def linearize(self, q):
        return self.factor(q), (q,)

    def linearize_along(self, q, dq):
        return *torch.func.jvp(self.factor, (q,), (dq,)), (q,)

    def pullback(self, tape, cotangent):
        return torch.func.vjp(self.factor, *tape)[1](cotangent)[0]


def make_structured(
    kind,
    n=3,
    m=3,
    *,
    mass=None,
    potential=None,
    damping=None,
    input=None,
    friction=None,
    initial_velocity=None,
    residual=None,
    angles=(),
    statistics=None,
    integrator=None,
    state=None,
    dtype=torch.float64,
):
    """A Lagrangian or Hamiltonian network; a head that is left out is a small network."""
    torch.manual_seed(7)
    mass = mass or partial(NetworkCholesky, hidden=[6, 5])
    heads = {
        "potential": potential or partial(NetworkPotential, hidden=[6, 5]),
        "damping": damping or partial(NetworkCholesky, hidden=[5], positivity=Positive(floor=0.0)),
        "input": input or partial(NetworkInput, hidden=[5]),
        "friction": friction or NoFriction,
        "angles": angles,
        "integrator": integrator,
    }
    statistics = statistics or make_statistics(n, m)
    if kind == "lnn":
        model = LagrangianNetwork(
            statistics, mass, initial_velocity=initial_velocity, residual=residual, **heads
        )
    else:
        model = HamiltonianNetwork(statistics, mass, state=state or "qp", **heads)
    return perturb(model.to(dtype))


def make_model(kind, n=2, m=2, dtype=torch.float64):
    """One of the six models."""
    if kind in ("lnn", "hnn"):
        return make_structured(kind, n, m, dtype=dtype)
    torch.manual_seed(7)
    black_box = {
        "next_state": NextStateMLP,
        "acceleration": AccelerationMLP,
        "subnet": partial(SubspaceEncoder, history=3 * STEP, latent=5),
        "oscillators": partial(CoupledOscillators, oscillators=3, force_hidden=[4]),
        "oscillators_of_the_past": partial(
            CoupledOscillators,
            oscillators=4,
            force_hidden=[4],
            history=2 * STEP,
            initial_velocity=partial(LearnedVelocity, hidden=[4]),
        ),
    }[kind]
    return perturb(black_box(make_statistics(n, m), hidden=[6, 5]).to(dtype))


VARIANTS = {
    "networks-softplus-3x3": dict(n=3, m=3),
    "bounded-tanh-mass-constant-damping-2x1": dict(
        n=2,
        m=1,
        mass=partial(NetworkCholesky, hidden=[6], activation="tanh", positivity=Bounded(2.0)),
        damping=ConstantCholesky,
        input=partial(NetworkInput, hidden=[4], activation="tanh"),
    ),
    "silu-fixed-input-2x4": dict(
        n=2,
        m=4,
        mass=partial(
            NetworkCholesky, hidden=[6], activation="silu", positivity=Positive(0.3, initial=0.5)
        ),
        potential=partial(NetworkPotential, hidden=[6], activation="silu", quadratic=False),
        damping=partial(NetworkCholesky, hidden=[4], positivity=Positive(floor=0.0)),
        input=partial(FixedInput, value=input_values(2, 4)),
    ),
    "constant-mass-fixed-damping-constant-input-3x3": dict(
        n=3,
        m=3,
        mass=ConstantCholesky,
        potential=partial(NetworkPotential, hidden=[6], activation="tanh"),
        damping=partial(FixedCholesky, value=positive_matrix(3)),
        input=ConstantInput,
    ),
    "fixed-mass-no-damping-identity-input-2x2": dict(
        n=2,
        m=2,
        mass=partial(FixedCholesky, value=positive_matrix(2)),
        damping=partial(FixedCholesky, value=[[0.0, 0.0], [0.0, 0.0]]),
        input=FixedInput,
    ),
    "friction-angle-and-length-3x3": dict(n=3, m=3, friction=CoulombFriction, angles=[0, 2]),
    "friction-all-angles-2x1": dict(n=2, m=1, friction=CoulombFriction, angles=[0, 1]),
}
"""Every kind of head once, with square, wide and tall input matrices."""

TRANSPOSED = dict(
    n=3,
    m=3,
    mass=partial(NetworkCholesky, hidden=[6], transposed=True),
    damping=partial(NetworkCholesky, hidden=[4], positivity=Bounded(2.0), transposed=True),
)
"""M = L^T L, for the Lagrangian network alone."""

CHAIN = {
    kind: dict(
        n=3,
        m=3,
        mass=partial(NetworkCholesky, hidden=[6, 5], chain=True, transposed=kind == "lnn"),
        potential=partial(ChainPotential, rank=4),
        angles=[0, 1, 2],
    )
    for kind in ("lnn", "hnn")
}
"""The heads of a serial chain of revolute joints."""


NONLINEAR = dict(
    n=2,
    m=3,
    input=partial(NonlinearInput, hidden=[6], activation="tanh"),
    friction=CoulombFriction,
)
"""A force that is not linear in the input."""


def random_batch(n, m, batch=6, seed=3, dtype=torch.float64):
    """q, v (or p), a and u, uniform in [-1, 1]."""
    generator = torch.Generator().manual_seed(seed)
    return tuple(
        (2 * torch.rand(batch, size, generator=generator, dtype=torch.float64) - 1).to(dtype)
        for size in (n, n, n, m)
    )
