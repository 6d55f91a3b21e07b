"""Processes of tests have one thread each, as they share few cores: many small operations take
longer by two. Set before numpy is imported; what a test starts inherits it."""

import os

from hypothesis import settings

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

# A busy machine makes no test fail by the time it takes
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")
