"""Control a robot by a learned model: python control.py --help"""

from pinn_dyn.app.config import main

if __name__ == "__main__":
    main("control")
