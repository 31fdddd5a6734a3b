"""Meshes to scenes: whatever trimesh reads."""

import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxfx.io import linear_from_srgb
from jaxfx.scene._scene import Material, Scene


_PLAIN = Material(color=(0.8, 0.8, 0.8))
_PICTURES = ("image", "baseColorTexture", "metallicRoughnessTexture", "normalTexture")
_Decode = Callable[[np.ndarray], np.ndarray]


def load(path: str | os.PathLike[str]) -> Scene:
    """Read a mesh file, with its node transforms, textures and colours.

    Anything that trimesh reads: OBJ, PLY, GLB, STL and more. Pictures and the colours of OBJ
    and PLY files are taken to be sRGB; glTF's factors and vertex colours are linear, as its
    standard says (trimesh rounds a factor to 1/255). Alpha, occlusion and emission are left
    out; so are OBJ's bump maps, whose heights have no unit there, and the `scale` of glTF's
    normal maps, of which trimesh keeps the picture alone: it counts as 1. An OBJ material's
    exponent Ns becomes the roughness sqrt(2 / (Ns + 2)), and 1 where its Ks is black.

    **Arguments:** `path`: the file.

    **Returns:** the `Scene`, in the file's own axes and units.

    **Raises:** `FileNotFoundError` where there is no such file; `ValueError` where trimesh
    can't read it, there is no triangle in it, or a vertex is not finite.

    **Gradient:** none: this runs on the host.

    Source: glTF 2.0 (Khronos 2017), 3.9; Wavefront OBJ and MTL.
    """
    import trimesh

    name = os.fspath(path)
    if not os.path.isfile(name):
        raise FileNotFoundError(f"`scene.load(path)` must be a file, got {name!r}.")
    try:
        content = trimesh.load_scene(name, process=False)
        for geometry in content.geometry.values():
            _decode_pictures(geometry)
    except Exception as error:
        raise ValueError(
            f"`scene.load(path)` must be a mesh that trimesh reads, got {name!r}: {error}"
        ) from error
    gltf = name.lower().endswith((".glb", ".gltf"))
    return _assemble(content, np.asarray if gltf else linear_from_srgb, f"scene.load({name!r})")


def from_trimesh(mesh: Any) -> Scene:
    """A scene from a `trimesh.Trimesh` or `trimesh.Scene` in memory.

    **Arguments:** `mesh`: the mesh or scene, in any unit of length; it is read, not kept. Its
    vertex and face colours are taken to be sRGB.

    **Returns:** the `Scene`.

    **Raises:** `ValueError` for another type, no triangle, or a vertex that is not finite.

    **Gradient:** none: this runs on the host.
    """
    import trimesh

    if isinstance(mesh, trimesh.Trimesh):
        mesh = trimesh.Scene(mesh)
    if not isinstance(mesh, trimesh.Scene):
        raise ValueError(
            "`scene.from_trimesh(mesh)` must be a `trimesh.Trimesh` or `trimesh.Scene`, "
            f"got {type(mesh).__name__}."
        )
    return _assemble(mesh, linear_from_srgb, "scene.from_trimesh(mesh)")


def _assemble(content: Any, decode: _Decode, caller: str) -> Scene:
    vertices, faces, normals, uv, colors = [], [], [], [], []
    materials, face_materials, names, face_objects = [], [], [], []
    offset = 0
    for name, mesh, transform in _meshes(content):
        wrong = ~np.isfinite(mesh.vertices).all(axis=1)
        if wrong.any():
            raise ValueError(
                f"`{caller}` must hold finite vertices, got {mesh.vertices[wrong][0]} at "
                f"vertex {wrong.argmax()} of {name!r}; {wrong.sum()} of {wrong.size} are wrong."
            )
        vertices.append(mesh.vertices @ transform[:3, :3].T + transform[:3, 3])
        triangles = np.asarray(mesh.faces)
        mirrored = np.linalg.det(transform[:3, :3]) < 0
        order = [0, 2, 1] if mirrored else [0, 1, 2]
        faces.append(triangles[:, order] + offset)
        offset += len(mesh.vertices)
        normals.append(_corner_normals(mesh, transform)[:, order])
        uv.append(_corner_uv(mesh)[:, order])
        colors.append(_corner_colors(mesh, decode)[:, order])
        found, index = _materials(mesh)
        face_materials.append(index + len(materials))
        materials += found
        face_objects.append(np.full(len(triangles), len(names)))
        names.append(name)
    if not names:
        raise ValueError(f"`{caller}` must hold at least one triangle, got none.")
    return Scene(
        vertices=np.concatenate(vertices),
        faces=np.concatenate(faces),
        normals=np.concatenate(normals),
        uv=np.concatenate(uv),
        colors=np.concatenate(colors),
        materials=tuple(materials),
        face_materials=np.concatenate(face_materials),
        names=tuple(names),
        face_objects=np.concatenate(face_objects),
    )


