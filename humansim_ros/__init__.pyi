from humansim_ros.apps.api import evaluate as evaluate
from humansim_ros.apps.api import export as export
from humansim_ros.apps.api import record as record
from humansim_ros.camera.calibration import read_calibration as read_calibration
from humansim_ros.camera.calibration import write_calibration as write_calibration
from humansim_ros.camera.camera import Camera as Camera
from humansim_ros.camera.ideal import idealize as idealize
from humansim_ros.errors import HumansimError as HumansimError
from humansim_ros.errors import HumansimWarning as HumansimWarning
from humansim_ros.humans.human import Human as Human
from humansim_ros.humans.loading import load_human as load_human
from humansim_ros.mesh.load import read_mesh as read_mesh
from humansim_ros.mesh.mesh import Mesh as Mesh
from humansim_ros.motion.bvh import read_bvh as read_bvh
from humansim_ros.motion.bvh import write_bvh as write_bvh
from humansim_ros.motion.files import read_motion as read_motion
from humansim_ros.motion.kinematics import Motion as Motion
from humansim_ros.render.channels import View as View
from humansim_ros.scene.scene import Scene as Scene
from humansim_ros.scene.simulation import Frame as Frame
from humansim_ros.scene.simulation import Simulation as Simulation

__version__: str

def make_callable(folder: str) -> None: ...
