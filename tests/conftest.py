"""Settings for all tests."""

import torch

# The tests' tensors are small: threads beyond one only slow them down.
torch.set_num_threads(1)
