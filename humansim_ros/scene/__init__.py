"""Scenes: the file that describes one, and the simulation that runs it."""

from humansim_ros.scene.actor import Actor, HumanState
from humansim_ros.scene.scene import Scene
from humansim_ros.scene.simulation import Frame, Simulation

__all__ = ["Actor", "Frame", "HumanState", "Scene", "Simulation"]
