"""Poses of hands whose fingers no motion drives."""
