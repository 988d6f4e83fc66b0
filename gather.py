"""Gather the runs of a sweep into one table: python gather.py --help"""

from pinn_dyn.app.config import main

if __name__ == "__main__":
    main("gather")
