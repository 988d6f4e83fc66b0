"""The soft arm against the paper's tables, hand calculations and independent kinematics."""

import math

import numpy as np
import pytest
import torch
from scipy.integrate import quad_vec
from scipy.spatial.transform import Rotation

from pinn_dyn.systems import SoftArm
from pinn_dyn.testing import assert_near
from tests.support.linear import double

# Table "Mathematical model matrices of one-segment soft manipulator" of the paper, as printed.
PRINTED = [
    {
        "q": [1.2, -0.2, 0.15],
        "M": "1.73e-3 -3.12e-5 -1.96e-3  -3.12e-5 1.55e-3 3.26e-4  -1.96e-3 3.26e-4 9.29e-2",
        "M_inverse": "593.09 9.35 12.47  9.35 647.61 -2.08  12.47 -2.08 11.04",
        "G": "1.29 -0.22 -1.15",
        "A": "-0.04 -1.0 0.07  0.78 0.04 -0.01  0.00 0.00 0.77",
    },
    {
        "q": [0.8, 0.2, 0.3],
        "M": "3.64e-3 4.52e-5 -1.94e-3  4.52e-5 3.47e-3 -4.84e-4  -1.94e-3 -4.84e-4 9.67e-2",
        "M_inverse": "277.76 -2.84 5.55  -2.84 288.42 1.39  5.55 1.39 10.46",
        "G": "0.89 0.22 -1.09",
        "A": "0.03 -0.99 0.06  0.90 -0.03 0.02  0.00 0.00 0.89",
    },
]
LENGTH, MASS, GRAVITY = 0.2, 0.3, 9.81


def half_unit(printed):
    """Half a unit of the last printed digit."""
    mantissa, _, exponent = printed.partition("e")
    return 0.5 * 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


@pytest.mark.parametrize("row", PRINTED, ids=["first", "second"])
@pytest.mark.parametrize("term", ["M", "G", "A"])
def test_terms_reproduce_every_printed_digit(row, term):
    actual = getattr(SoftArm().terms(double(row["q"])), term).flatten()
    printed = row[term].split()
    assert len(actual) == len(printed)
    for value, digits in zip(actual.tolist(), printed, strict=True):
        # A[0, 2] = 0.064999 is printed as 0.07.
        assert abs(value - float(digits)) <= 1.001 * half_unit(digits), (value, digits)


@pytest.mark.parametrize("row", PRINTED, ids=["first", "second"])
def test_inverse_mass_matrix_is_the_printed_one_within_a_thousandth(row):
    actual = torch.linalg.inv(SoftArm().mass_matrix(double(row["q"]))).flatten()
    for value, digits in zip(actual.tolist(), row["M_inverse"].split(), strict=True):
        assert abs(value - float(digits)) <= 1e-3 * abs(float(digits)) + half_unit(digits)


# The straight arm.


def test_straight_arm_has_the_terms_of_a_rod():
    """r = L [dx s^2/2, dy s^2/2, s] to first order, and the tip turns by (-dy, dx, 0)."""
    reach = LENGTH + 0.1
    mass, _, force, inputs = SoftArm().terms(double([0.0, 0.0, 0.1]))
    torch.testing.assert_close(
        mass, torch.diag(MASS * double([reach**2 / 20, reach**2 / 20, 1 / 3]))
    )
    torch.testing.assert_close(force, double([0.0, 0.0, 0.1 - MASS * GRAVITY / 2]))
    torch.testing.assert_close(inputs, double([[0, -1, 0], [1, 0, 0], [0, 0, 1]]))


@pytest.mark.parametrize("segments", [1, 2, 3])
def test_terms_and_dynamics_are_continuous_through_the_straight_arm(segments):
    arm, generator = SoftArm(segments), torch.Generator().manual_seed(0)
    shape = (segments, 3)
    straight = torch.rand(shape, generator=generator, dtype=torch.float64) * double([0, 0, 0.2])
    nearly = straight + double([0.6e-6, 0.8e-6, 0])  # theta = 1e-6
    v, u = torch.rand(2, 3 * segments, generator=generator, dtype=torch.float64) - 0.5
    at_zero, near_zero = (
        [*arm.terms(q), arm.coriolis_matrix(q, v), arm.forward_dynamics(q, v, u)]
        for q in (straight.flatten(), nearly.flatten())
    )
    for here, there in zip(at_zero, near_zero, strict=True):
        assert here.isfinite().all()
        assert_near(there, here, 1e-4, scale=1e-3 + here.abs().max())


# Independent kinematics: closed forms with their division by theta, in NumPy.


def backbone(q, s, length=LENGTH):
    """World points of every segment at the fractions ``s``: tips and rotations as well."""
    position, rotation = np.zeros(3), np.eye(3)
    points, tips, rotations = [], [], []
    for dx, dy, dl in np.reshape(q, (-1, 3)):
        theta, reach = math.hypot(dx, dy), length + dl
        bend = (1 - np.cos(theta * s)) / theta**2
        local = reach * np.stack([dx * bend, dy * bend, np.sin(theta * s) / theta], -1)
        end = (1 - math.cos(theta)) / theta**2
        tip = reach * np.array([dx * end, dy * end, math.sin(theta) / theta])
        points.append(position + local @ rotation.T)
        position = position + rotation @ tip
        rotation = rotation @ Rotation.from_rotvec([-dy, dx, 0]).as_matrix()
        tips.append(position)
        rotations.append(rotation)
    return np.array(points), np.array(tips), np.array(rotations)


