"""From the face that a pixel shows to what the surface is like there.

Both backends answer one question only, which face a pixel shows. Depth, normals, textures and
materials follow here, in float64 where it matters, so that the backends agree wherever they
see the same face.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfx.gbuffer import GBuffer
from jaxfx.scene._color import read_texture
from jaxfx.scene._material import Material, Sampler
from jaxfx.scene._scene import Scene
from jaxfx.scene._view import View


_DIELECTRIC = 0.04  # reflectance of a surface of refractive index 1.5, face on
_SLACK = 0.05  # how far outside a face depth may be read, in barycentric weight


class Hits(NamedTuple):
    """The pixels that show a face, and where on it they look.

    `pixel` is a flat index; `weights` are barycentric, inside the face; `normal` is the face's,
    unit, on its front; `toward` is the ray's direction. Both are in camera space.
    """

    pixel: Int[np.ndarray, " hit"]
    face: Int[np.ndarray, " hit"]
    depth: Float[np.ndarray, " hit"]
    weights: Float[np.ndarray, "3 hit"]
    normal: Float[np.ndarray, "3 hit"]
    toward: Float[np.ndarray, "3 hit"]

    @property
    def front(self) -> Bool[np.ndarray, " hit"]:
        """Whether the camera sees the face's front, counter-clockwise."""
        return _dot(self.normal, self.toward) < 0


def intersect(scene: Scene, view: View, faces: Int[np.ndarray, "height width"]) -> Hits:
    """Meet every pixel's ray with its own face (-1 for none).

    A rasteriser snaps corners to some 1/256 pixel, and may so give a pixel to a face that its
    centre just misses. Depth then follows the face's plane, `_SLACK` of the face beyond it and
    no farther: a face seen edge-on would put the pixel anywhere.

    Source: Möller & Trumbore 1997.
    """
    pixel = np.flatnonzero(faces >= 0)
    face = faces.take(pixel)
    origin, toward = (each.take(pixel, axis=1) for each in view.rays(*faces.shape))
    corners = view.to_camera(scene.vertices)
    a, b, c = (corners.take(scene.faces[:, i].take(face), axis=1) for i in range(3))
    ab, ac, offset = b - a, c - a, origin - a
    normal = _cross(ab, ac)
    volume = -_dot(normal, toward)
    volume = np.where(volume == 0, np.inf, volume)
    swept = _cross(offset, toward)
    weight_b = _dot(ac, swept) / volume
    weight_c = -_dot(ab, swept) / volume
    weights = np.stack([1 - weight_b - weight_c, weight_b, weight_c])
    depth = _dot(_at_least(-_SLACK, weights), (a[2], b[2], c[2]))
    return Hits(pixel, face, depth, _at_least(0, weights), _unit(normal), toward)


def _at_least(
    least: float | int, weights: Float[np.ndarray, "3 hit"]
) -> Float[np.ndarray, "3 hit"]:
    weights = np.maximum(weights, least)
    return weights / weights.sum(axis=0)


def to_gbuffer(scene: Scene, view: View, hits: Hits, height: int, width: int) -> GBuffer:
    """The deep frame buffer of the hits; nothing elsewhere."""
    color, metallic, roughness = _materials(scene, hits)
    bare = (1 - metallic)[:, None]
    specular = _DIELECTRIC * bare + color * metallic[:, None]
    shader = np.where((roughness < 1) | (metallic > 0), np.int32(2), np.int32(0))
    image = partial(_image, hits.pixel, (height, width))
    base = image(color, 0)
    return GBuffer(
        color=base,
        shader=image(shader, -1),
        ambient=base,
        diffuse=image(color * bare, 0),
        specular=image(specular, 0),
        normal=image(_normals(scene, view, hits).T, 0),
        depth=depth_image(hits, height, width),
        roughness=image(roughness, 0),
    )


def depth_image(hits: Hits, height: int, width: int) -> Float[np.ndarray, "height width"]:
    """The hits' depth in float32, inf elsewhere."""
    return _image(hits.pixel, (height, width), hits.depth.astype(np.float32), np.inf)


