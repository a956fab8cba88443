"""What is drawn once: static scenes, charts, light maps."""
