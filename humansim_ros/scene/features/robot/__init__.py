"""The robot of a scene."""
