"""Design a motion that identifies a rigid robot: python excite.py --help"""

from pinn_dyn.app.command import excite

if __name__ == "__main__":
    excite()
