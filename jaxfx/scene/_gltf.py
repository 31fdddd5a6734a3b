"""glTF files as parts of a scene, at rest.

Source: glTF 2.0 (Khronos 2017), 3.5 and 3.7; EXT_mesh_gpu_instancing; KHR_mesh_quantization.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfx.scene import _gltf_material
from jaxfx.scene._gltf_data import Document, take, vector
from jaxfx.scene._gltf_material import Materials
from jaxfx.scene._part import (
    Part,
    UnreadableError,
    flipped,
    placed,
    turned_normals,
    unique_name,
    unit,
)


_INSTANCES, _DRACO = "EXT_mesh_gpu_instancing", "KHR_draco_mesh_compression"
_HONOURED = {*_gltf_material.HONOURED, _INSTANCES, "KHR_mesh_quantization"}
_Matrix = Float[np.ndarray, "4 4"]


def read(path: Path, data: bytes) -> tuple[list[Part], set[str]]:
    """The parts of a glTF or GLB file's scene, and what of the file they leave out."""
    document = Document(path, data)
    required, used = (
        set(take(document.json, key, list, []))
        for key in ("extensionsRequired", "extensionsUsed")
    )
    if unknown := required - _HONOURED:
        raise UnreadableError(f"it requires {', '.join(sorted(unknown))}, which is not read")
    document.ignored.update(used - _HONOURED)
    if take(document.json, "animations", list, []):
        document.ignored.add("animations")
    return _Reader(document).parts(), document.ignored


class _Reader:
    """A document on its way to parts."""

    def __init__(self, document: Document):
        self.document = document
        self.materials = Materials(document)
        self.poses, self.children = self._poses()
        self.names: set[str] = set()

    def parts(self) -> list[Part]:
        found = []
        for index in self._drawn():
            node = self.document.item("nodes", index)
            extra = self.document.extensions(node, _INSTANCES)
            if "mesh" not in node:
                continue
            mesh = self.document.item("meshes", node["mesh"])
            name = take(node, "name", str, take(mesh, "name", str, f"node {index}"))
            if "skin" in node:
                if _INSTANCES in extra:
                    raise UnreadableError(f"node {index} has both a skin and instances")
                found += self._primitives(node, mesh, unique_name(name, self.names))
                continue
            poses = self._instances(extra[_INSTANCES]) if _INSTANCES in extra else [np.eye(4)]
            local = self._primitives(node, mesh, name)
            for pose in poses:
                names = [unique_name(name, self.names)]
                moved = (placed(part, self.poses[index] @ pose) for part in local)
                found += [part._replace(names=names) for part in moved]
        return found

    def _poses(self) -> tuple[dict[int, _Matrix], list[list[int]]]:
        """Every node's pose in the world, and its children."""
        count = len(take(self.document.json, "nodes", list, []))
        nodes = [self.document.item("nodes", index) for index in range(count)]
        children = [take(node, "children", list, []) for node in nodes]
        parents: dict[int, int] = {}
        for parent, below in enumerate(children):
            for child in below:
                self.document.item("nodes", child)
                if child in parents:
                    raise UnreadableError(f"node {child} is twice a child")
                parents[child] = parent
        local = [_local(node) for node in nodes]
        waiting = [(index, np.eye(4)) for index in range(count) if index not in parents]
        poses = {}
        while waiting:
            index, above = waiting.pop()
            poses[index] = above @ local[index]
            waiting += [(child, poses[index]) for child in children[index]]
        if len(poses) < count:
            raise UnreadableError("some nodes are their own ancestors")
        self.parents = parents
        return poses, children

    def _drawn(self) -> list[int]:
        """The nodes of the file's scene: each before those below it."""
        scenes = take(self.document.json, "scenes", list, [])
        if scenes or "scene" in self.document.json:
            chosen = self.document.item("scenes", take(self.document.json, "scene", int, 0))
            roots = take(chosen, "nodes", list, [])
        else:
            roots = [index for index in self.poses if index not in self.parents]
        for index in roots:
            self.document.item("nodes", index)
            if index in self.parents or roots.count(index) > 1:
                raise UnreadableError(
                    f"node {index} of the scene has a parent, or is in it twice"
                )
        found, waiting = [], list(reversed(roots))
        while waiting:
            index = waiting.pop()
            found.append(index)
            waiting += reversed(self.children[index])
        return found

    def _instances(self, record: Any) -> list[_Matrix]:
        attributes = take(record, "attributes", dict)
        rows = {
            key: self.document.accessor(attributes[key], widths=(width,))
            for key, width in (("TRANSLATION", 3), ("ROTATION", 4), ("SCALE", 3))
            if key in attributes
        }
        counts = {len(values) for values in rows.values()}
        if len(counts) != 1:
            raise UnreadableError(f"{_INSTANCES} has {counts or 'no'} instances")
        joined = np.concatenate(list(rows.values()), axis=1)
        # Two at one pose look like one, and would be a second layer of depth.
        _, first = np.unique(joined, axis=0, return_index=True)
        return [
            _composed(*(rows[key][i] if key in rows else None for key in _TRS))
            for i in np.sort(first)
        ]

    def _primitives(self, node: dict, mesh: dict, name: str) -> list[Part]:
        """A mesh's triangles, in its own space, or, of a skinned node, in the world's."""
        weights = take(node, "weights", list, take(mesh, "weights", list, []))
        found = []
        for record in take(mesh, "primitives", list):
            mode = take(record, "mode", int, 4)
            if mode in (0, 1, 2, 3):
                self.document.ignored.add("points and lines")
                continue
            primitive = _Primitive(self.document, record, weights)
            part = primitive.part(self.materials, name, mode)
            if "skin" in node:
                part = self._skinned(part, primitive, node["skin"])
            found.append(part)
        return found

    def _skinned(self, part: Part, primitive: "_Primitive", index: Any) -> Part:
        """`part` as its joints hold it, in the world: the pose of its own node is not used."""
        skin = self.document.item("skins", index)
        joints = take(skin, "joints", list)
        for joint in joints:
            self.document.item("nodes", joint)
        pose = np.stack([self.poses[joint] for joint in joints])
        if "inverseBindMatrices" in skin:
            stored = self.document.accessor(skin["inverseBindMatrices"], widths=(16,))
            if len(stored) < len(joints):
                raise UnreadableError(f"a skin has {len(stored)} matrices of {len(joints)}")
            pose = pose @ stored[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1)
        number, weight = primitive.influences(len(joints))
        blend = np.einsum("vj,vjab->vab", weight, pose[number])
        moved = np.einsum("vab,vb->va", blend[:, :3, :3], part.vertices) + blend[:, :3, 3]
        normals = part.normals
        if normals is not None:
            normals = turned_normals(normals, blend[part.faces, :3, :3])
        part = part._replace(vertices=moved, normals=normals)
        return flipped(part) if np.linalg.det(blend[:, :3, :3]).sum() < 0 else part


