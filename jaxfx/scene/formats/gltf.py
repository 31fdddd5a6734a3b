"""glTF files as parts of a scene, without animation: nodes, skins and morphs at their defaults.

Source: glTF 2.0 (Khronos 2017), 3.5 and 3.7; EXT_mesh_gpu_instancing; KHR_mesh_quantization.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxfx.scene._part import (
    Part,
    UnreadableError,
    flipped,
    placed,
    turned_normals,
    unique_name,
    unit,
)
from jaxfx.scene.formats._gltf_document import Document, take, vector
from jaxfx.scene.formats._gltf_material import EXTENSIONS, Materials


_INSTANCES = "EXT_mesh_gpu_instancing"
# Extensions that are read. A file that requires another one is refused; where it only uses one,
# that is logged.
_SUPPORTED = {*EXTENSIONS, _INSTANCES, "KHR_mesh_quantization"}
# A rotation may differ from a unit quaternion by this: signed bytes round by 1/127.
_UNIT_TOLERANCE = 1e-2
# The weights of a vertex's joints may differ from the sum 1 by this, for the same reason.
_SUM_TOLERANCE = 1e-2
_Matrix = Float[np.ndarray, "4 4"]


def read(path: Path, data: bytes) -> tuple[list[Part], set[str]]:
    """The parts of a glTF or GLB file's default scene, and the names of what is left out."""
    document = Document(path, data)
    required, used = (
        set(take(document.json, key, list, []))
        for key in ("extensionsRequired", "extensionsUsed")
    )
    if unknown := required - _SUPPORTED:
        raise UnreadableError(f"it requires {', '.join(sorted(unknown))}, which is not read")
    document.ignored.update(used - _SUPPORTED)
    if take(document.json, "animations", list, []):
        document.ignored.add("animations")
    return _Reader(document).parts(), document.ignored


