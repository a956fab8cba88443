"""Dressed humans from MakeHuman sliders: shape, clothes, hair and textures from its CC0 data."""

from humansim_ros.humans.makehuman.building import build
from humansim_ros.humans.makehuman.data import MakeHumanData, find_data
from humansim_ros.humans.makehuman.paint import Outfit
from humansim_ros.humans.makehuman.shape import MakeHumanConfig

__all__ = ["MakeHumanConfig", "MakeHumanData", "Outfit", "build", "find_data"]
