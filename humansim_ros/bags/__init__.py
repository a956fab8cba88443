"""Bags of rosbag2 (MCAP, sqlite3): written in chunks, read, and finished after interruptions."""
