"""Random objects on the floor."""
