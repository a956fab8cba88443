"""Lockstep: the next frame is sent when all members have finished the frame before."""
