"""The furnished room."""
