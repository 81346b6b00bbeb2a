"""The loop every service runs in: bus, shared memory, launcher, replay. It never computes."""
