"""Gather the runs of a sweep into one table: python gather.py --help"""

from pinn_dyn.app.command import gather

if __name__ == "__main__":
    gather()
