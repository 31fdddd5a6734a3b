"""Meshes to deep frame buffers and depth, on the host.

glTF, OBJ, PLY and OFF are read here, other files by trimesh; OpenGL or Embree finds the face
that every pixel shows; NumPy does the rest. World axes are the mesh file's own (y up in most of
them); cameras are this package's.
"""

from jaxfx.scene._defaults import default_camera, default_lights
from jaxfx.scene._load import from_trimesh, load
from jaxfx.scene._material import Material, Sampler
from jaxfx.scene._render import depth, gbuffer, material_ids, object_ids
from jaxfx.scene._scene import Scene, Viewpoint
from jaxfx.scene._still_life import still_life
from jaxfx.scene._transfer import transfer, visible


__all__ = [
    "Material",
    "Sampler",
    "Scene",
    "Viewpoint",
    "default_camera",
    "default_lights",
    "depth",
    "from_trimesh",
    "gbuffer",
    "load",
    "material_ids",
    "object_ids",
    "still_life",
    "transfer",
    "visible",
]