def _image(
    pixel: Int[np.ndarray, " hit"],
    shape: tuple[int, int],
    values: np.ndarray,
    nothing: int | float,
) -> np.ndarray:
    """`values` at the flat indices `pixel` of an image, `nothing` elsewhere."""
    full = np.full((shape[0] * shape[1], *values.shape[1:]), nothing, values.dtype)
    full[pixel] = values
    return full.reshape(*shape, *values.shape[1:])


def _normals(scene: Scene, view: View, hits: Hits) -> Float[np.ndarray, "3 hit"]:
    """Unit normals in world space that face the camera.

    Interpolated ones are turned to the face's front, bent by the material's map, and turned to
    the side of the face that is seen. Where they still look away, as at a silhouette, they lose
    what they have along the ray.
    """
    one = np.float32(1)
    flat = view.turn(hits.normal).astype(np.float32)
    toward = view.turn(_unit(hits.toward)).astype(np.float32)
    normal = _fronts(scene, hits, flat) * np.where(hits.front, one, -one)
    return _unit(normal - np.maximum(_dot(normal, toward), 0) * toward)


def _fronts(
    scene: Scene, hits: Hits, flat: Float[np.ndarray, "3 hit"]
) -> Float[np.ndarray, "3 hit"]:
    """Interpolated unit normals, on the front of faces with normals `flat`, bent by maps."""
    one = np.float32(1)
    normal = _interpolate(scene.normals, hits.face, hits.weights)
    normal *= np.where(_dot(normal, flat) < 0, -one, one)
    return _bent(scene, hits, _unit(np.where((normal == 0).all(axis=0), flat, normal)))


def at_hits(
    scene: Scene, hits: Hits
) -> tuple[Float[np.ndarray, "hit 3"], Float[np.ndarray, "hit 3"], Float[np.ndarray, " hit"]]:
    """Normals on the faces' fronts, base colour and metallic; `hits.normal` in world space."""
    color, metallic, _ = _materials(scene, hits)
    return _fronts(scene, hits, hits.normal.astype(np.float32)).T, color, metallic


def _bent(
    scene: Scene, hits: Hits, normal: Float[np.ndarray, "3 hit"]
) -> Float[np.ndarray, "3 hit"]:
    """`normal`, unit, on the face's front, as the materials' normal maps bend it.

    The tangents are each face's own, made orthogonal to the normal. A face whose texture
    coordinates span no area is not bent.

    Source: glTF 2.0 (Khronos 2017), 3.9.3; Lengyel 2001 for the tangents.
    """
    index = scene.face_materials.take(hits.face)
    for each, material in enumerate(scene.materials):
        at = np.flatnonzero(index == each)
        if material.normal_map is None or not len(at):
            continue
        face, up = hits.face[at], normal[:, at]
        sampler = _sampler(material, "normal_map")
        along_u, along_v, spans = _tangents(scene, face, sampler)
        tangent = along_u - _dot(up, along_u) * up
        length = np.sqrt(_dot(tangent, tangent))
        spans &= length > 0
        tangent = tangent / np.where(spans, length, 1)
        across = _cross(up, tangent)
        across = across * np.where(_dot(across, along_v) < 0, -1, 1)
        x, y, z = 2 * _read(scene, material, "normal_map", face, hits.weights[:, at]).T - 1
        scale = np.float32(material.normal_scale)
        bent = scale * (x * tangent + y * across) + z * up
        spans &= _dot(bent, bent) > 0
        normal[:, at] = np.where(spans, _unit(np.where(spans, bent, up)), up)
    return normal


