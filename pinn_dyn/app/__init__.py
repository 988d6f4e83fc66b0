"""The only room that knows Hydra: composes configurations and runs the entry points."""
