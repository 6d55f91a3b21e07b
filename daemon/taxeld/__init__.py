"""taxeld: the daemon that turns touches of artificial skin into object poses."""

import os

__version__ = "0.1.0"

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")  # onnxruntime's wheels report home by default
