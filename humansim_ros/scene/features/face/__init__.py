"""Faces: expressions, speech, gazes, and the jaw."""
