"""Read untrusted files, write files whole or not at all: text, YAML, NumPy archives, images."""
