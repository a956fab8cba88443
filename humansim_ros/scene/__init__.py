"""Scenes: the file that describes one, and the simulation that runs it."""

from humansim_ros.scene.scene import Actor, HumanState, Scene
from humansim_ros.scene.simulation import Frame, Simulation

__all__ = ["Actor", "Frame", "HumanState", "Scene", "Simulation"]
