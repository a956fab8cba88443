"""Hands that reach for points, objects and other humans."""
