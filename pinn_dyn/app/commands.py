"""Console commands of an installed package; in a checkout train.py and the others do the same."""

from pinn_dyn.app.config import main


def train() -> None:
    """``pinn-dyn-train``: train a learned dynamics model."""
    main("train")


def evaluate() -> None:
    """``pinn-dyn-evaluate``: compare trained models on unseen test trajectories."""
    main("evaluate")


def control() -> None:
    """``pinn-dyn-control``: control a robot by a learned model."""
    main("control")


def gather() -> None:
    """``pinn-dyn-gather``: gather the runs of a sweep into one table."""
    main("gather")
