"""Files that trimesh reads, and its meshes in memory, as parts of a scene."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfx._extras import needs
from jaxfx.io import linear_from_srgb
from jaxfx.scene._material import Material
from jaxfx.scene._part import UNASSIGNED, Part, UnreadableError, placed
from jaxfx.scene.formats._images import pillow_codes


_ARCHIVES = (".zip", ".gz", ".bz2", ".xz", ".tar", ".tgz")


def read(path: Path, data: bytes) -> tuple[list[Part], set[str]]:
    """The parts of a file that trimesh reads; trimesh does not say what it leaves out."""
    with needs("scene"):
        import trimesh

    if path.suffix.lower() in _ARCHIVES:
        raise UnreadableError("it is an archive: unpack it")
    smooth = False if path.suffix.lower() == ".stl" else None  # STL has no vertex normals.
    return list(parts(trimesh.load_scene(path, process=False), smooth=smooth)), set()


def parts(content: Any, *, smooth: bool | None) -> Iterator[Part]:
    """The parts of a `trimesh.Scene`: every instance of a triangle mesh; no points or curves.

    `smooth` is as in `scene.from_trimesh`.
    """
    with needs("scene"):
        import trimesh

    for node in content.graph.nodes_geometry:
        transform, key = content.graph[node]
        mesh = content.geometry[key]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            part = _part(str(node), mesh, smooth)
            yield placed(part, np.asarray(transform, np.float64))


def _part(name: str, mesh: Any, smooth: bool | None) -> Part:
    """A mesh as one object, in its own space."""
    faces = np.asarray(mesh.faces)
    materials, index = _materials(mesh)
    return Part(
        np.asarray(mesh.vertices, np.float64),
        faces,
        materials,
        index,
        [name],
        np.zeros(len(faces), np.intp),
        _normals(mesh, smooth),
        _uv(mesh),
        None,
        _colors(mesh),
    )


def _normals(mesh: Any, smooth: bool | None) -> Float[np.ndarray, "face 3 3"] | None:
    """The vertex normals at the corners, or None for flat faces.

    With `smooth` None they are used only if the mesh came with normals. trimesh stores those
    and the ones that it computes itself in one place: normals that differ from what it computes
    for the same faces are taken for the mesh's.
    """
    with needs("scene"):
        import trimesh

    if smooth is False:
        return None
    # Of a copy: `mesh` would keep the normals that it computes.
    normals = mesh.copy(include_cache=True).vertex_normals
    if smooth is None:
        computed = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
        if np.allclose(normals, computed, atol=1e-5, equal_nan=True):
            return None
    return np.nan_to_num(normals)[mesh.faces]


def _uv(mesh: Any) -> Float[np.ndarray, "face 3 2"] | None:
    """The corners' texture coordinates, or None."""
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or np.shape(uv)[0] != len(mesh.vertices):
        return None
    uv = np.nan_to_num(np.asarray(uv, np.float64)[:, :2], posinf=0, neginf=0)
    return uv[mesh.faces]


def _color_kind(mesh: Any) -> str | None:
    """Whether a mesh has colours per "face" or per "vertex", or neither (None).

    trimesh hands out default colours, and regards them as the mesh's once a caller has changed
    one; `kind` shows that only after the colours have been asked for again.
    """
    for name in ("face_colors", "vertex_colors"):
        getattr(mesh.visual, name, None)
    return mesh.visual.kind


def _colors(mesh: Any) -> Float[np.ndarray, "face 3 3"] | None:
    """The corners' linear RGB, or None."""
    kind = _color_kind(mesh)
    if kind == "face":
        colors = linear_from_srgb(_unit_rgb(mesh.visual.face_colors))
        return np.repeat(colors[:, None], 3, axis=1)
    if kind == "vertex":
        _require_bytes(mesh)
        return linear_from_srgb(_unit_rgb(mesh.visual.vertex_colors))[mesh.faces]
    colors = getattr(mesh.visual, "vertex_attributes", {}).get("color")
    if colors is not None and len(colors) == len(mesh.vertices):
        return linear_from_srgb(_unit_rgb(colors))[mesh.faces]
    return None


