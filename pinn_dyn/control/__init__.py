"""Control on a mechanical system, true or learned: laws, references, closed loop, stability."""

from pinn_dyn.control.adaptive import AdaptiveTracking
from pinn_dyn.control.closed_loop import close_loop
from pinn_dyn.control.continuous_loop import close_loop_continuous
from pinn_dyn.control.contracts import Controller, Motion, Plant, Reference
from pinn_dyn.control.dead_time import DelayCompensation
from pinn_dyn.control.effects import Actuator, Sensor
from pinn_dyn.control.export import export_law
from pinn_dyn.control.helix import Helix
from pinn_dyn.control.latent_law import LatentLaw
from pinn_dyn.control.latent_plan import LatentPlan
from pinn_dyn.control.laws import (
    ComputedTorque,
    ModelBasedLaw,
    ProportionalDerivative,
    Regulation,
    Tracking,
)
from pinn_dyn.control.motor_pid import MotorPID
from pinn_dyn.control.observer import DisturbanceObserver
from pinn_dyn.control.plants import SimulatorPlant, SystemPlant
from pinn_dyn.control.predictive import PredictiveControl
from pinn_dyn.control.record import ClosedLoopRecord
from pinn_dyn.control.references import PointToPoint, RandomSetPoints, SetPoint, Sines
from pinn_dyn.control.region import DataRegion, Guarded
from pinn_dyn.control.stability import certify, fit_factor, term_conditions
from pinn_dyn.control.stability_report import stability_report
from pinn_dyn.control.steady_state import predict_steady_state, required_gain

__all__ = [
    "Actuator",
    "AdaptiveTracking",
    "ClosedLoopRecord",
    "ComputedTorque",
    "Controller",
    "DataRegion",
    "DelayCompensation",
    "DisturbanceObserver",
    "Guarded",
    "Helix",
    "LatentLaw",
    "LatentPlan",
    "ModelBasedLaw",
    "Motion",
    "MotorPID",
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
    "SystemPlant",
    "Tracking",
    "certify",
    "close_loop",
    "close_loop_continuous",
    "export_law",
    "fit_factor",
    "predict_steady_state",
    "required_gain",
    "stability_report",
    "term_conditions",
]