class _Reader:
    """Builds the parts of a document.

    `poses` holds each node's 4x4 pose in the world, `children` the indices of its children,
    `parents` the parent of each child, `names` the object names in use.
    """

    def __init__(self, document: Document):
        self.document = document
        self.materials = Materials(document)
        self.parents: dict[int, int] = {}
        self.poses, self.children = self._poses()
        self.names: set[str] = set()

    def parts(self) -> list[Part]:
        """The parts of every node of the default scene that has a mesh."""
        parts = []
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
                parts += self._primitives(node, mesh, unique_name(name, self.names))
                continue
            poses = self._instances(extra[_INSTANCES]) if _INSTANCES in extra else [np.eye(4)]
            local = self._primitives(node, mesh, name)
            for pose in poses:
                names = [unique_name(name, self.names)]
                moved = (placed(part, self.poses[index] @ pose) for part in local)
                parts += [part._replace(names=names) for part in moved]
        return parts

    def _poses(self) -> tuple[dict[int, _Matrix], list[list[int]]]:
        """Every node's pose in the world, and its children; sets `parents`."""
        count = len(take(self.document.json, "nodes", list, []))
        nodes = [self.document.item("nodes", index) for index in range(count)]
        children = [take(node, "children", list, []) for node in nodes]
        for parent, node_children in enumerate(children):
            for child in node_children:
                self.document.item("nodes", child)
                if child in self.parents:
                    raise UnreadableError(f"node {child} is listed as a child twice")
                self.parents[child] = parent
        local = [_local(node) for node in nodes]
        stack = [(index, np.eye(4)) for index in range(count) if index not in self.parents]
        poses = {}
        while stack:
            index, parent_pose = stack.pop()
            poses[index] = parent_pose @ local[index]
            stack += [(child, poses[index]) for child in children[index]]
        if len(poses) < count:
            raise UnreadableError("some nodes are their own ancestors")
        return poses, children

    def _drawn(self) -> list[int]:
        """The nodes of the default scene, parents before their children."""
        scenes = take(self.document.json, "scenes", list, [])
        if scenes or "scene" in self.document.json:
            default = self.document.item("scenes", take(self.document.json, "scene", int, 0))
            roots = take(default, "nodes", list, [])
        else:
            roots = [index for index in self.poses if index not in self.parents]
        for index in roots:
            self.document.item("nodes", index)
            if index in self.parents or roots.count(index) > 1:
                raise UnreadableError(
                    f"node {index} of the scene has a parent, or is in it twice"
                )
        drawn, stack = [], list(reversed(roots))
        while stack:
            index = stack.pop()
            drawn.append(index)
            stack += reversed(self.children[index])
        return drawn

    def _instances(self, record: Any) -> list[_Matrix]:
        """The distinct poses of a node's instances, relative to the node."""
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
        # Two instances at one pose look like one, but would make a second layer of depth.
        _, first = np.unique(joined, axis=0, return_index=True)
        return [
            _composed(*(rows[key][i] if key in rows else None for key in _TRS))
            for i in np.sort(first)
        ]

    def _primitives(self, node: dict, mesh: dict, name: str) -> list[Part]:
        """A mesh's triangles in mesh space; those of a skinned node in world space."""
        weights = take(node, "weights", list, take(mesh, "weights", list, []))
        parts = []
        for record in take(mesh, "primitives", list):
            mode = take(record, "mode", int, 4)
            if mode in (0, 1, 2, 3):
                self.document.ignored.add("points and lines")
                continue
            primitive = _Primitive(self.document, record, weights)
            part = primitive.part(self.materials, name, mode)
            if "skin" in node:
                part = self._skinned(part, primitive, node["skin"])
            parts.append(part)
        return parts

    def _skinned(self, part: Part, primitive: "_Primitive", index: Any) -> Part:
        """`part` posed by its joints, in world space. The pose of its own node is not used."""
        skin = self.document.item("skins", index)
        joints = take(skin, "joints", list)
        for joint in joints:
            self.document.item("nodes", joint)
        joint_poses = np.stack([self.poses[joint] for joint in joints])
        if "inverseBindMatrices" in skin:
            stored = self.document.accessor(skin["inverseBindMatrices"], widths=(16,))
            if len(stored) < len(joints):
                raise UnreadableError(f"a skin has {len(stored)} matrices of {len(joints)}")
            joint_poses = joint_poses @ stored[: len(joints)].reshape(-1, 4, 4).transpose(
                0, 2, 1
            )
        index, weight = primitive.influences(len(joints))
        pose = np.einsum("vj,vjab->vab", weight, joint_poses[index])
        vertices = np.einsum("vab,vb->va", pose[:, :3, :3], part.vertices) + pose[:, :3, 3]
        normals = part.normals
        if normals is not None:
            normals = turned_normals(normals, pose[part.faces, :3, :3])
        part = part._replace(vertices=vertices, normals=normals)
        return flipped(part) if np.linalg.det(pose[:, :3, :3]).sum() < 0 else part


