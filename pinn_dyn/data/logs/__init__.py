"""Logs of robots: columns, units, cleaning steps, checks and the data source."""

from pinn_dyn.data.logs.clock import Deduplicate, Resample, RowClock, SplitGaps
from pinn_dyn.data.logs.columns import Columns
from pinn_dyn.data.logs.common import common_motions
from pinn_dyn.data.logs.delay import DelayCurve, agreed_delays, input_delays
from pinn_dyn.data.logs.errors import LogError
from pinn_dyn.data.logs.filters import (
    Butterworth,
    InputRates,
    MovingAverage,
    PolynomialFit,
    SavitzkyGolayVelocity,
)
from pinn_dyn.data.logs.input_delay import InputDelay
from pinn_dyn.data.logs.pieces import Cleaned
from pinn_dyn.data.logs.recording import Recording
from pinn_dyn.data.logs.repairs import InterpolateHeld, RemoveJumps, SubtractStart
from pinn_dyn.data.logs.repeats import repeat_floor
from pinn_dyn.data.logs.source import LogSource
from pinn_dyn.data.logs.splits import Part
from pinn_dyn.data.logs.step import Step
from pinn_dyn.data.logs.units import UNITS

__all__ = [
    "UNITS",
    "Butterworth",
    "Cleaned",
    "Columns",
    "Deduplicate",
    "DelayCurve",
    "InputDelay",
    "InputRates",
    "InterpolateHeld",
    "LogError",
    "LogSource",
    "MovingAverage",
    "Part",
    "PolynomialFit",
    "Recording",
    "RemoveJumps",
    "Resample",
    "RowClock",
    "SavitzkyGolayVelocity",
    "SplitGaps",
    "Step",
    "SubtractStart",
    "agreed_delays",
    "common_motions",
    "input_delays",
    "repeat_floor",
]
