"""Data: excitation signals, simulated data sets, windows and the LightningDataModule."""

from pinn_dyn.data.datamodule import DynamicsData
from pinn_dyn.data.excitation import Chirp, Excitation, Mixture, MultiSine, Steps
from pinn_dyn.data.simulated import InitialStates, SimulatedSource
from pinn_dyn.data.simulation import SimulationError, simulate
from pinn_dyn.data.source import DataSource, Splits
from pinn_dyn.data.windows import Windows, draw_windows

__all__ = [
    "Chirp",
    "DataSource",
    "DynamicsData",
    "Excitation",
    "InitialStates",
    "Mixture",
    "MultiSine",
    "SimulatedSource",
    "SimulationError",
    "Splits",
    "Steps",
    "Windows",
    "draw_windows",
    "simulate",
]
