"""Objects that people hold or take along."""
