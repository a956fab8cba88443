from humansim_ros.cameras import ChromaticAberration as ChromaticAberration
from humansim_ros.cameras import DepthSensor as DepthSensor
from humansim_ros.cameras import DepthSensorConfig as DepthSensorConfig
from humansim_ros.cameras import Noise as Noise
from humansim_ros.cameras import Sensor as Sensor
from humansim_ros.cameras import SensorConfig as SensorConfig
from humansim_ros.cameras import Vignetting as Vignetting
