"""What a camera's sensor does to the picture that the renderer made."""

from humansim_ros.sensor.config import ChromaticAberration, Noise, SensorConfig, Vignetting
from humansim_ros.sensor.sensor import Sensor

__all__ = ["ChromaticAberration", "Noise", "Sensor", "SensorConfig", "Vignetting"]
