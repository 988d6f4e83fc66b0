"""Train a learned dynamics model: python train.py --help"""

from pinn_dyn.app.config import main
from pinn_dyn.app.training import train

if __name__ == "__main__":
    main(train, "train")
