"""Surface meshes: OBJ and glTF files, materials, normals, textures."""

from humansim_ros.mesh.load import read_mesh
from humansim_ros.mesh.mesh import Material, Mesh

__all__ = ["Material", "Mesh", "read_mesh"]
