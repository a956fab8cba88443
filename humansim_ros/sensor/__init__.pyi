from humansim_ros.sensor.config import ChromaticAberration as ChromaticAberration
from humansim_ros.sensor.config import Noise as Noise
from humansim_ros.sensor.config import SensorConfig as SensorConfig
from humansim_ros.sensor.config import Vignetting as Vignetting
from humansim_ros.sensor.sensor import Sensor as Sensor
