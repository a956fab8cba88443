"""Read untrusted files, and write files atomically: text, YAML, NumPy archives, images."""
