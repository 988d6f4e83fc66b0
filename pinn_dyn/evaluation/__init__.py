"""How good a model is: roll-out errors, learned terms against true ones, tables and figures."""

from pinn_dyn.evaluation.animation import animate, pose_strip
from pinn_dyn.evaluation.calibration import (
    Calibration,
    calibration,
    calibration_figure,
    calibration_table,
    half_widths,
    interval_lines,
)
from pinn_dyn.evaluation.control_figures import (
    closed_loop_figure,
    controller_comparison_figure,
    steady_state_figure,
    tip_path_figure,
)
from pinn_dyn.evaluation.control_metrics import (
    ClosedLoopMetrics,
    closed_loop_metrics,
    comparison_table,
)
from pinn_dyn.evaluation.figures import (
    error_figure,
    spread_figure,
    terms_figure,
    trajectory_figure,
)
from pinn_dyn.evaluation.floors import KeepsVelocity, StandsStill, build_floors
from pinn_dyn.evaluation.learned_terms import TermComparison, compare_terms
from pinn_dyn.evaluation.log_figures import cleaning_figure
from pinn_dyn.evaluation.metrics import (
    RolloutMetrics,
    diverged_trajectories,
    left_data,
    member_metrics,
    rollout_metrics,
    state_squared_error,
)
from pinn_dyn.evaluation.png import save
from pinn_dyn.evaluation.prediction import (
    Prediction,
    common_stride,
    default_horizon,
    default_windows,
    predict_trajectories,
    predict_windows,
)
from pinn_dyn.evaluation.run_log import RunDescription
from pinn_dyn.evaluation.tables import (
    RunResult,
    beaten_by_floors,
    best_floor,
    format_table,
    grouped_table,
    summary_table,
    write_table,
)
from pinn_dyn.evaluation.torque import (
    TorqueError,
    part_shares,
    residual_share,
    torque_error,
)
from pinn_dyn.evaluation.validation import RolloutFigures, RolloutValidator, ValidationHistory

__all__ = [
    "Calibration",
    "ClosedLoopMetrics",
    "KeepsVelocity",
    "Prediction",
    "RolloutFigures",
    "RolloutMetrics",
    "RolloutValidator",
    "RunDescription",
    "RunResult",
    "StandsStill",
    "TermComparison",
    "TorqueError",
    "ValidationHistory",
    "animate",
    "beaten_by_floors",
    "best_floor",
    "build_floors",
    "calibration",
    "calibration_figure",
    "calibration_table",
    "cleaning_figure",
    "closed_loop_figure",
    "closed_loop_metrics",
    "common_stride",
    "compare_terms",
    "comparison_table",
    "controller_comparison_figure",
    "default_horizon",
    "default_windows",
    "diverged_trajectories",
    "error_figure",
    "format_table",
    "grouped_table",
    "half_widths",
    "interval_lines",
    "left_data",
    "member_metrics",
    "part_shares",
    "pose_strip",
    "predict_trajectories",
    "predict_windows",
    "residual_share",
    "rollout_metrics",
    "save",
    "spread_figure",
    "state_squared_error",
    "steady_state_figure",
    "summary_table",
    "terms_figure",
    "tip_path_figure",
    "torque_error",
    "trajectory_figure",
    "write_table",
]
