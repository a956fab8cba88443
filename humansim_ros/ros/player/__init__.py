"""The parts that the motion player consists of: real time, motions, services."""
