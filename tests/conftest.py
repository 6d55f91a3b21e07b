"""Processes of tests have one thread each, as they share few cores: many small operations take
longer by two. Set before numpy is imported; what a test starts inherits it."""

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
