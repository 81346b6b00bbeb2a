"""Fuzzing that is the same every time, and small enough to run with everything else."""

from hypothesis import HealthCheck, settings

settings.register_profile(
    "schemas",
    max_examples=50,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("schemas")