@pytest.fixture
def motion():
    """q and v of three segments, bent by 0.5 to 2 rad."""
    q = np.array([0.9, -0.4, 0.1, -0.3, 0.7, 0.25, 1.6, 1.1, -0.05])
    v = np.array([-0.7, 0.2, 0.5, 0.9, -0.4, 0.3, 0.1, 0.8, -0.6])
    return q, v


@pytest.mark.parametrize("segments", [1, 2, 3])
def test_backbone_matches_a_composition_of_rotations(segments, motion):
    q = motion[0][: 3 * segments]
    s = np.linspace(0, 1, 7)
    points = SoftArm(segments).backbone(torch.from_numpy(q).expand(2, -1), torch.from_numpy(s))
    assert points.shape == (2, segments, 7, 3)
    tips = SoftArm(segments).tip_position(torch.from_numpy(q))
    np.testing.assert_allclose(tips, backbone(q, s)[1][-1], rtol=0, atol=1e-14)
    np.testing.assert_allclose(points[1], backbone(q, s)[0], rtol=0, atol=1e-14)


@pytest.mark.parametrize("segments", [1, 2, 3])
def test_kinetic_energy_is_that_of_the_moving_backbone(segments, motion):
    q, v = (x[: 3 * segments] for x in motion)

    def energy_density(s):
        step = 1e-4
        near, far = (
            backbone(q + e * v, s)[0] - backbone(q - e * v, s)[0] for e in (step, 2 * step)
        )
        velocity = (8 * near - far) / (12 * step)
        return 0.5 * MASS * (velocity**2).sum()

    expected, _ = quad_vec(energy_density, 0, 1, epsabs=1e-10)
    actual = SoftArm(segments).kinetic_energy(torch.from_numpy(q), torch.from_numpy(v))
    assert float(actual) == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("segments", [1, 2, 3])
def test_potential_energy_is_elastic_less_the_weight_times_the_depth(segments, motion):
    q = motion[0][: 3 * segments]
    depth, _ = quad_vec(lambda s: backbone(q, s)[0][..., 2].sum(), 0, 1, epsabs=1e-12)
    expected = 0.5 * (q**2).sum() - MASS * GRAVITY * depth
    actual = SoftArm(segments).potential_energy(torch.from_numpy(q))
    assert float(actual) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("segments", [1, 2, 3])
def test_input_matrix_does_the_work_of_two_bending_torques_and_an_axial_force(segments, motion):
    """A_i^T v = (-omega_x, -omega_y, v_z) of tip i in its own frame."""
    q, v = (x[: 3 * segments] for x in motion)
    step = 1e-5
    _, ahead, turned_ahead = backbone(q + step * v, np.zeros(1))
    _, behind, turned_behind = backbone(q - step * v, np.zeros(1))
    _, _, rotations = backbone(q, np.zeros(1))
    expected = []
    for i, rotation in enumerate(rotations):
        linear = rotation.T @ (ahead[i] - behind[i]) / (2 * step)
        turn = Rotation.from_matrix(turned_behind[i].T @ turned_ahead[i]).as_rotvec()
        angular = turn / (2 * step)  # in the tip frame
        expected += [-angular[0], -angular[1], linear[2]]
    inputs = SoftArm(segments).input_matrix(torch.from_numpy(q)).numpy()
    np.testing.assert_allclose(inputs.T @ v, expected, rtol=0, atol=1e-8)


def test_default_quadrature_is_exact_to_twelve_digits_up_to_three_radians():
    generator = torch.Generator().manual_seed(0)
    angle = 2 * math.pi * torch.rand(6, 2, generator=generator, dtype=torch.float64)
    theta = torch.linspace(0, 3, 6, dtype=torch.float64)[:, None]
    q = torch.stack([theta * angle.cos(), theta * angle.sin(), 0 * angle + 0.1], -1).flatten(1)
    v = torch.rand(6, 6, generator=generator, dtype=torch.float64)
    default, fine = SoftArm(2), SoftArm(2, nodes=40)
    for values in (
        (default.mass_matrix(q), fine.mass_matrix(q)),
        (default.potential_force(q), fine.potential_force(q)),
        (default.potential_energy(q), fine.potential_energy(q)),
        (default.inverse_dynamics(q, v, v), fine.inverse_dynamics(q, v, v)),
    ):
        assert_near(*values, 1e-12)


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ([0, 0, 0, 0, 0, -0.2], [1, 1, 1, 1, 1, 1], r"segment 2 .*to 0 m.* positive length"),
        ([0, 0, 0, -5, -3, 0], [1, 1, 1, 1, 4, 1], r"segment 2 .* bends by up to 6.4 rad"),
    ],
)
def test_configurations_of_no_length_or_a_whole_turn_are_refused(low, high, message):
    arm = SoftArm(2)
    with pytest.raises(ValueError, match=message):
        arm.check_domain(low, high)
    arm.check_domain([-4, -4, -0.19, -4, -4, -0.19], [4, 4, 9, 4, 4, 9])
