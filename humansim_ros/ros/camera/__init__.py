"""The parts that a camera node consists of: publishers, calibration, pose."""
