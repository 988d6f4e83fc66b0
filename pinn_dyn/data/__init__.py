"""Data sets: excitation signals, simulations, logs, windows and the LightningDataModule."""

from typing import TYPE_CHECKING

from pinn_dyn.data.datamodule import DynamicsData
from pinn_dyn.data.excitation import Chirp, Excitation, Mixture, MultiSine, Steps
from pinn_dyn.data.identity import data_changes, data_identity
from pinn_dyn.data.logs import Cleaned, LogError, LogSource
from pinn_dyn.data.robot import RobotSource
from pinn_dyn.data.robot_excitation import (
    RobotExcitation,
    TorqueMultiSine,
    TrackedMultiSine,
)
from pinn_dyn.data.simulated import InitialStates, SimulatedSource
from pinn_dyn.data.simulation import SimulationError, simulate
from pinn_dyn.data.source import DataSource, Splits, StoredSource, store
from pinn_dyn.data.windows import Windows, draw_windows
from pinn_dyn.lazy_imports import lazy_attributes

if TYPE_CHECKING:
    from pinn_dyn.data.lightning_data import LightningData

__all__ = [
    "Chirp",
    "Cleaned",
    "DataSource",
    "DynamicsData",
    "Excitation",
    "InitialStates",
    "LightningData",
    "LogError",
    "LogSource",
    "Mixture",
    "MultiSine",
    "RobotExcitation",
    "RobotSource",
    "SimulatedSource",
    "SimulationError",
    "Splits",
    "Steps",
    "StoredSource",
    "TorqueMultiSine",
    "TrackedMultiSine",
    "Windows",
    "data_changes",
    "data_identity",
    "draw_windows",
    "simulate",
    "store",
]

__getattr__ = lazy_attributes(__name__)
