"""Console commands of an installed package; in a checkout train.py and the others do the same."""

from pinn_dyn.app.config import main


def train() -> None:
    """``pinn-dyn-train``: train a learned dynamics model."""
    from pinn_dyn.app.training import train

    main(train, "train")


def evaluate() -> None:
    """``pinn-dyn-evaluate``: compare trained models on unseen test trajectories."""
    from pinn_dyn.app.evaluation import evaluate

    main(evaluate, "evaluate")


def control() -> None:
    """``pinn-dyn-control``: control a robot by a learned model."""
    from pinn_dyn.app.control import control

    main(control, "control")


def gather() -> None:
    """``pinn-dyn-gather``: gather the runs of a sweep into one table."""
    from pinn_dyn.app.sweeps import gather

    main(gather, "gather")
