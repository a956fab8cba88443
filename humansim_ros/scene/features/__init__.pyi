from humansim_ros.scene.features.robot import ROBOT as ROBOT
from humansim_ros.scene.features.robot.feature import read_robot as read_robot
from humansim_ros.scene.features.scanners.feature import LiveScanning as LiveScanning
from humansim_ros.scene.features.scanners.feature import SceneScanner as SceneScanner
from humansim_ros.scene.features.scanners.feature import Sweep as Sweep
from humansim_ros.scene.features.variety.feature import Variety as Variety
