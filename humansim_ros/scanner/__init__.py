"""Laser scanners: scan patterns, intersection of rays with moving surfaces, and the measurements."""
