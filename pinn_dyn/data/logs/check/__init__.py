"""Checks of a log: its clock, its values, its runs, and its inputs."""
