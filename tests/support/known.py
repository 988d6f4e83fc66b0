"""Known mechanics of the small tree, soft arms with learned constants, and motions of them."""

from dataclasses import replace
from functools import partial

import torch

from pinn_dyn.data.windows import draw_windows
from pinn_dyn.mechanics import Signal, Trajectory
from pinn_dyn.models import ElasticJoints, KnownMechanics, KnownSystem, Scales, Statistics, Stribeck
from pinn_dyn.systems import RigidChain, SoftArm
from tests.support.cart_pole import CartPole
from tests.support.rigid_chains import TREE


def statistics(size):
    one = torch.ones(size, dtype=torch.float64)
    return Statistics(
        q_mean=0 * one,
        q_std=one,
        q_low=-3 * one,
        q_high=3 * one,
        v_std=one,
        p_std=one,
        u_mean=0 * one,
        u_std=5 * one,
        qv_increment_std=torch.full((1, 2 * size), 0.05, dtype=torch.float64),
        qp_increment_std=torch.ones(1, 2 * size, dtype=torch.float64),
        step=0.01,
    )


def unit_scales(size, prior=True):
    """Typical speeds and forces of one."""
    return Scales(statistics(size), torch.ones(size, dtype=torch.float64), prior=prior)


def anywhere(module, std=1.0, seed=0):
    """The module in float64 with parameters far from their start."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=std, generator=generator)
    return module.double()


def known_model(urdf=TREE, locked_joints=("wrist",), friction=Stribeck, **settings):
    """Generic bodies on the joints of the tree, in float64."""
    structure = RigidChain(urdf, locked_joints=locked_joints)
    friction = partial(friction, width=0.3) if friction else None
    heads = {"friction": friction} if friction else {}
    settings = {"start": "generic", **settings}
    scales = statistics(structure.num_coordinates)
    model = KnownMechanics(scales, structure, **heads, **settings).double()
    # The model is built in single precision, in which rotations are no longer exact.
    model.structure = RigidChain(urdf, locked_joints=locked_joints)
    return model


def elastic_model(urdf=TREE, locked_joints=("wrist",), joints=("turn", "bend"), **settings):
    """Generic bodies with chosen elastic joints, in float64."""
    chain = RigidChain(urdf, locked_joints=locked_joints)
    structure = ElasticJoints(chain, joints=joints, stiffness=10.0)
    data, inputs = statistics(structure.num_coordinates), statistics(chain.num_coordinates)
    data = replace(data, u_mean=inputs.u_mean, u_std=inputs.u_std)
    model = KnownMechanics(data, structure, start="generic", **settings).double()
    model.structure.chain = RigidChain(urdf, locked_joints=locked_joints)
    return model


def known_arm(segments=1, *, mass=0.5, stiffness=20.0, damping=2.0):
    """A soft arm with learned constants, in float64; so long and stiff that no motion breaks it."""
    structure = SoftArm(segments, length=2.0, mass=mass, stiffness=stiffness, damping=damping)
    return KnownSystem(statistics(3 * segments), structure).double()


class KnownCartPole(CartPole):
    """The cart-pole with its constants as buffers; the rod's length is not linear in the force."""

    def __init__(self):
        super().__init__()
        self.constants = {
            "cart": ["kg"],
            "bob": ["kg"],
            "rod": ["m"],
            "friction": ["Ns/m", "Nms/rad"],
        }
        for name in self.constants:
            value = getattr(self, name).detach()
            delattr(self, name)
            self.register_buffer(name, value)


def known_cart_pole():
    """A cart-pole with learned constants, in float64."""
    one = torch.ones(1, dtype=torch.float64)
    scales = replace(statistics(2), u_mean=0 * one, u_std=5 * one)
    return KnownSystem(scales, KnownCartPole()).double()


def motions(model, seeds, *, seconds=2.0, rate=200.0):
    """Motions of the model under random smooth inputs, ``(T, N)`` each, rolled out side by side."""
    n = model.num_inputs
    t = torch.arange(int(seconds * rate) + 1, dtype=torch.float64) / rate
    inputs, starts = [], []
    for seed in seeds:
        generator = torch.Generator().manual_seed(seed)
        u = torch.zeros(len(t), n, dtype=torch.float64)
        for k in range(1, 6):
            weight, phase = torch.rand(2, n, generator=generator).double()
            u += 4 * (weight - 0.5) * torch.sin(2 * torch.pi * 0.5 * k * t[:, None] + 6 * phase)
        inputs.append(u)
        starts.append(torch.rand(2 * model.num_coordinates, generator=generator).double() - 0.5)
    with torch.no_grad():
        states = model.predict(torch.stack(starts), t, Signal(t, torch.stack(inputs)))
    return [
        Trajectory(*x.chunk(2, dim=-1), Signal(t, u)) for x, u in zip(states, inputs, strict=True)
    ]


def motion(model, *, seconds=2.0, rate=200.0, seed=0):
    """One motion of the model, ``(T, N)``."""
    return motions(model, [seed], seconds=seconds, rate=rate)[0]


def windows_of(model, *, count, steps, stride=2):
    return draw_windows(
        [motion(model, seconds=0.1)], count=count, steps=steps, stride=stride, seed=0
    )
