import os

# The matrices of the tests are small: threads beyond one only slow them down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
