"""Humans: mesh, skeleton, weights and outfits; read from files, or made from meshes and sliders."""

from humansim_ros.humans.human import Human
from humansim_ros.humans.loading import load_human, make_human, make_person
from humansim_ros.humans.makehuman.population import draw_person

__all__ = ["Human", "draw_person", "load_human", "make_human", "make_person"]
