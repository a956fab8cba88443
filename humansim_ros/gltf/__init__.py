"""glTF 2.0 files: what is in them, checked, and their skeletons."""

from humansim_ros.gltf.document import Animation, Gltf, Material, Primitive, TextureInfo
from humansim_ros.gltf.skeleton import GltfSkeleton

__all__ = ["Animation", "Gltf", "GltfSkeleton", "Material", "Primitive", "TextureInfo"]
