"""From images of a board to a calibrated rig: board features, projector coordinates, bundle adjustment."""
