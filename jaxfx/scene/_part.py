"""Parts: what a reader of mesh files returns, and how parts become a scene."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfx.scene._material import Material
from jaxfx.scene._scene import Scene


# The material of surfaces to which a file assigns none: a light grey.
UNASSIGNED = Material(color=(0.8, 0.8, 0.8))


class UnreadableError(Exception):
    """Why a file can't be read; `load` puts the file's name before it."""


class Part(NamedTuple):
    """Triangles of one object or of several, in world space.

    Fields are as in `Scene`; parts that share a name are one object. None in `normals` stands
    for flat faces, in `uv` and `second_uv` for no texture coordinates, in `colors` for white.
    """

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    materials: Sequence[Material]
    face_materials: Int[np.ndarray, " face"]
    names: Sequence[str]
    face_objects: Int[np.ndarray, " face"]
    normals: Float[np.ndarray, "face 3 3"] | None = None
    uv: Float[np.ndarray, "face 3 2"] | None = None
    second_uv: Float[np.ndarray, "face 3 2"] | None = None
    colors: Float[np.ndarray, "face 3 3"] | None = None


def unit(vectors: Float[np.ndarray, "*any 3"]) -> Float[np.ndarray, "*any 3"]:
    """Vectors divided by their length; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def flat_normals(
    vertices: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "face 3 3"]:
    """Each face's normal, of twice the face's area in length, at its three corners."""
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.repeat(np.cross(b - a, c - a)[:, None], 3, axis=1)


def turned_normals(
    normals: Float[np.ndarray, "*any 3"], matrices: Float[np.ndarray, "... 3 3"]
) -> Float[np.ndarray, "*any 3"]:
    """Unit normals of surfaces after the linear maps `matrices`: one, or one per normal.

    Normals transform by the inverse transpose. The cofactor matrix used here is that times the
    determinant, and exists for a singular matrix too. A normal of length 0 stays 0.
    """
    a, b, c = np.moveaxis(matrices, -1, 0)
    rows = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    return unit(np.sum([normals[..., i, None] * rows[i] for i in range(3)], axis=0))


def placed(part: Part, transform: Float[np.ndarray, "4 4"]) -> Part:
    """`part` under an affine transform. A mirroring one keeps the faces' fronts outside."""
    matrix = transform[:3, :3]
    part = part._replace(vertices=part.vertices @ matrix.T + transform[:3, 3])
    if part.normals is not None:
        part = part._replace(normals=turned_normals(part.normals, matrix))
    return flipped(part) if np.linalg.det(matrix) < 0 else part


def flipped(part: Part) -> Part:
    """`part` with every face's corners in reverse order, so that front and back change."""
    corners = {
        name: None if getattr(part, name) is None else getattr(part, name)[:, [0, 2, 1]]
        for name in ("faces", "normals", "uv", "second_uv", "colors")
    }
    return part._replace(**corners)


def unique_name(name: str, taken: set[str]) -> str:
    """`name`, or `name_1`, `name_2`, ... where `taken` has it; the result is added there."""
    unique, count = name, 0
    while unique in taken:
        count += 1
        unique = f"{name}_{count}"
    taken.add(unique)
    return unique


def assemble(parts: Iterable[Part], caller: str) -> Scene:
    """All parts as one scene; `ValueError` names `caller` where they hold no triangle."""
    parts = [part for part in parts if len(part.faces)]
    if not parts:
        raise ValueError(f"`{caller}` must hold at least one triangle, got none.")
    names: dict[str, int] = {}
    materials: dict[int, Material] = {}
    columns: dict[str, list[np.ndarray]] = {}
    offset = 0
    for part in parts:
        _require_finite(part, caller)
        count = len(part.faces)
        objects = [names.setdefault(name, len(names)) for name in part.names]
        for material in part.materials:
            materials.setdefault(id(material), material)
        index_of = {key: index for index, key in enumerate(materials)}
        material_indices = [index_of[id(material)] for material in part.materials]
        normals = part.normals
        if normals is None:
            normals = unit(flat_normals(part.vertices, part.faces))
        no_uv = np.zeros((count, 3, 2))
        for name, value in {
            "vertices": part.vertices,
            "faces": part.faces + offset,
            "normals": normals,
            "uv": no_uv if part.uv is None else part.uv,
            "second_uv": no_uv if part.second_uv is None else part.second_uv,
            "colors": np.ones((count, 3, 3)) if part.colors is None else part.colors,
            "face_materials": np.asarray(material_indices)[part.face_materials],
            "face_objects": np.asarray(objects)[part.face_objects],
        }.items():
            columns.setdefault(name, []).append(value)
        offset += len(part.vertices)
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    has_second = any(part.second_uv is not None for part in parts)
    return Scene(
        vertices=joined["vertices"],
        faces=joined["faces"],
        normals=joined["normals"],
        uv=joined["uv"],
        colors=joined["colors"],
        materials=tuple(materials.values()),
        face_materials=joined["face_materials"],
        names=tuple(names),
        face_objects=joined["face_objects"],
        second_uv=joined["second_uv"] if has_second else None,
    )


def _require_finite(part: Part, caller: str) -> None:
    """Raise `ValueError` that names the first vertex which is not finite."""
    wrong = ~np.isfinite(part.vertices).all(axis=1)
    if wrong.any():
        raise ValueError(
            f"`{caller}` must hold finite vertices, got {part.vertices[wrong][0]} at vertex "
            f"{wrong.argmax()} of {part.names[0]!r}; {wrong.sum()} of {wrong.size} are wrong."
        )
