"""Compare trained models on unseen test trajectories: python evaluate.py --help"""

from pinn_dyn.app.config import main

if __name__ == "__main__":
    main("evaluate")