def _meshes(content: Any) -> Iterator[tuple[str, Any, Float[np.ndarray, "4 4"]]]:
    """Every instance of a triangle mesh with its pose; points and curves are passed over."""
    import trimesh

    for node in content.graph.nodes_geometry:
        transform, key = content.graph[node]
        mesh = content.geometry[key]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            yield str(node), mesh, np.asarray(transform, np.float64)


def _corner_normals(
    mesh: Any, transform: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "face 3 3"]:
    """The file's vertex normals, where it has them; else those of the faces."""
    if "vertex_normals" in mesh._cache:  # trimesh would make some up
        normals = np.nan_to_num(mesh.vertex_normals)[mesh.faces]
    else:
        corners = mesh.vertices[mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = np.repeat(normals[:, None], 3, axis=1)
    # The adjugate's transpose turns normals as the inverse's does, and bears a flat scaling.
    a, b, c = transform[:3, :3].T
    turned = normals @ np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    length = np.linalg.norm(turned, axis=-1, keepdims=True)
    return turned / np.where(length > 0, length, 1)


def _corner_uv(mesh: Any) -> Float[np.ndarray, "face 3 2"]:
    uv = getattr(mesh.visual, "uv", None)
    if uv is None or np.shape(uv)[0] != len(mesh.vertices):
        return np.zeros((len(mesh.faces), 3, 2))
    return np.nan_to_num(np.asarray(uv, np.float64)[:, :2])[mesh.faces]


def _corner_colors(mesh: Any, decode: _Decode) -> Float[np.ndarray, "face 3 3"]:
    if mesh.visual.kind == "face":
        return np.repeat(decode(_unit_rgb(mesh.visual.face_colors))[:, None], 3, axis=1)
    if mesh.visual.kind == "vertex":
        return decode(_unit_rgb(mesh.visual.vertex_colors))[mesh.faces]
    colors = getattr(mesh.visual, "vertex_attributes", {}).get("color")
    if colors is not None and len(colors) == len(mesh.vertices):
        return decode(_unit_rgb(colors))[mesh.faces]
    return np.ones((len(mesh.faces), 3, 3))


def _unit_rgb(colors: Any) -> Float[np.ndarray, "*any 3"]:
    colors = np.asarray(colors)
    top = np.iinfo(colors.dtype).max if np.issubdtype(colors.dtype, np.integer) else 1
    return colors[..., :3].astype(np.float64) / top


def _materials(mesh: Any) -> tuple[list[Material], Int[np.ndarray, " face"]]:
    """The mesh's materials, and every face's index into them."""
    from trimesh.visual.material import MultiMaterial

    index = np.zeros(len(mesh.faces), np.int64)
    material = getattr(mesh.visual, "material", None)
    if material is None:
        coloured = mesh.visual.kind in ("face", "vertex")
        return [Material() if coloured else _PLAIN], index
    if not isinstance(material, MultiMaterial):
        return [_material(mesh, material)], index
    found = [_material(mesh, each) for each in material.materials]
    chosen = mesh.visual.face_materials
    return found or [_PLAIN], index if chosen is None else np.asarray(chosen, np.int64)


def _material(mesh: Any, material: Any) -> Material:
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
        texture=_picture(material.baseColorTexture) if has_uv else None,
        metallic=1.0 if metallic is None else float(np.clip(metallic, 0, 1)),
        roughness=1.0 if roughness is None else float(np.clip(roughness, 0, 1)),
        metallic_roughness=_picture(both) if has_uv else None,
        normal_map=_picture(material.normalTexture) if has_uv else None,
    )


def _simple(material: Any, has_uv: bool) -> Material:
    texture = _picture(material.image) if has_uv else None
    given = material.kwargs.get("kd")
    if given is None and not _is_default(material.diffuse):
        given = _unit_rgb(material.diffuse)
    if given is not None:
        color = tuple(linear_from_srgb(np.clip(np.asarray(given, float)[:3], 0, 1)).tolist())
    else:
        color = _PLAIN.color if texture is None else (1.0, 1.0, 1.0)
    shines = not _is_default(material.specular) and np.any(material.specular[:3])
    exponent = max(material.glossiness, 0.0) if shines else 0.0
    return Material(color=color, texture=texture, roughness=(2 / (exponent + 2)) ** 0.5)


def _is_default(color: Any) -> bool:
    """Whether trimesh filled this in for a material that says nothing."""
    from trimesh.visual.color import DEFAULT_COLOR

    return color is None or np.array_equal(color, DEFAULT_COLOR)


def _picture(image: Any) -> UInt8[np.ndarray, "height width 3"] | None:
    if image is None:
        return None
    return np.asarray(image.convert("RGBA").convert("RGB"))


def _decode_pictures(geometry: Any) -> None:
    """Make PIL read the pictures now, so that a broken one is `load`'s error."""
    material = getattr(getattr(geometry, "visual", None), "material", None)
    for each in getattr(material, "materials", [material]):
        for name in _PICTURES:
            picture = getattr(each, name, None)
            if picture is not None:
                picture.load()
