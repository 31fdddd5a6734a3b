"""Meshes rendered to deep frame buffers, depth and ids, on the host.

| I want | call |
|---|---|
| a scene from a file | `load` (glTF, OBJ, PLY, OFF; others by trimesh) |
| a scene from a mesh in memory | `from_trimesh`, or `Scene` with arrays |
| a scene without any file | `still_life` |
| a camera and lights that suit it | `default_camera`, `default_lights` |
| shading parameters to light with `jaxfx.relight` | `gbuffer` |
| depth alone: for `jaxfx.dof`, or a shadow map | `depth` |
| the surface behind the first one | `gbuffer` or `depth` with `layer_index=1` |
| what mirrors and clear bodies show | `gbuffer_along`, of `relight.mirrored` or `.refracted` |
| masks of objects or materials | `object_ids`, `material_ids` |
| traced shadows | `visible` |
| where to put few cameras that see what many see | `plan_views` |
| bounces of indirect light | `transfer`, then `relight.indirect` |
| shadows of light from all around | `occlusion`, a visibility of `relight` |

OpenGL or Embree finds the face that every pixel shows; NumPy does the rest. Nothing here can be
differentiated or traced. World axes are the mesh file's (y up in most of them); cameras are
those of `jaxfx`.
"""

from jaxfx.scene._along import gbuffer_along
from jaxfx.scene._defaults import default_camera, default_lights
from jaxfx.scene._load import from_trimesh, load
from jaxfx.scene._material import Material, Sampler
from jaxfx.scene._occlusion import occlusion
from jaxfx.scene._plan import ViewPlan, plan_views
from jaxfx.scene._render import depth, gbuffer, material_ids, object_ids
from jaxfx.scene._scene import Scene, Viewpoint
from jaxfx.scene._still_life import still_life
from jaxfx.scene._transfer import transfer, visible


__all__ = [
    "Material",
    "Sampler",
    "Scene",
    "ViewPlan",
    "Viewpoint",
    "default_camera",
    "default_lights",
    "depth",
    "from_trimesh",
    "gbuffer",
    "gbuffer_along",
    "load",
    "material_ids",
    "object_ids",
    "occlusion",
    "plan_views",
    "still_life",
    "transfer",
    "visible",
]
