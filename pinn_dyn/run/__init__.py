"""Runs in Python, without Hydra: train, load, evaluate and export models in run folders."""
