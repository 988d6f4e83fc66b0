"""Control on a mechanical system, true or learned: laws, references, closed loop, stability."""

from pinn_dyn.control.contracts import Controller, Motion, Plant, Reference
from pinn_dyn.control.record import ClosedLoopRecord

__all__ = ["ClosedLoopRecord", "Controller", "Motion", "Plant", "Reference"]
