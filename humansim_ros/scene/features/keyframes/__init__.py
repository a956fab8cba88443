"""Keyframes that move, turn and scale a human in the scene."""
