"""How good a model is: roll-out errors, learned terms against true ones, tables and figures."""

from pinn_dyn.evaluation.figures import error_figure, save, terms_figure, trajectory_figure
from pinn_dyn.evaluation.learned_terms import TermComparison, compare_terms, fit_factor
from pinn_dyn.evaluation.log_figures import cleaning_figure
from pinn_dyn.evaluation.metrics import RolloutMetrics, diverged_trajectories, rollout_metrics
from pinn_dyn.evaluation.prediction import Prediction, predict_trajectories, predict_windows
from pinn_dyn.evaluation.tables import (
    RunResult,
    format_table,
    grouped_table,
    summary_table,
    write_table,
)
from pinn_dyn.evaluation.validation import RolloutFigures, RolloutValidator

__all__ = [
    "Prediction",
    "RolloutFigures",
    "RolloutMetrics",
    "RolloutValidator",
    "RunResult",
    "TermComparison",
    "cleaning_figure",
    "compare_terms",
    "diverged_trajectories",
    "error_figure",
    "fit_factor",
    "format_table",
    "grouped_table",
    "predict_trajectories",
    "predict_windows",
    "rollout_metrics",
    "save",
    "summary_table",
    "terms_figure",
    "trajectory_figure",
    "write_table",
]
