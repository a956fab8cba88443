"""Edits of scenes and people."""
