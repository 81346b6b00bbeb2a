"""Property tests: the same examples for everybody, and no clock; ``HYPOTHESIS_PROFILE=explore`` looks for new ones."""

from __future__ import annotations

import os
import signal

from hypothesis import HealthCheck, settings

# One profile for all: of several, whichever folder is collected last would decide for every other.
settings.register_profile(
    "suite",
    max_examples=50,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture],
)
settings.register_profile("explore", deadline=None, max_examples=1000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "suite"))

# A suite that a shell runs in its background has SIGINT ignored, and every process it starts would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
