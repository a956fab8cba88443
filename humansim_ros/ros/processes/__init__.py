"""Processes of nodes: command lines, supervision, signals."""
