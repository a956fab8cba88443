"""Model of a camera sensor: from rendered images to the images of a driver."""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.sensor.config import ChromaticAberration as ChromaticAberration
    from humansim_ros.sensor.config import Noise as Noise
    from humansim_ros.sensor.config import SensorConfig as SensorConfig
    from humansim_ros.sensor.config import Vignetting as Vignetting
    from humansim_ros.sensor.sensor import Sensor as Sensor

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "ChromaticAberration": "config",
        "Noise": "config",
        "Sensor": "sensor",
        "SensorConfig": "config",
        "Vignetting": "config",
    },
)
