"""Meshes of trimesh as parts of a scene."""

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
    """The parts of a file that trimesh reads."""
    with needs("scene"):
        import trimesh

    if path.suffix.lower() in _ARCHIVES:
        raise UnreadableError("it is an archive: unpack it")
    smooth = False if path.suffix.lower() == ".stl" else None  # which has no vertices' normals
    return list(parts(trimesh.load_scene(path, process=False), smooth=smooth)), set()


def parts(content: Any, *, smooth: bool | None) -> Iterator[Part]:
    """Every instance of a triangle mesh; points and curves are passed over."""
    with needs("scene"):
        import trimesh

    for node in content.graph.nodes_geometry:
        transform, key = content.graph[node]
        mesh = content.geometry[key]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            part = _part(str(node), mesh, smooth)
            yield placed(part, np.asarray(transform, np.float64))


def _part(name: str, mesh: Any, smooth: bool | None) -> Part:
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
    """The vertices' normals at the corners; with None, only those that were given to the mesh.

    trimesh keeps given normals and those it made itself in one place. Given ones are told by
    not being what it makes of the same faces.
    """
    with needs("scene"):
        import trimesh

    if smooth is False:
        return None
    normals = mesh.copy(
        include_cache=True
    ).vertex_normals  # asked of `mesh`, it would keep them
    if smooth is None:
        made = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
        if np.allclose(normals, made, atol=1e-5, equal_nan=True):
            return None
    return np.nan_to_num(normals)[mesh.faces]


def _uv(mesh: Any) -> Float[np.ndarray, "face 3 2"] | None:
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or np.shape(uv)[0] != len(mesh.vertices):
        return None
    uv = np.nan_to_num(np.asarray(uv, np.float64)[:, :2], posinf=0, neginf=0)
    return uv[mesh.faces]


def _kind(mesh: Any) -> str | None:
    """Whether colours are of faces or of vertices.

    trimesh makes up colours where they are asked for, and takes them for the mesh's own once
    one of them is changed; but only when they are asked for again.
    """
    for name in ("face_colors", "vertex_colors"):
        getattr(mesh.visual, name, None)
    return mesh.visual.kind


def _colors(mesh: Any) -> Float[np.ndarray, "face 3 3"] | None:
    kind = _kind(mesh)
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
    """Refuse what is left of a PLY file's 16 bits, where it can be told."""
    read = mesh.metadata.get("_ply_raw", {}).get("vertex", {})
    kind = np.dtype(read.get("properties", {}).get("red", "u1"))
    if kind.kind in "iu" and kind != np.uint8:
        codes = np.ravel(read["data"]["red"]).astype(np.uint8)
        if np.array_equal(codes, mesh.visual.vertex_colors[:, 0]):
            raise UnreadableError(
                f"trimesh has cut its colours of {kind} to bytes; `scene.load` reads the file"
            )


def _unit_rgb(colors: Any) -> Float[np.ndarray, "*any 3"]:
    colors = np.asarray(colors)
    top = np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else 1
    return colors[..., :3].astype(np.float64) / top


def _materials(mesh: Any) -> tuple[list[Material], Int[np.ndarray, " face"]]:
    """The mesh's materials, and every face's index into them."""
    with needs("scene"):
        from trimesh.visual.material import MultiMaterial

    index = np.zeros(len(mesh.faces), np.int64)
    material = getattr(mesh.visual, "material", None)
    if material is None:
        return [Material() if _kind(mesh) in ("face", "vertex") else UNASSIGNED], index
    if not isinstance(material, MultiMaterial):
        return [_material(mesh, material)], index
    found = [_material(mesh, each) for each in material.materials]
    chosen = mesh.visual.face_materials
    return found or [UNASSIGNED], index if chosen is None else np.asarray(chosen, np.int64)


def _material(mesh: Any, material: Any) -> Material:
    with needs("scene"):
        from trimesh.visual.material import PBRMaterial

    has_uv = getattr(mesh.visual, "uv", None) is not None
    if isinstance(material, PBRMaterial):
        return _pbr(material, has_uv)
    return _simple(material, has_uv)


def _pbr(material: Any, has_uv: bool) -> Material:
    factor, metallic = material.baseColorFactor, material.metallicFactor
    roughness, both = material.roughnessFactor, material.metallicRoughnessTexture
    return Material(
        color=(1.0, 1.0, 1.0) if factor is None else tuple(_unit_rgb(factor).tolist()),
        texture=_image(material.baseColorTexture) if has_uv else None,
        metallic=1.0 if metallic is None else float(np.clip(metallic, 0, 1)),
        roughness=1.0 if roughness is None else float(np.clip(roughness, 0, 1)),
        metallic_roughness=_image(both) if has_uv else None,
        normal_map=_image(material.normalTexture) if has_uv else None,
    )


def _simple(material: Any, has_uv: bool) -> Material:
    texture = _image(material.image) if has_uv else None
    given = material.kwargs.get("kd")
    if given is None and not _is_default(material.diffuse):
        given = _unit_rgb(material.diffuse)
    if given is not None:
        color = tuple(linear_from_srgb(np.clip(np.asarray(given, float)[:3], 0, 1)).tolist())
    else:
        color = UNASSIGNED.color if texture is None else (1.0, 1.0, 1.0)
    shines = not _is_default(material.specular) and np.any(material.specular[:3])
    exponent = max(material.glossiness, 0.0) if shines else 0.0
    return Material(color=color, texture=texture, roughness=(2 / (exponent + 2)) ** 0.5)


def _is_default(color: Any) -> bool:
    """Whether trimesh filled this in for a material that says nothing."""
    with needs("scene"):
        from trimesh.visual.color import DEFAULT_COLOR

    return color is None or np.array_equal(color, DEFAULT_COLOR)


def _image(image: Any) -> np.ndarray | None:
    return None if image is None else pillow_codes(image, "of a material")
