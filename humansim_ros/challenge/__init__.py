"""The crash test of trackers: a suite of difficulties, its runs, their table and their picture."""
