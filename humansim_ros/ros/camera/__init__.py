"""Parts of a camera node: publishers, calibration, pose."""
