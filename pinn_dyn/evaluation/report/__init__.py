"""Self-contained HTML pages of an evaluation, a control run and a log check."""

from pinn_dyn.evaluation.report.check_page import check_report
from pinn_dyn.evaluation.report.control_page import control_report
from pinn_dyn.evaluation.report.page import Origin

__all__ = ["Origin", "check_report", "control_report"]
