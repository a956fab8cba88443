"""Loose cloth and hair that swing."""
