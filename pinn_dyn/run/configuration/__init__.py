"""Configurations: checks of keys, defaults, trust in folders of others, and built objects."""
