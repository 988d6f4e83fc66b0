"""Self-contained HTML pages of an evaluation and of a control run, with interactive figures."""

from pinn_dyn.evaluation.report.control_page import (
    StabilityResult,
    control_report,
    measured_model_report,
)
from pinn_dyn.evaluation.report.page import Origin
from pinn_dyn.evaluation.report.prediction_page import prediction_report

__all__ = [
    "Origin",
    "StabilityResult",
    "control_report",
    "measured_model_report",
    "prediction_report",
]
