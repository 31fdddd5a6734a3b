"""Scenes from mesh files, and from meshes in memory."""

import logging
import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxfx._extras import MissingExtraError, needs
from jaxfx.scene._part import UnreadableError, assemble
from jaxfx.scene._scene import Scene
from jaxfx.scene.formats import by_trimesh, gltf, obj, off, ply
from jaxfx.scene.formats._gltf_document import is_glb


_logger = logging.getLogger("jaxfx.scene")
_READERS = {
    ".gltf": gltf,
    ".glb": gltf,
    ".obj": obj,
    ".ply": ply,
    ".off": off,
}


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a mesh file with its node transforms, textures, materials and colours.

    glTF, GLB, OBJ with MTL, PLY and OFF are read here; STL and other formats by trimesh.

    **Arguments:** `path`: the file. Paths in it are relative to the file that holds them.

    **Returns:** the `Scene`, in the file's axes and units.

    **Raises:** `FileNotFoundError` where there is no such file; `ValueError` that names the
    file where it can't be read, an image, MTL file or extension that it needs is missing, it
    has no triangle, or a number in it is not finite.

    **Gradient:** none; the host side.

    **Example:**

    >>> import trimesh
    >>> from jaxfx import scene
    >>> _ = trimesh.creation.box((1, 2, 3)).export("box.ply")
    >>> scene.load("box.ply")
    Scene(12 triangles, 1 objects, 1 x 2 x 3)

    `docs/meshes.md` lists what of each format is read, refused and left out. What is left out
    of a file is logged to `jaxfx.scene`, in one message. Images and the colours of OBJ and PLY
    files are taken to be sRGB; glTF's factors and vertex colours are linear, by its standard.
    An OBJ material's exponent Ns becomes the roughness sqrt(2 / (Ns + 2)); without a highlight
    the roughness is 1.

    Source: glTF 2.0 (Khronos 2017); Wavefront OBJ and MTL; PLY (Turk 1994); Geomview's OFF.
    """
    name = os.fspath(path)
    if not os.path.isfile(name):
        raise FileNotFoundError(f"`scene.load(path)` must be a file, got {name!r}.")
    file = Path(name)
    try:
        data = file.read_bytes()
        reader = gltf if is_glb(data) else _READERS.get(file.suffix.lower(), by_trimesh)
        with np.errstate(all="ignore"):  # `assemble` refuses what is not finite.
            parts, ignored = reader.read(file, data)
    except MissingExtraError:
        raise
    except Exception as error:
        reason = error if isinstance(error, UnreadableError) else repr(error)
        raise ValueError(
            f"`scene.load(path)` must be a mesh that can be read, got {name!r}: {reason}"
        ) from error
    if ignored:
        _logger.warning("scene.load(%r): left out are %s", name, ", ".join(sorted(ignored)))
    with np.errstate(all="ignore"):
        return assemble(parts, f"scene.load({name!r})")


def from_trimesh(mesh: Any, *, smooth: bool | None = None) -> Scene:
    """A scene from a `trimesh.Trimesh` or `trimesh.Scene` in memory, with its materials.

    **Arguments:**

    - `mesh`: the mesh or scene, in any unit of length; it is read, not kept. Its vertex and
      face colours are taken to be sRGB. trimesh stores them as bytes: of wider colours, such as
      uint16, it has lost the upper bits.
    - `smooth`: True uses `mesh.vertex_normals` at the corners, False makes every face flat.
      None is True for a mesh that came with normals: those that differ from the ones which
      trimesh computes from the faces.

    **Returns:** the `Scene`.

    **Raises:** `ValueError` for another type, no triangle, a number that is not finite, an
    image of neither 8 nor 16 bits, or colours of a PLY file that trimesh has cut to bytes.

    **Gradient:** none; the host side.

    **Example:**

    >>> import trimesh
    >>> from jaxfx import scene
    >>> scene.from_trimesh(trimesh.creation.box((1, 2, 3)))
    Scene(12 triangles, 1 objects, 1 x 2 x 3)
    """
    with needs("scene"):
        import trimesh

    if isinstance(mesh, trimesh.Trimesh):
        mesh = trimesh.Scene(mesh)
    if not isinstance(mesh, trimesh.Scene):
        raise ValueError(
            "`scene.from_trimesh(mesh)` must be a `trimesh.Trimesh` or `trimesh.Scene`, "
            f"got {type(mesh).__name__}."
        )
    try:
        parts = list(by_trimesh.parts(mesh, smooth=smooth))
    except UnreadableError as error:
        raise ValueError(f"`scene.from_trimesh(mesh)` can't be taken over: {error}.") from error
    return assemble(parts, "scene.from_trimesh(mesh)")
