"""Control a robot by a learned model: python control.py --help"""

from pinn_dyn.app.config import main
from pinn_dyn.app.control import control

if __name__ == "__main__":
    main(control, "control")
