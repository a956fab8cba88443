from humansim_ros.files import Material as Material
from humansim_ros.files import Mesh as Mesh
from humansim_ros.files import read_mesh as read_mesh
