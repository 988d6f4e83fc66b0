"""Look at a log before a training: python check.py --help"""

from pinn_dyn.app.command import check

if __name__ == "__main__":
    check()
