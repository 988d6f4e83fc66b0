"""Control of mechanical systems: laws, references, pipeline and closed loop."""

from pinn_dyn.control.adaptive import AdaptiveTracking
from pinn_dyn.control.closed_loop import ClosedLoopRecord, close_loop
from pinn_dyn.control.contracts import Motion, Plant, Reference, Stage, Step
from pinn_dyn.control.effects import Actuator, Sensor
from pinn_dyn.control.export import export_law
from pinn_dyn.control.helix import Helix
from pinn_dyn.control.latent_law import LatentLaw
from pinn_dyn.control.laws import (
    ComputedTorque,
    ModelBasedLaw,
    MotorPID,
    ProportionalDerivative,
    Regulation,
    Tracking,
)
from pinn_dyn.control.observer import DisturbanceObserver
from pinn_dyn.control.pipeline import Pipeline
from pinn_dyn.control.plants import SimulatorPlant, SystemPlant
from pinn_dyn.control.predictive import PredictiveControl
from pinn_dyn.control.references import PointToPoint, RandomSetPoints, SetPoint, Sines
from pinn_dyn.control.region import DataRegion, Guarded

__all__ = [
    "Actuator",
    "AdaptiveTracking",
    "ClosedLoopRecord",
    "ComputedTorque",
    "DataRegion",
    "DisturbanceObserver",
    "Guarded",
    "Helix",
    "LatentLaw",
    "ModelBasedLaw",
    "Motion",
    "MotorPID",
    "Pipeline",
    "Plant",
    "PointToPoint",
    "PredictiveControl",
    "ProportionalDerivative",
    "RandomSetPoints",
    "Reference",
    "Regulation",
    "Sensor",
    "SetPoint",
    "SimulatorPlant",
    "Sines",
    "Stage",
    "Step",
    "SystemPlant",
    "Tracking",
    "close_loop",
    "export_law",
]
