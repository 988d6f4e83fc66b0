"""Train a learned dynamics model: python train.py --help"""

from pinn_dyn.app.command import train

if __name__ == "__main__":
    train()
