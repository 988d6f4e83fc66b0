"""Known mechanics with learned constants: physical for every parameter, and passive."""

import dataclasses
import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from pinn_dyn.models import ElasticJoints, KnownMechanics, KnownSystem
from pinn_dyn.models.known_constants import PhysicalBodies, PositiveConstants, RealConstants
from pinn_dyn.systems import RigidChain, SoftArm
from pinn_dyn.systems.inertia import inertial_parameters
from pinn_dyn.testing import MechanicalSystemContract
from tests.support.contracts import one_case
from tests.support.known import anywhere, known_model, statistics
from tests.support.rigid_chains import TREE


@one_case
class TestKnownMechanicsContract(MechanicalSystemContract):
    """With every kind of constant, away from the start."""

    @pytest.fixture
    def system(self):
        model = known_model(friction=None, gain_spread=0.5, drive_gain=2.0, springs=["bend"])
        return anywhere(model, std=0.2)


def test_the_prior_start_is_the_urdfs_robot():
    chain = RigidChain(TREE, locked_joints=["wrist"])
    model = known_model(start="prior", friction=None)
    q, v, a = torch.randn(3, 20, 4).double()
    drives = model.armature() * a + model.viscous() * v - model.offset()
    expected = chain.inverse_dynamics(q, v, a) + drives
    assert torch.allclose(model.inverse_dynamics(q, v, a), expected, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(
    "build",
    [
        partial(KnownMechanics, structure=RigidChain(TREE, locked_joints=["wrist"])),
        partial(KnownMechanics, structure=ElasticJoints(RigidChain(TREE, locked_joints=["wrist"]))),
        partial(KnownSystem, structure=SoftArm()),
    ],
    ids=["rigid", "elastic", "system"],
)
def test_the_structure_of_the_caller_stays_as_it_is(build):
    structure = build.keywords["structure"]
    before = {name: value.clone() for name, value in structure.named_buffers()}
    drives = 3 if isinstance(structure, SoftArm) else 4
    inputs = {"u_mean": torch.zeros(drives), "u_std": torch.ones(drives)}
    build(replace(statistics(structure.num_coordinates), **inputs)).half()
    assert before
    assert all(
        value.dtype == torch.float64 and torch.equal(value, before[name])
        for name, value in structure.named_buffers()
    )


def test_springs_store_half_k_times_the_square_of_their_stretch():
    plain, model = known_model(), anywhere(known_model(springs=["slide", "bend"]))
    with torch.no_grad():
        model.bodies.z.copy_(plain.bodies.z)
        model.offset.z.copy_(plain.offset.z[[0, 3]])  # of the other joints
        q = torch.randn(20, 4).double()
        energy = model.potential_energy(q) - plain.potential_energy(q)
        stiffness, rest = (part.values for part in model.physical_constants()[-2:])
    assert model.physical_constants()[-1].names == ["rest position of slide", "rest angle of bend"]
    assert model.physical_constants()[-2].units == ["N/m", "Nm/rad"]
    expected = (0.5 * stiffness * (q[:, [1, 2]] - rest) ** 2).sum(-1)
    torch.testing.assert_close(energy - energy[0], expected - expected[0])
    with pytest.raises(ValueError, match=r"springs names knee, expected some of turn, slide"):
        known_model(springs=["knee"])


@pytest.mark.parametrize("seed", range(2))
def test_every_parameter_is_a_body_of_positive_density(seed):
    chain = RigidChain(TREE, locked_joints=["wrist"])
    bodies = anywhere(PhysicalBodies(chain.inertia, 1.0, chain.body_names), std=1.5, seed=seed)
    for m, mx, my, mz, *moments in inertial_parameters(bodies()).tolist():
        centre = torch.tensor([mx, my, mz]).double() / m
        ixx, ixy, iyy, ixz, iyz, izz = moments
        about_origin = torch.tensor([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]]).double()
        shift = centre @ centre * torch.eye(3) - torch.outer(centre, centre)
        principal = torch.linalg.eigvalsh(about_origin - m * shift)
        assert m > 0
        assert principal[0] > 0
        assert principal[2] < principal[0] + principal[1]  # the triangle inequality


PLACES = {
    **{"x extent": (0, 0), "y extent": (1, 1), "z extent": (2, 2)},
    **{"xy shear": (0, 1), "xz shear": (0, 2), "yz shear": (1, 2)},
    **{"x centre": (0, 3), "y centre": (1, 3), "z centre": (2, 3)},
}


