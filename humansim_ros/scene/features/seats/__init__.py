"""Chairs and tables for people who sit where nothing is below them."""
