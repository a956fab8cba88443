from humansim_ros.scene.features.robot.keys import ROBOT as ROBOT
from humansim_ros.scene.features.robot.robot import Robot as Robot
from humansim_ros.scene.features.scanners.scanner import SceneScanner as SceneScanner
from humansim_ros.scene.features.scanners.sweeps import LiveScanning as LiveScanning
from humansim_ros.scene.features.scanners.sweeps import Sweep as Sweep
from humansim_ros.scene.features.variety.feature import Variety as Variety
from humansim_ros.scene.features.variety.keys import PeopleConfig as PeopleConfig
