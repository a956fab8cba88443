"""Readers of estimates: one module for each family of formats."""
