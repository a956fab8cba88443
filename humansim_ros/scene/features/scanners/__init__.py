"""Laser scanners of a scene."""
