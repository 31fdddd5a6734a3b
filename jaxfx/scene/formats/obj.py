"""OBJ files as parts of a scene.

Source: Wavefront's OBJ, as in Bourke 1995; colours after positions as MeshLab writes them.
"""

import math
import shlex
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from jaxfx.io import linear_from_srgb
from jaxfx.scene._material import Material
from jaxfx.scene._part import UNASSIGNED, Part, UnreadableError, flat_normals, unit
from jaxfx.scene.formats._images import find_file
from jaxfx.scene.formats._mtl import Library
from jaxfx.scene.formats._polygons import triangulate


# Statements skipped without a message, since they do not change triangles; and those that are
# reported, with their names.
_SKIPPED = {"mg", "bevel", "c_interp", "d_interp", "lod"}
_REPORTED = {"l": "lines", "p": "points", "shadow_obj": "shadow_obj", "trace_obj": "trace_obj"}


def read(path: Path, data: bytes) -> tuple[list[Part], set[str]]:
    """The one part of an OBJ file, and the names of what is left out."""
    reader = _Reader(path)
    text = data.decode("utf-8-sig", "surrogateescape").replace("\\\r\n", " ")
    for number, line in enumerate(text.replace("\\\n", " ").splitlines(), 1):
        try:
            reader.line(line, number)
        except (UnreadableError, ValueError) as error:
            raise UnreadableError(f"line {number}, {line.strip()!r:.60}: {error}") from error
    return [reader.part()] if reader.sizes else [], reader.ignored | reader.library.ignored


