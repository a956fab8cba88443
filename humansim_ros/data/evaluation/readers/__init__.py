"""Readers of estimates. Each family of formats has a module."""
