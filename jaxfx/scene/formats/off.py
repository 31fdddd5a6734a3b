"""OFF files as parts of a scene.

Source: Geomview's manual (Phillips, Levy & Munzner 1993), OFF: COFF, NOFF and STOFF too.
"""

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfx.io import linear_from_srgb
from jaxfx.scene._material import Material
from jaxfx.scene._part import UNASSIGNED, Part, UnreadableError, unit
from jaxfx.scene.formats._polygons import triangulate


_Words = list[str]


def read(path: Path, data: bytes) -> tuple[list[Part], set[str]]:
    """The one part of an OFF file, and the names of what is left out."""
    text = data.decode("utf-8-sig")
    lines = [words for line in text.splitlines() if (words := line.split("#")[0].split())]
    head = re.fullmatch(r"(ST)?(C)?(N)?OFF(\d*)", lines[0][0]) if lines else None
    if head is None or "BINARY" in lines[0]:
        raise UnreadableError("it does not begin with OFF, COFF, NOFF or STOFF")
    has_uv, has_color, has_normal = (prefix is not None for prefix in head.groups()[:3])
    lines[0] = [head[4], *lines[0][1:]] if head[4] else lines[0][1:]  # "OFF8 6 0" is found too.
    lines = lines if lines[0] else lines[1:]
    count, face_count = (int(word) for word in lines[0][:2])
    rows, polygons = lines[1 : count + 1], lines[count + 1 : count + 1 + face_count]
    if min(count, face_count) < 0 or len(rows) + len(polygons) < count + face_count:
        raise UnreadableError(f"it ends before {count} vertices and {face_count} faces")
    if len(lines) > count + 1 + face_count:
        raise UnreadableError(f"{len(lines) - count - 1 - face_count} lines are left over")
    if not polygons:
        return [], set()
    widths = {"position": 3, "normal": 3 * has_normal, "uv": 2 * has_uv}
    widths["color"] = len(rows[0]) - sum(widths.values())
    if widths["color"] not in ((3, 4) if has_color else (0,)):
        raise UnreadableError(f"its vertices have {len(rows[0])} numbers")
    columns, start = {}, 0
    for name in ("position", "normal", "color", "uv"):
        columns[name] = [words[start : start + widths[name]] for words in rows]
        start += widths[name]
    if any(len(words) != len(rows[0]) for words in rows):
        raise UnreadableError("its vertices do not all have the same number of numbers")
    return _part(
        path.name, {name: column for name, column in columns.items() if column[0]}, polygons
    )


def _part(
    name: str, vertex: dict[str, list[_Words]], polygons: list[_Words]
) -> tuple[list[Part], set[str]]:
    """The part of a file's vertex columns and polygon lines, and what is left out."""
    vertices = np.array(vertex["position"], np.float64)
    corners, sizes, tails = [], [], []
    for words in polygons:
        size = int(words[0])
        index = [int(word) for word in words[1 : size + 1]]
        if size < 3 or len(index) < size or not 0 <= min(index) <= max(index) < len(vertices):
            raise UnreadableError(f"a face is {' '.join(words)!r:.60} of {len(vertices)}")
        corners += index
        sizes.append(size)
        tails.append(words[size + 1 :])
    triangles, owner, crossing = triangulate(vertices[corners], sizes)
    faces = np.array(corners)[triangles]
    ignored = {"indices of a colour map"} if any(len(tail) == 1 for tail in tails) else set()
    if crossing:
        ignored.add(f"the triangulation of {crossing} polygons that intersect themselves")
    colors = None
    if "color" in vertex:
        colors = _colors(vertex["color"])[faces]
    elif all(len(tail) in (3, 4) for tail in tails):
        colors = np.repeat(_colors(tails)[owner][:, None], 3, axis=1)
    elif any(len(tail) > 1 for tail in tails):
        raise UnreadableError("some of its faces have a colour of 3 or 4 numbers, not all")
    normals = uv = None
    if "normal" in vertex:
        normals = unit(np.array(vertex["normal"], np.float64))[faces]
    if "uv" in vertex:
        uv = np.array(vertex["uv"], np.float64)[faces]
    zeros = np.zeros(len(faces), np.intp)
    material = UNASSIGNED if colors is None else Material()
    part = Part(vertices, faces, [material], zeros, [name], zeros, normals, uv, None, colors)
    return [part], ignored


def _colors(rows: list[_Words]) -> Float[np.ndarray, "row 3"]:
    """Linear RGB of sRGB colours: integers are divided by 255, numbers with a point are not."""
    are_whole = all(word.isdigit() for row in rows for word in row)
    values = np.array([row[:3] for row in rows], np.float64) / (255 if are_whole else 1)
    if not ((values >= 0) & (values <= 1)).all():
        raise UnreadableError("a colour is neither of integers to 255 nor of numbers in [0, 1]")
    return linear_from_srgb(values)
