from humansim_ros.cameras.camera.camera import Camera as Camera
from humansim_ros.cameras.camera.ideal import idealize as idealize
from humansim_ros.cameras.formats.calibration import read_calibration as read_calibration
from humansim_ros.cameras.formats.writing import write_calibration as write_calibration
from humansim_ros.data.api import evaluate as evaluate
from humansim_ros.data.api import export as export
from humansim_ros.data.api import record as record
from humansim_ros.errors import HumansimError as HumansimError
from humansim_ros.errors import HumansimWarning as HumansimWarning
from humansim_ros.files.mesh.load import read_mesh as read_mesh
from humansim_ros.files.mesh.mesh import Mesh as Mesh
from humansim_ros.motion.body.kinematics import Motion as Motion
from humansim_ros.motion.files.bvh import read_bvh as read_bvh
from humansim_ros.motion.files.bvh import write_bvh as write_bvh
from humansim_ros.motion.files.files import read_motion as read_motion
from humansim_ros.people.humans.human import Human as Human
from humansim_ros.people.loading.loading import load_human as load_human
from humansim_ros.render.interface.channels import View as View
from humansim_ros.scene.core.frame import Frame as Frame
from humansim_ros.scene.core.scene import Scene as Scene
from humansim_ros.scene.core.simulation import Simulation as Simulation

__version__: str
