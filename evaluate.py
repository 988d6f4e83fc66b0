"""Compare trained models on unseen test trajectories: python evaluate.py --help"""

from pinn_dyn.app.command import evaluate

if __name__ == "__main__":
    evaluate()
