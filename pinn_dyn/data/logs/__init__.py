"""Logs of robots: readers, columns, units, cleaning steps, checks and the data source."""

from pinn_dyn.data.logs.clock import Deduplicate, InputDelay, Resample, SplitGaps
from pinn_dyn.data.logs.columns import UNITS, Columns
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.filters import (
    Butterworth,
    InputRates,
    MovingAverage,
    RemoveJumps,
    SavitzkyGolayVelocity,
)
from pinn_dyn.data.logs.measurement import Measurement
from pinn_dyn.data.logs.pieces import Cleaned
from pinn_dyn.data.logs.readers import READERS
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.source import LogSource
from pinn_dyn.data.logs.special_steps import (
    InterpolateHeld,
    PolynomialFit,
    RowClock,
    SubtractStart,
)
from pinn_dyn.data.logs.splits import Part
from pinn_dyn.data.logs.stamps import Clock
from pinn_dyn.data.logs.step import Step, window_samples
from pinn_dyn.data.logs.table import Request, Table

__all__ = [
    "READERS",
    "UNITS",
    "Butterworth",
    "Cleaned",
    "Clock",
    "Columns",
    "Deduplicate",
    "InputDelay",
    "InputRates",
    "InterpolateHeld",
    "LogError",
    "LogSource",
    "Measurement",
    "MovingAverage",
    "Part",
    "PolynomialFit",
    "Recording",
    "RemoveJumps",
    "Request",
    "Resample",
    "RowClock",
    "SavitzkyGolayVelocity",
    "SplitGaps",
    "Step",
    "SubtractStart",
    "Table",
    "window_samples",
]
