"""Cameras and projectors, opened by URI; simulated ones beside real ones."""
