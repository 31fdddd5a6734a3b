"""Mesh files, and meshes in memory, to scenes."""

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
    """Read a mesh file, with its node transforms, textures and colours.

    glTF, GLB, OBJ with MTL, PLY and OFF are read here; STL and the rest by trimesh.
    `docs/meshes.md` lists what of each format is honoured, refused and left out; what is left
    out of a file is also told to the logger `jaxfx.scene`, in one message. Images and the
    colours of OBJ and PLY files are taken to be sRGB; glTF's factors and vertex colours are
    linear, as its standard says. An OBJ material's exponent Ns becomes the roughness
    sqrt(2 / (Ns + 2)), and 1 where it has no highlight.

    **Arguments:** `path`: the file. Other files that it names are looked for as it says,
    relative to the file that names them.

    **Returns:** the `Scene`, in the file's own axes and units.

    **Raises:** `FileNotFoundError` where there is no such file; `ValueError` that names it
    where it can't be read, needs an image, a library or an extension that is not there, has no
    triangle, or a number in it is not finite.

    **Gradient:** none: this runs on the host.

    Source: glTF 2.0 (Khronos 2017); Wavefront OBJ and MTL; PLY (Turk 1994); Geomview's OFF.
    """
    name = os.fspath(path)
    if not os.path.isfile(name):
        raise FileNotFoundError(f"`scene.load(path)` must be a file, got {name!r}.")
    file = Path(name)
    try:
        data = file.read_bytes()
        reader = gltf if is_glb(data) else _READERS.get(file.suffix.lower(), by_trimesh)
        with np.errstate(all="ignore"):  # what comes of it is not finite, and found
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
    """A scene from a `trimesh.Trimesh` or `trimesh.Scene` in memory.

    **Arguments:**

    - `mesh`: the mesh or scene, in any unit of length; it is read, not kept. Its vertex and
      face colours are taken to be sRGB. trimesh keeps them as bytes: of colours of more bits,
      as of uint16, it has lost the upper ones.
    - `smooth`: whether corners have `mesh.vertex_normals`; without it each face is flat. None:
      where the mesh was given normals of its own, which are told by not being those that
      trimesh makes of its faces.

    **Returns:** the `Scene`.

    **Raises:** `ValueError` for another type, no triangle, a number that is not finite, an
    image of neither 8 nor 16 bits, or colours of a PLY file that trimesh has cut to bytes.

    **Gradient:** none: this runs on the host.
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
