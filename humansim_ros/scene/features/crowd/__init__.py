"""People who walk among each other."""
