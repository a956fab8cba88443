"""The crash test of trackers: a suite of difficulties, its runs, and the results as table and picture."""
