"""Calibration formats, one module per family of formats; ``all_formats.py`` has the table."""