def _require_bytes(mesh: Any) -> None:
    """Refuse a PLY file's 16-bit colours, of which trimesh keeps the low bytes alone."""
    vertex = mesh.metadata.get("_ply_raw", {}).get("vertex", {})
    dtype = np.dtype(vertex.get("properties", {}).get("red", "u1"))
    if dtype.kind in "iu" and dtype != np.uint8:
        codes = np.ravel(vertex["data"]["red"]).astype(np.uint8)
        if np.array_equal(codes, mesh.visual.vertex_colors[:, 0]):
            raise UnreadableError(
                f"trimesh has cut its colours of {dtype} to bytes; `scene.load` reads the file"
            )


def _unit_rgb(colors: Any) -> Float[np.ndarray, "*any 3"]:
    """RGB in [0, 1], without alpha: integers are divided by their type's largest."""
    colors = np.asarray(colors)
    largest = np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else 1
    return colors[..., :3].astype(np.float64) / largest


def _materials(mesh: Any) -> tuple[list[Material], Int[np.ndarray, " face"]]:
    """The mesh's materials, and every face's index into them."""
    with needs("scene"):
        from trimesh.visual.material import MultiMaterial

    index = np.zeros(len(mesh.faces), np.int64)
    material = getattr(mesh.visual, "material", None)
    if material is None:
        return [Material() if _color_kind(mesh) in ("face", "vertex") else UNASSIGNED], index
    if not isinstance(material, MultiMaterial):
        return [_material(mesh, material)], index
    materials = [_material(mesh, m) for m in material.materials] or [UNASSIGNED]
    of_face = mesh.visual.face_materials
    return materials, index if of_face is None else np.asarray(of_face, np.int64)


def _material(mesh: Any, material: Any) -> Material:
    """One of trimesh's materials as ours."""
    with needs("scene"):
        from trimesh.visual.material import PBRMaterial

    has_uv = getattr(mesh.visual, "uv", None) is not None
    if isinstance(material, PBRMaterial):
        return _pbr(material, has_uv)
    return _simple(material, has_uv)


def _pbr(material: Any, has_uv: bool) -> Material:
    """A material in glTF's terms."""
    factor, metallic = material.baseColorFactor, material.metallicFactor
    roughness, texture = material.roughnessFactor, material.metallicRoughnessTexture
    return Material(
        color=(1.0, 1.0, 1.0) if factor is None else tuple(_unit_rgb(factor).tolist()),
        texture=_image(material.baseColorTexture) if has_uv else None,
        metallic=1.0 if metallic is None else float(np.clip(metallic, 0, 1)),
        roughness=1.0 if roughness is None else float(np.clip(roughness, 0, 1)),
        metallic_roughness=_image(texture) if has_uv else None,
        normal_map=_image(material.normalTexture) if has_uv else None,
        shader="ggx",
    )


def _simple(material: Any, has_uv: bool) -> Material:
    """A material in Phong's terms. An exponent n becomes the roughness sqrt(2 / (n + 2))."""
    texture = _image(material.image) if has_uv else None
    diffuse = material.kwargs.get("kd")
    if diffuse is None and not _is_default(material.diffuse):
        diffuse = _unit_rgb(material.diffuse)
    if diffuse is not None:
        color = tuple(linear_from_srgb(np.clip(np.asarray(diffuse, float)[:3], 0, 1)).tolist())
    else:
        color = UNASSIGNED.color if texture is None else (1.0, 1.0, 1.0)
    has_highlight = not _is_default(material.specular) and np.any(material.specular[:3])
    exponent = max(material.glossiness, 0.0) if has_highlight else 0.0
    return Material(color=color, texture=texture, roughness=(2 / (exponent + 2)) ** 0.5)


def _is_default(color: Any) -> bool:
    """Whether a colour is the one that trimesh fills in for a material without one."""
    with needs("scene"):
        from trimesh.visual.color import DEFAULT_COLOR

    return color is None or np.array_equal(color, DEFAULT_COLOR)


def _image(image: Any) -> np.ndarray | None:
    """A Pillow image as texels."""
    return None if image is None else pillow_codes(image, "of a material")