class _Primitive:
    """A primitive's attributes, as its morph targets change them."""

    def __init__(self, document: Document, record: dict, weights: list):
        self.document, self.record = document, record
        self.packed = document.extensions(record)
        self.attributes = take(record, "attributes", dict)
        self.targets = take(record, "targets", list, [])
        still = [0.0] * len(self.targets)
        self.weights = vector({"weights": weights or still}, "weights", still)
        self.count = len(self._rows("POSITION", 3)) if "POSITION" in self.attributes else 0

    def part(self, materials: Materials, name: str, mode: int) -> Part:
        if "POSITION" not in self.attributes:
            raise UnreadableError(f"a primitive of {name!r} has no POSITION")
        vertices = self.get("POSITION", 3)
        faces = _triangles(self._indices(), mode)
        material, sets = materials.get(self.record.get("material"))
        coordinates = [self._coordinates(number)[faces] for number in sets]
        if "normal_map" in material.samplers and "TANGENT" in self.attributes:
            self.document.ignored.add("tangents, which follow from texture coordinates")
        colors = normals = None
        if "COLOR_0" in self.attributes:
            colors = self.get("COLOR_0", 3, 4)[:, :3]
            colors = (np.clip(colors, 0, 1) if self.weights.any() else colors)[faces]
        if "NORMAL" in self.attributes:
            normals = unit(self.get("NORMAL", 3))[faces]
        none = np.zeros(len(faces), np.intp)
        uv, second = (*coordinates, None, None)[:2]
        return Part(
            vertices, faces, [material], none, [name], none, normals, uv, second, colors
        )

    def get(self, name: str, *widths: int) -> np.ndarray:
        """The attribute's rows: base and weighted targets."""
        rows = self._rows(name, *widths)
        if len(rows) != self.count:
            raise UnreadableError(f"{name} has {len(rows)} rows, POSITION {self.count}")
        for weight, target in zip(self.weights, self.targets, strict=True):
            if weight and name in target:
                moved = self.document.accessor(target[name], widths=widths)
                if moved.shape != rows.shape:
                    raise UnreadableError(f"a target of {name} has other rows than it")
                rows = rows + weight * moved
        return rows.astype(np.float64)

    def influences(
        self, joints: int
    ) -> tuple[Int[np.ndarray, "vertex joint"], Float[np.ndarray, "vertex joint"]]:
        """Each vertex's joints and their weights."""
        numbers, weights, i = [], [], 0
        while f"JOINTS_{i}" in self.attributes:
            numbers.append(self._rows(f"JOINTS_{i}", 4))
            weights.append(self.get(f"WEIGHTS_{i}", 4))
            i += 1
        if not numbers or any(each.dtype.kind != "u" for each in numbers):
            raise UnreadableError("a skinned mesh must have JOINTS_0 of unsigned integers")
        number, weight = np.concatenate(numbers, axis=1), np.concatenate(weights, axis=1)
        if number.shape != weight.shape or number.max() >= joints:
            raise UnreadableError(f"joint {number.max()} is not one of the skin's {joints}")
        if (np.abs(weight.sum(axis=1) - 1) > 1e-2).any() or (weight < 0).any():
            raise UnreadableError("the weights of a vertex's joints must add up to 1")
        return number.astype(np.intp), weight

    def _coordinates(self, number: int) -> Float[np.ndarray, "vertex 2"]:
        name = f"TEXCOORD_{number}"
        if name not in self.attributes:
            raise UnreadableError(f"a texture is read at {name}, which its mesh does not have")
        return self.get(name, 2) * [1, -1] + [0, 1]

    def _rows(self, name: str, *widths: int) -> np.ndarray:
        if name not in self.attributes:
            raise UnreadableError(f"a primitive has no {name}")
        record = self.document.item("accessors", self.attributes[name])
        if not {"bufferView", "sparse"} & record.keys() and (self.packed or name == "POSITION"):
            packed = ", ".join(self.packed) or "nothing"
            raise UnreadableError(f"{name} is held by {packed}, which is not read")
        return self.document.accessor(self.attributes[name], widths=widths)

    def _indices(self) -> Int[np.ndarray, " corner"]:
        if "indices" not in self.record:
            return np.arange(self.count)
        record = self.document.item("accessors", self.record["indices"])
        if self.packed and "bufferView" not in record:
            raise UnreadableError(
                f"indices are held by {', '.join(self.packed)}, which is not read"
            )
        rows = self.document.accessor(self.record["indices"], widths=(1,))[:, 0]
        if rows.dtype.kind != "u" or rows.max() >= self.count:
            raise UnreadableError(f"indices of {self.count} vertices go up to {rows.max()}")
        return rows.astype(np.intp)


