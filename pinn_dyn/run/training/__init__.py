"""Trainings: preparation, networks by Lightning, constants by least squares, and fits of logs."""