class _Primitive:
    """A primitive's attributes, with its morph targets applied at `weights`."""

    def __init__(self, document: Document, record: dict, weights: list):
        self.document, self.record = document, record
        self.extensions = document.extensions(record)
        self.attributes = take(record, "attributes", dict)
        self.targets = take(record, "targets", list, [])
        zeros = [0.0] * len(self.targets)
        self.weights = vector({"weights": weights or zeros}, "weights", zeros)
        self.count = len(self._rows("POSITION", 3)) if "POSITION" in self.attributes else 0

    def part(self, materials: Materials, name: str, mode: int) -> Part:
        """The primitive's triangles, in mesh space, as one object called `name`."""
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
        zeros = np.zeros(len(faces), np.intp)
        uv, second_uv = (*coordinates, None, None)[:2]
        return Part(
            vertices, faces, [material], zeros, [name], zeros, normals, uv, second_uv, colors
        )

    def get(self, name: str, *widths: int) -> np.ndarray:
        """An attribute's rows, of one of `widths`: the base plus the weighted targets."""
        rows = self._rows(name, *widths)
        if len(rows) != self.count:
            raise UnreadableError(f"{name} has {len(rows)} rows, POSITION {self.count}")
        for weight, target in zip(self.weights, self.targets, strict=True):
            if weight and name in target:
                offsets = self.document.accessor(target[name], widths=widths)
                if offsets.shape != rows.shape:
                    raise UnreadableError(
                        f"a morph target of {name} has shape {offsets.shape}, not {rows.shape}"
                    )
                rows = rows + weight * offsets
        return rows.astype(np.float64)

    def influences(
        self, joints: int
    ) -> tuple[Int[np.ndarray, "vertex joint"], Float[np.ndarray, "vertex joint"]]:
        """Each vertex's joints, as indices below `joints`, and their weights."""
        index_sets, weight_sets, i = [], [], 0
        while f"JOINTS_{i}" in self.attributes:
            index_sets.append(self._rows(f"JOINTS_{i}", 4))
            weight_sets.append(self.get(f"WEIGHTS_{i}", 4))
            i += 1
        if not index_sets or any(rows.dtype.kind != "u" for rows in index_sets):
            raise UnreadableError("a skinned mesh must have JOINTS_0 of unsigned integers")
        index, weight = np.concatenate(index_sets, axis=1), np.concatenate(weight_sets, axis=1)
        if index.shape != weight.shape or index.max() >= joints:
            raise UnreadableError(f"joint {index.max()} is not one of the skin's {joints}")
        if (np.abs(weight.sum(axis=1) - 1) > _SUM_TOLERANCE).any() or (weight < 0).any():
            raise UnreadableError("the weights of a vertex's joints must add up to 1")
        return index.astype(np.intp), weight

    def _coordinates(self, number: int) -> Float[np.ndarray, "vertex 2"]:
        """A set of texture coordinates, with v pointing up as in `Scene`."""
        name = f"TEXCOORD_{number}"
        if name not in self.attributes:
            raise UnreadableError(f"a texture is read at {name}, which its mesh does not have")
        return self.get(name, 2) * [1, -1] + [0, 1]

    def _rows(self, name: str, *widths: int) -> np.ndarray:
        """An attribute's rows as they are stored, without morph targets."""
        if name not in self.attributes:
            raise UnreadableError(f"a primitive has no {name}")
        record = self.document.item("accessors", self.attributes[name])
        if not {"bufferView", "sparse"} & record.keys() and (
            self.extensions or name == "POSITION"
        ):
            holder = ", ".join(self.extensions) or "nothing"
            raise UnreadableError(f"{name} is held by {holder}, which is not read")
        return self.document.accessor(self.attributes[name], widths=widths)

    def _indices(self) -> Int[np.ndarray, " corner"]:
        """The vertex of each corner, in the order of the primitive's mode."""
        if "indices" not in self.record:
            return np.arange(self.count)
        record = self.document.item("accessors", self.record["indices"])
        if self.extensions and "bufferView" not in record:
            holder = ", ".join(self.extensions)
            raise UnreadableError(f"indices are held by {holder}, which is not read")
        rows = self.document.accessor(self.record["indices"], widths=(1,))[:, 0]
        if rows.dtype.kind != "u" or rows.max() >= self.count:
            raise UnreadableError(f"indices of {self.count} vertices go up to {rows.max()}")
        return rows.astype(np.intp)


def _triangles(corners: Int[np.ndarray, " corner"], mode: int) -> Int[np.ndarray, "face 3"]:
    """The triangles of a list (mode 4), a strip (5) or a fan (6)."""
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
    """The pose `translation @ rotation @ scale`; None stands for the identity."""
    pose = np.eye(4)
    if rotation is not None:
        pose[:3, :3] = _rotation(rotation)
    if scale is not None:
        pose[:3, :3] *= scale
    if translation is not None:
        pose[:3, 3] = translation
    return pose


def _rotation(quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3 3"]:
    """The rotation of a quaternion (x, y, z, w)."""
    length = np.linalg.norm(quaternion)
    if abs(length - 1) > _UNIT_TOLERANCE:
        raise UnreadableError(f"a rotation must be a unit quaternion, got {quaternion}")
    x, y, z, w = quaternion / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * (w * cross + cross @ cross)
