"""Compare trained models on unseen test trajectories: python evaluate.py --help"""

from pinn_dyn.app.config import main
from pinn_dyn.app.evaluation import evaluate

if __name__ == "__main__":
    main(evaluate, "evaluate")
