"""Humans: mesh, skeleton, weights and outfits; read from files, or made from meshes and sliders."""

from humansim_ros.humans.human import Human
from humansim_ros.humans.loading import load_human, make_human

__all__ = ["Human", "load_human", "make_human"]