def _triangles(corners: Int[np.ndarray, " corner"], mode: int) -> Int[np.ndarray, "face 3"]:
    """The triangles of a list (4), a strip (5) or a fan (6)."""
    count = len(corners) - 2
    if mode not in (4, 5, 6) or count < 1 or (mode == 4 and len(corners) % 3):
        raise UnreadableError(f"{len(corners)} corners make no triangles of mode {mode}")
    if mode == 4:
        return corners.reshape(-1, 3)
    i = np.arange(count)
    if mode == 5:
        return corners[np.stack([i, i + 1 + i % 2, i + 2 - i % 2], axis=1)]
    return corners[np.stack([i + 1, i + 2, 0 * i], axis=1)]


_TRS = ("TRANSLATION", "ROTATION", "SCALE")


def _local(node: dict) -> _Matrix:
    """A node's pose in its parent."""
    parts = [key for key in ("translation", "rotation", "scale") if key in node]
    if "matrix" not in node:
        return _composed(
            vector(node, "translation", [0.0] * 3),
            vector(node, "rotation", [0.0, 0.0, 0.0, 1.0]),
            vector(node, "scale", [1.0] * 3),
        )
    matrix = vector(node, "matrix", [0.0] * 16).reshape(4, 4).T
    if parts or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise UnreadableError(f"a node's 'matrix' must be affine and alone, got {matrix.T}")
    return matrix


def _composed(
    translation: np.ndarray | None, rotation: np.ndarray | None, scale: np.ndarray | None
) -> _Matrix:
    pose = np.eye(4)
    if rotation is not None:
        pose[:3, :3] = _rotation(rotation)
    if scale is not None:
        pose[:3, :3] *= scale
    if translation is not None:
        pose[:3, 3] = translation
    return pose


def _rotation(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    length = np.linalg.norm(quaternion)
    if abs(length - 1) > 1e-2:  # as far as bytes may round
        raise UnreadableError(f"a rotation must be a unit quaternion, got {quaternion}")
    x, y, z, w = quaternion / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)
