"""Control a robot by a learned model: python control.py --help"""

from pinn_dyn.app.command import control

if __name__ == "__main__":
    control()