@pytest.mark.parametrize("part", ["mass", *PLACES])
def test_each_parameter_of_a_body_is_what_its_name_says(part):
    """Rucker and Wensing's U has it in one place; the mass, e^2a, is a factor of it all."""
    start = RigidChain(TREE, locked_joints=["wrist"]).inertia[:1]
    bodies = PhysicalBodies(start, 0.5, ["it"]).double()
    size, stretch = 0.8, torch.eye(4, dtype=torch.float64)
    with torch.no_grad():
        bodies.z[0, bodies.names.index(f"{part} of it")] = size / 0.5
    factor = math.exp(2 * size) if part == "mass" else 1.0
    if part != "mass":
        row, column = PLACES[part]
        stretch[row, column] = math.exp(size) if row == column else size
    mass = start[0, 3, 3]
    centre = start[0, :3, 3] / mass
    root = torch.eye(4, dtype=torch.float64)
    covariance = start[0, :3, :3] / mass - torch.outer(centre, centre)
    root[:3, :3], root[:3, 3] = torch.linalg.cholesky(covariance), centre
    changed = factor * mass * root @ stretch @ stretch.T @ root.T
    torch.testing.assert_close(bodies()[0], changed, rtol=1e-5, atol=1e-7)


def test_the_bodies_of_the_file_are_the_start_and_generic_ones_have_a_wide_prior():
    """By the default, and with another spread for one of the bodies."""
    text = TREE.replace('mass value="0.7"', 'mass value="-0.7"')
    chain = RigidChain(text, locked_joints=["wrist"])
    spread = {"default": 0.3, "elbow": 2.0}
    model = KnownMechanics(statistics(4), chain, spread=spread)
    prior, generic = chain.prior_inertia(), chain.generic_inertia()
    start = model.bodies.start().double()
    assert chain.body_names[:3] == ["shoulder", "slider", "elbow"]
    torch.testing.assert_close(start[1], generic[1], rtol=1e-5, atol=1e-6)
    for k in (0, 2, 3):
        torch.testing.assert_close(start[k], chain.inertia[k].double(), rtol=1e-5, atol=1e-6)
    assert torch.equal(prior[1], generic[1].to(prior))
    assert model.bodies.spread.flatten().tolist() == pytest.approx([0.3, 3.0, 2.0, 0.3])
    with pytest.raises(ValueError, match=r"spread names arm, expected default .* shoulder, slider"):
        KnownMechanics(statistics(4), chain, spread={"arm": 1.0})


def test_standardized_constants():
    positive = PositiveConstants(torch.tensor([2.0, 3.0]), 0.5, ["a", "b"], ["kg", "kg"])
    real = RealConstants(torch.tensor([4.0]), ["c"], ["N"])
    assert positive().tolist() == [2.0, 3.0]
    assert real().tolist() == [0.0]
    with torch.no_grad():
        positive.z += 1
        real.z -= 2
    assert positive().tolist() == pytest.approx([2 * 1.6487213, 3 * 1.6487213])
    assert real().tolist() == [-8.0]
    with pytest.raises(ValueError, match=r"start is .* expected positive"):
        PositiveConstants(torch.tensor([0.0]), 0.5, ["a"], ["kg"])


def test_drives_start_at_the_scales_of_the_data():
    """Armature ~ f/a, viscous friction ~ f/v and offset ~ f, with the typical torque f = k u."""
    scales = dataclasses.replace(
        statistics(4),
        v_std=torch.tensor([0.5, 1.0, 2.0, 4.0]).double(),
        u_std=torch.tensor([2.0, 6.0, 10.0, 20.0]).double(),
        qv_increment_std=torch.tensor([[1.0] * 4 + [0.1, 0.3, 0.2, 0.4]]).double(),
    )
    model = KnownMechanics(scales, RigidChain(TREE, locked_joints=["wrist"]), drive_gain=3.0)
    force, acceleration = 3 * scales.u_std, scales.qv_increment_std[0, 4:] / scales.step
    torch.testing.assert_close(model.armature().double(), 0.03 * force / acceleration)
    torch.testing.assert_close(model.viscous().double(), 0.1 * force / scales.v_std)
    torch.testing.assert_close(model.offset.spread.double(), 0.3 * force)
    slides = {"armature": "kg", "viscous": "Ns/m", "offset": "N"}
    turns = {"armature": "kg m^2", "viscous": "Nms/rad", "offset": "Nm"}
    for name in slides:
        units = [(turns if turning else slides)[name] for turning in model.structure.turning]
        assert getattr(model, name).units == units


def test_the_ratio_of_forces_counts_per_input():
    """Bodies of half the mass with half the drive gain fit the same inputs."""
    model = known_model(drive_gain=[1.0, 2.0, 3.0, 4.0], gain_spread=0.7)
    q, v, a = torch.randn(3, 20, 4, generator=torch.Generator().manual_seed(0)).double()
    with torch.no_grad():
        model.armature.z.fill_(-20.0)
        ratio, _ = model.force_ratio(q, v, a)
        torch.testing.assert_close(ratio, torch.ones(4).double(), rtol=1e-5, atol=0)
        model.gain.z.fill_(math.log(0.5) / 0.7)
        torch.testing.assert_close(model.force_ratio(q, v, a)[0], 2 * ratio)
        mass = math.log(0.5) / 2 / model.bodies.spread
        model.bodies.z[:, :1] = mass
        torch.testing.assert_close(model.force_ratio(q, v, a)[0], ratio, rtol=1e-5, atol=0)
