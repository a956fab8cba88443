from humansim_ros.sensor.config import ChromaticAberration as ChromaticAberration
from humansim_ros.sensor.config import Noise as Noise
from humansim_ros.sensor.config import SensorConfig as SensorConfig
from humansim_ros.sensor.config import Vignetting as Vignetting
from humansim_ros.sensor.depth import DepthSensor as DepthSensor
from humansim_ros.sensor.depth_config import DepthSensorConfig as DepthSensorConfig
from humansim_ros.sensor.sensor import Sensor as Sensor
