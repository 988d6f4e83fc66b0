"""Physics-informed neural networks that learn robot dynamics obeying mechanics."""
