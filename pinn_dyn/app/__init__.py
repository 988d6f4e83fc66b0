"""The only room that knows Hydra: builds objects from configurations and runs the entry points."""
