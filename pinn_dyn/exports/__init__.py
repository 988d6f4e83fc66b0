"""Export models, control laws and observers as code for other programs."""
