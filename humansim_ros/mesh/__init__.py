"""Surface meshes: OBJ and glTF files, materials, normals, textures."""

from humansim_ros.mesh.material import Material
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.mesh.obj import read_mesh

__all__ = ["Material", "Mesh", "read_mesh"]
