from humansim_ros.files.mesh.load import read_mesh as read_mesh
from humansim_ros.files.mesh.mesh import Material as Material
from humansim_ros.files.mesh.mesh import Mesh as Mesh
