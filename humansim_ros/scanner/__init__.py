"""Laser scanners: scan patterns, intersection of rays with moving surfaces, and what is measured of them."""