class _Reader:
    """Collects a file's points and faces line by line, then builds the part.

    `points` holds the rows of `v`, `vt` and `vn`. `corners` holds three indices per corner of a
    polygon, into those rows, -1 for none; `sizes` the corners per polygon; `face_lines` each
    polygon's line in the file.
    """

    def __init__(self, path: Path):
        self.path = path
        self.library = Library()
        self.ignored: set[str] = set()
        self.missing: list[str] = []  # MTL files that were not found.
        self.names_libraries = False
        self.points: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
        self.corners: list[tuple[int, ...]] = []
        self.sizes: list[int] = []
        self.face_lines: list[int] = []
        self.face_groups: list[tuple[str, str, int]] = []  # Object, material, smoothing group.
        self.object, self.group, self.material, self.smooth = "", "", "", 0
        self._parsed: dict[str, tuple[int, ...]] = {}  # Corners by their text, as a cache.

    def line(self, line: str, number: int) -> None:
        """Read one line; `number` counts from 1."""
        plain = line.split("#", maxsplit=1)[0] if "#" in line else line
        words = plain.split()
        if not words:
            return
        key = words.pop(0)
        if key in self.points or key in ("f", "fo"):
            if "_" in plain:  # Python would accept it between digits.
                raise UnreadableError("'_' is in no number")
            if key in self.points:
                self._point(key, words)
            else:
                self._face(words, number)
            return
        rest = line.strip()[len(key) :].strip()
        if key == "usemtl":
            self.material = rest
        elif key == "mtllib":
            self._read_library(rest)
        elif key == "o":
            self.object = rest
        elif key == "g":
            self.group = " ".join(words)
        elif key == "s":
            (group,) = words
            self.smooth = 0 if group == "off" else int(group)
        elif key in _REPORTED:
            self.ignored.add(_REPORTED[key])
        elif key not in _SKIPPED:
            raise UnreadableError(f"{key!r} is not read")

    def _point(self, key: str, words: list[str]) -> None:
        """Read a vertex, texture coordinate or normal."""
        values = [float(word) for word in words]
        counts = {"v": (3, 4, 6, 7), "vt": (1, 2, 3), "vn": (3,)}[key]
        if len(values) not in counts:
            raise UnreadableError(f"{len(values)} numbers")
        if key != "v" and not all(map(math.isfinite, values)):
            raise UnreadableError("a number is not finite")
        if len(values) > 4 and not 0 <= min(values[-3:]) <= max(values[-3:]) <= 1:
            raise UnreadableError("a colour is not in [0, 1]")
        self.points[key].append(values)

    def _face(self, words: list[str], number: int) -> None:
        """Read a polygon."""
        if len(words) < 3:
            raise UnreadableError(f"a face of {len(words)} corners")
        for word in words:
            corner = self._parsed.get(word)
            if corner is None:
                corner = self._corner(word)
                if "-" not in word:  # A negative index counts from the latest row.
                    self._parsed[word] = corner
            self.corners.append(corner)
        self.sizes.append(len(words))
        self.face_lines.append(number)
        self.face_groups.append((self.object or self.group, self.material, self.smooth))

    def _corner(self, word: str) -> tuple[int, ...]:
        """The indices of a corner's position, coordinates and normal, from 0; -1 for none."""
        fields, indices = word.split("/"), []
        if len(fields) > 3 or not fields[0]:
            raise UnreadableError(f"{word!r} is no corner")
        for field, points in zip(fields, self.points.values(), strict=False):
            value = int(field) if field else 0
            index = value - 1 if value >= 0 else len(points) + value
            if field and index < 0:
                raise UnreadableError(f"there is no {value} among {len(points)}")
            indices.append(index)
        return (*indices, -1, -1)[:3]

    def _read_library(self, rest: str) -> None:
        """Read the MTL files of a statement: one file whose name has spaces, or several."""
        self.names_libraries = True
        paths = {rest: self._library(rest, rest.strip("\"'"))}
        names = [] if paths[rest] else shlex.split(rest.replace("\\", "/"))
        if len(names) > 1:
            paths = {name: self._library(name) for name in names}
        for name, path in paths.items():
            if path is None:
                self.missing.append(name)
            else:
                self.library.read(path)

    def _library(self, *names: str) -> Path | None:
        """The path of an MTL file, or None where it does not exist."""
        try:
            return find_file(self.path.parent, *names)
        except UnreadableError:
            return None

    def part(self) -> Part:
        """All polygons of the file as triangles."""
        corners = np.array(self.corners, np.intp)
        self._check(corners)
        vertices, colors = self._vertices()
        triangles, owner, crossing = triangulate(vertices[corners[:, 0]], self.sizes)
        if crossing:
            self.ignored.add(
                f"the triangulation of {crossing} polygons that intersect themselves"
            )
        indices = corners[triangles]  # face corner 3
        faces = indices[..., 0]
        has_uv = np.all(indices[..., 1] >= 0, axis=1)
        names, face_objects = _numbered([group[0] for group in self.face_groups])
        materials, face_materials = self._materials(owner, has_uv)
        return Part(
            vertices,
            faces,
            materials,
            face_materials,
            [name or self.path.name for name in names],
            face_objects[owner],
            self._normals(vertices, faces, indices[..., 2], owner),
            self._uv(indices[..., 1], has_uv),
            None,
            None if colors is None else colors[faces],
        )

    def _check(self, corners: Int[np.ndarray, "corner 3"]) -> None:
        """Refuse indices out of range, and faces whose corners differ in which they have."""
        sizes = np.array(self.sizes)
        owner = np.repeat(np.arange(len(sizes)), sizes)
        counts = np.array([len(points) for points in self.points.values()])
        first = (np.cumsum(sizes) - sizes)[owner]
        is_missing = np.less(corners, 0)
        for wrong, reason in (
            (corners >= counts, "it has an index that is too large"),
            (is_missing != is_missing[first], "its corners are not of one form"),
        ):
            if wrong.any():
                line = self.face_lines[owner[wrong.any(axis=1).argmax()]]
                counted = ", ".join(f"{len(rows)} {key}" for key, rows in self.points.items())
                raise UnreadableError(f"line {line}, a face among {counted}: {reason}")

    def _vertices(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Positions, vertex 3, and linear RGB, vertex 3, or None where no vertex has any."""
        rows = self.points["v"]
        vertices = np.array([row[:3] for row in rows])
        if all(len(row) < 6 for row in rows):
            return vertices, None
        white = [1.0, 1.0, 1.0]
        colors = np.array([row[-3:] if len(row) > 4 else white for row in rows])
        return vertices, linear_from_srgb(colors)

    def _uv(
        self, index: Int[np.ndarray, "face 3"], has_uv: np.ndarray
    ) -> Float[np.ndarray, "face 3 2"] | None:
        """Texture coordinates of the corners; 0 on faces that have none."""
        if not has_uv.any():
            return None
        values = np.array([(*row, 0.0)[:2] for row in self.points["vt"]])
        return np.where(has_uv[:, None, None], values[index], 0)

    def _normals(
        self,
        vertices: Float[np.ndarray, "vertex 3"],
        faces: Int[np.ndarray, "face 3"],
        index: Int[np.ndarray, "face 3"],
        owner: Int[np.ndarray, " face"],
    ) -> Float[np.ndarray, "face 3 3"]:
        """Corner normals: the file's, else those of the smoothing group, else the face's.

        A vertex's normal in a smoothing group is the mean of its faces' normals, weighted by
        the faces' angles there (Thürmer & Wüthrich 1998). That does not depend on how polygons
        are cut into triangles.
        """
        normals = flat_normals(vertices, faces)
        groups = np.array([group[2] for group in self.face_groups])[owner]
        corner_groups = np.repeat(groups[:, None], 3, axis=1)
        is_smooth = (corner_groups > 0) & (index < 0)
        if is_smooth.any():
            group_vertex = np.stack([corner_groups[is_smooth], faces[is_smooth]], axis=1)
            _, slot = np.unique(group_vertex, axis=0, return_inverse=True)
            sums = np.zeros((slot.max() + 1, 3))
            weighted = unit(normals) * _angles(vertices[faces])[..., None]
            np.add.at(sums, slot.ravel(), weighted[is_smooth])
            normals[is_smooth] = sums[slot.ravel()]
        if (index >= 0).any():
            file_normals = np.array(self.points["vn"])
            normals = np.where((index >= 0)[..., None], file_normals[index], normals)
        return unit(normals)

    def _materials(
        self, owner: np.ndarray, has_uv: np.ndarray
    ) -> tuple[list[Material], np.ndarray]:
        """The materials in use, and each triangle's index into them.

        A material with a texture becomes two where only some of its faces have coordinates.
        """
        asked, index = _numbered([group[1] for group in self.face_groups])
        keys = 2 * index[owner] + has_uv
        used, face_materials = np.unique(keys, return_inverse=True)
        materials = [self._material(asked[key // 2], bool(key % 2)) for key in used]
        if self.missing and not any(asked):
            self.ignored.add(f"{self.missing}, which are not there and not used")
        return materials, face_materials.ravel()

    def _material(self, name: str, has_uv: bool) -> Material:
        """The material of that name; the name "" stands for none."""
        if name in self.library:
            return self.library.get(name, has_uv=has_uv)
        if not name:
            colored = any(len(row) > 4 for row in self.points["v"])
            return Material() if colored else UNASSIGNED
        if self.missing:
            raise UnreadableError(f"material {name!r} is in none of the files {self.missing}")
        if self.names_libraries:
            raise UnreadableError(f"no mtllib has the material {name!r}")
        self.ignored.add("usemtl without any mtllib")
        return UNASSIGNED


def _angles(corners: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "face 3"]:
    """The angle at each corner of triangles, in radians."""
    ahead, behind = (unit(np.roll(corners, step, axis=1) - corners) for step in (-1, 1))
    return np.arccos(np.clip((ahead * behind).sum(axis=-1), -1, 1))


def _numbered(values: list[str]) -> tuple[list[str], Int[np.ndarray, " value"]]:
    """The distinct values in order of first appearance, and the index of each value in them."""
    index = {value: number for number, value in enumerate(dict.fromkeys(values))}
    return list(index), np.array([index[value] for value in values])
