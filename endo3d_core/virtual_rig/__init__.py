"""Frames with known truth: scenes, optics and motion of a simulated measuring endoscope."""
