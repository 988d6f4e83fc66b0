"""Learned dynamics: Lagrangian and Hamiltonian networks, their heads, and black boxes."""

from pinn_dyn.models.black_box import AccelerationMLP, NextStateMLP
from pinn_dyn.models.cholesky import (
    Bounded,
    CholeskyFactor,
    ConstantCholesky,
    FixedCholesky,
    NetworkCholesky,
    Positive,
    Positivity,
)
from pinn_dyn.models.drive_limits import DriveLimits
from pinn_dyn.models.drives import Drives, TorqueDrives
from pinn_dyn.models.friction import (
    AsymmetricCoulomb,
    CoulombFriction,
    Friction,
    LoadDependent,
    NoFriction,
    Stribeck,
)
from pinn_dyn.models.hamiltonian import HamiltonianNetwork
from pinn_dyn.models.initial_velocity import LearnedVelocity
from pinn_dyn.models.input_matrix import (
    ConstantInput,
    FixedInput,
    InputMatrix,
    NetworkInput,
    NoInput,
    NonlinearInput,
)
from pinn_dyn.models.known import KnownMechanics
from pinn_dyn.models.known_and_network import KnownAndNetwork
from pinn_dyn.models.known_system import KnownSystem
from pinn_dyn.models.lagrangian import LagrangianNetwork
from pinn_dyn.models.learned_constants import LearnedConstants
from pinn_dyn.models.mlp import MLP
from pinn_dyn.models.modes import Modes
from pinn_dyn.models.oscillators import CoupledOscillators
from pinn_dyn.models.potential import ChainPotential, NetworkPotential
from pinn_dyn.models.residual import NetworkResidual
from pinn_dyn.models.scales import Scales
from pinn_dyn.models.servo import Servo
from pinn_dyn.models.springs import ElasticJoints
from pinn_dyn.models.statistics import Statistics
from pinn_dyn.models.subspace_encoder import SubspaceEncoder

__all__ = [
    "MLP",
    "AccelerationMLP",
    "AsymmetricCoulomb",
    "Bounded",
    "ChainPotential",
    "CholeskyFactor",
    "ConstantCholesky",
    "ConstantInput",
    "CoulombFriction",
    "CoupledOscillators",
    "DriveLimits",
    "Drives",
    "ElasticJoints",
    "FixedCholesky",
    "FixedInput",
    "Friction",
    "HamiltonianNetwork",
    "InputMatrix",
    "KnownAndNetwork",
    "KnownMechanics",
    "KnownSystem",
    "LagrangianNetwork",
    "LearnedConstants",
    "LearnedVelocity",
    "LoadDependent",
    "Modes",
    "NetworkCholesky",
    "NetworkInput",
    "NetworkPotential",
    "NetworkResidual",
    "NextStateMLP",
    "NoFriction",
    "NoInput",
    "NonlinearInput",
    "Positive",
    "Positivity",
    "Scales",
    "Servo",
    "Statistics",
    "Stribeck",
    "SubspaceEncoder",
    "TorqueDrives",
]