def _tangents(
    scene: Scene, face: Int[np.ndarray, " hit"], sampler: Sampler
) -> tuple[Float[np.ndarray, "3 hit"], Float[np.ndarray, "3 hit"], Bool[np.ndarray, " hit"]]:
    """The ways in which u and v grow on each face, in world space; and whether they do."""
    a, b, c = scene.vertices[scene.faces[face]].transpose(1, 2, 0)
    corners = _coordinates(sampler, _uv(scene, sampler)[face].astype(np.float64))
    (u_a, v_a), (u_b, v_b), (u_c, v_c) = corners.transpose(1, 2, 0)
    area = (u_b - u_a) * (v_c - v_a) - (u_c - u_a) * (v_b - v_a)
    sign = np.sign(area)
    along_u = sign * ((v_c - v_a) * (b - a) - (v_b - v_a) * (c - a))
    along_v = sign * ((u_b - u_a) * (c - a) - (u_c - u_a) * (b - a))
    unit = lambda way: way / np.maximum(np.sqrt(_dot(way, way)), np.finfo(np.float64).tiny)
    return unit(along_u).astype(np.float32), unit(along_v).astype(np.float32), sign != 0


def _materials(
    scene: Scene, hits: Hits
) -> tuple[Float[np.ndarray, "hit 3"], Float[np.ndarray, " hit"], Float[np.ndarray, " hit"]]:
    """Base colour, metallic and roughness of every hit, in float32."""
    color = _interpolate(scene.colors, hits.face, hits.weights).T
    metallic = np.empty(len(color), np.float32)
    roughness = np.empty(len(color), np.float32)
    index = scene.face_materials.take(hits.face)
    for each in np.unique(index):
        material = scene.materials[each]
        at = np.flatnonzero(index == each)
        factor = np.array(material.color, np.float32)
        metallic[at], roughness[at] = material.metallic, material.roughness
        read = partial(_read, scene, material, face=hits.face[at], weights=hits.weights[:, at])
        if material.texture is not None:
            factor = factor * read("texture")
        if material.metallic_roughness is not None:
            both = read("metallic_roughness")
            roughness[at] *= both[:, 1]
            metallic[at] *= both[:, 2]
        color[at] *= factor
    return color, metallic, roughness


def _sampler(material: Material, name: str) -> Sampler:
    return material.samplers.get(name, Sampler())


def _uv(scene: Scene, sampler: Sampler) -> Float[np.ndarray, "face 3 2"]:
    if sampler.use_second_uv and scene.second_uv is not None:
        return scene.second_uv
    return scene.uv


def _coordinates(
    sampler: Sampler, uv: Float[np.ndarray, "*point 2"]
) -> Float[np.ndarray, "*point 2"]:
    """Where the texture is read for texture coordinates of the scene."""
    turn = np.asarray(sampler.transform, uv.dtype)
    if np.array_equal(turn, np.eye(2, 3)):
        return uv
    return uv @ turn[:, :2].T + turn[:, 2]


def _read(
    scene: Scene,
    material: Material,
    name: str,
    face: Int[np.ndarray, " hit"],
    weights: Float[np.ndarray, "3 hit"],
) -> Float[np.ndarray, "hit 3"]:
    """The material's texture of that name at the hits."""
    sampler = _sampler(material, name)
    uv = _coordinates(sampler, _interpolate(_uv(scene, sampler), face, weights).T)
    texture = getattr(material, name)
    return read_texture(texture, uv, srgb=name == "texture", sampler=sampler)


def _interpolate(
    corners: Float[np.ndarray, "face 3 value"],
    face: Int[np.ndarray, " hit"],
    weights: Float[np.ndarray, "3 hit"],
) -> Float[np.ndarray, "value hit"]:
    """The corners' values at the hits, in float32."""
    return np.einsum("in,nik->kn", weights.astype(np.float32), corners.take(face, axis=0))


def _dot(a: Sequence[Any] | np.ndarray, b: Sequence[Any] | np.ndarray) -> np.ndarray:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(
    a: Float[np.ndarray, "3 hit"], b: Float[np.ndarray, "3 hit"]
) -> Float[np.ndarray, "3 hit"]:
    return np.stack(
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    )


def _unit(vector: Float[np.ndarray, "3 hit"]) -> Float[np.ndarray, "3 hit"]:
    return vector / np.sqrt(_dot(vector, vector))
