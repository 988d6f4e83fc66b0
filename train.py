"""Train a learned dynamics model: python train.py --help"""

from pinn_dyn.app.config import main

if __name__ == "__main__":
    main("train")
