"""From the face that a pixel shows to the shading parameters of the surface there.

A backend finds only which face each pixel shows. This module computes depth, normals and
material parameters at the hit, so that both backends agree wherever they find the same face.
Depth and barycentric weights are in float64.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfx.gbuffer import DIELECTRIC, GBuffer
from jaxfx.scene._material import Material, Sampler, sample_texture
from jaxfx.scene._scene import Scene
from jaxfx.scene._view import View


# How far outside its face a hit may lie, in barycentric weight. A smaller value clips the depth
# of pixels that a rasteriser gave to a face which their centre just misses; a larger one allows
# very wrong depths for a face seen edge-on.
_SLACK = 0.05
# In float32, so that signs do not turn normals to float64.
_ONE = np.float32(1)


class Hits(NamedTuple):
    """The pixels that show a face, and the point of the face that each shows.

    - `pixel`: flat index of the pixel.
    - `face`: index of the face.
    - `depth`: along the optical axis, in scene units.
    - `weights`: barycentric, in [0, 1].
    - `normal`: the face's unit normal, on its front side, in camera space (but in world space
      for `at_hits`).
    - `toward`: the direction of the ray from the camera, scaled to depth 1, in camera space.
    """

    pixel: Int[np.ndarray, " hit"]
    face: Int[np.ndarray, " hit"]
    depth: Float[np.ndarray, " hit"]
    weights: Float[np.ndarray, "3 hit"]
    normal: Float[np.ndarray, "3 hit"]
    toward: Float[np.ndarray, "3 hit"]

    @property
    def front(self) -> Bool[np.ndarray, " hit"]:
        """Whether the camera sees the face's front: its corners run counter-clockwise."""
        return _dot(self.normal, self.toward) < 0


def intersect(scene: Scene, view: View, faces: Int[np.ndarray, "height width"]) -> Hits:
    """The intersection of every pixel's ray with the face that the pixel shows (-1 for none).

    A rasteriser snaps corners to about 1/256 pixel, and so may assign a pixel to a face that
    its centre just misses. The depth is then that of the face's plane, at most `_SLACK` outside
    the face: in the plane of a face seen edge-on it could be anything.

    Source: Möller & Trumbore 1997.
    """
    pixel = np.flatnonzero(faces >= 0)
    origin, toward = (rays.take(pixel, axis=1) for rays in view.rays(*faces.shape))
    corners, axis = view.to_camera(scene.vertices), np.array([[0.0], [0], [1]])
    return meet(scene, corners, pixel, faces.take(pixel), (origin, toward), axis)


def meet(
    scene: Scene,
    vertices: Float[np.ndarray, "3 vertex"],
    pixel: Int[np.ndarray, " hit"],
    face: Int[np.ndarray, " hit"],
    rays: tuple[Float[np.ndarray, "3 hit"], Float[np.ndarray, "3 hit"]],
    axis: Float[np.ndarray, "3 #hit"],
) -> Hits:
    """The hits of rays (origin, direction) with the faces of pixels, in the rays' space.

    `vertices` are the scene's in that space. The depth is along `axis`, from the origin, over
    the direction's own.
    """
    origin, toward = rays
    a, b, c = (vertices.take(scene.faces[:, i].take(face), axis=1) for i in range(3))
    ab, ac, offset = b - a, c - a, origin - a
    normal = _cross(ab, ac)
    # The determinant of the edges and the ray; 0 where the face is seen edge-on.
    volume = -_dot(normal, toward)
    volume = np.where(volume == 0, np.inf, volume)
    swept = _cross(offset, toward)
    weight_b = _dot(ac, swept) / volume
    weight_c = -_dot(ab, swept) / volume
    weights = np.stack([1 - weight_b - weight_c, weight_b, weight_c])
    along = (_dot(axis, corner - origin) for corner in (a, b, c))
    depth = _dot(_at_least(-_SLACK, weights), [*along]) / _dot(axis, toward)
    return Hits(pixel, face, depth, _at_least(0, weights), _unit(normal), toward)


def _at_least(
    least: float | int, weights: Float[np.ndarray, "3 hit"]
) -> Float[np.ndarray, "3 hit"]:
    """Barycentric weights clamped from below, and normalised to the sum 1."""
    weights = np.maximum(weights, least)
    return weights / weights.sum(axis=0)


def to_gbuffer(scene: Scene, view: View, hits: Hits, height: int, width: int) -> GBuffer:
    """The G-buffer of the hits; background in all other pixels."""
    color, metallic, roughness = _materials(scene, hits)
    dielectric = (1 - metallic)[:, None]
    specular = DIELECTRIC * dielectric + color * metallic[:, None]
    of_ggx = {"ggx": 3, "ggx_conserving": 4}
    number = np.array([of_ggx.get(material.shader, 0) for material in scene.materials])
    number = number[scene.face_materials.take(hits.face)]
    is_shiny = (roughness < 1) | (metallic > 0)
    shader = np.where(number > 0, number, 2 * is_shiny)
    image = partial(_image, hits.pixel, (height, width))
    base = image(color, 0)
    return GBuffer(
        color=base,
        shader=image(shader.astype(np.int32), -1),
        ambient=base,
        diffuse=image(color * dielectric, 0),
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
    background: int | float,
) -> np.ndarray:
    """An image with `values` at the flat indices `pixel`, and `background` elsewhere."""
    full = np.full((shape[0] * shape[1], *values.shape[1:]), background, values.dtype)
    full[pixel] = values
    return full.reshape(*shape, *values.shape[1:])


def _normals(scene: Scene, view: View, hits: Hits) -> Float[np.ndarray, "3 hit"]:
    """Unit normals in world space that face the camera.

    The corners' normals are interpolated on the face's front, perturbed by the normal map, and
    flipped where the camera sees the back. Where one still points away from the camera, as at a
    silhouette, its component along the ray is removed.
    """
    flat = view.turn(hits.normal).astype(np.float32)
    toward = view.turn(_unit(hits.toward)).astype(np.float32)
    normal = _front_normals(scene, hits, flat) * np.where(hits.front, _ONE, -_ONE)
    return _unit(normal - np.maximum(_dot(normal, toward), 0) * toward)


def _front_normals(
    scene: Scene, hits: Hits, flat: Float[np.ndarray, "3 hit"]
) -> Float[np.ndarray, "3 hit"]:
    """Interpolated unit normals in world space, with normal maps, on the faces' front side.

    `flat` are the faces' own normals, in world space.
    """
    normal = _interpolate(scene.normals, hits.face, hits.weights)
    normal *= np.where(_dot(normal, flat) < 0, -_ONE, _ONE)
    return _normal_mapped(scene, hits, _unit(np.where((normal == 0).all(axis=0), flat, normal)))


def at_hits(
    scene: Scene, hits: Hits
) -> tuple[Float[np.ndarray, "hit 3"], Float[np.ndarray, "hit 3"], Float[np.ndarray, " hit"]]:
    """Front-side normals, base colour and metallic at hits whose `normal` is in world space."""
    color, metallic, _ = _materials(scene, hits)
    return _front_normals(scene, hits, hits.normal.astype(np.float32)).T, color, metallic


def _normal_mapped(
    scene: Scene, hits: Hits, normal: Float[np.ndarray, "3 hit"]
) -> Float[np.ndarray, "3 hit"]:
    """Unit normals on the face's front, perturbed by the materials' normal maps.

    The tangents are computed per face and made orthogonal to the normal. A face whose texture
    coordinates span no area keeps its normal.

    Source: glTF 2.0 (Khronos 2017), 3.9.3; Lengyel 2001 for the tangents.
    """
    index = scene.face_materials.take(hits.face)
    for material_index, material in enumerate(scene.materials):
        at = np.flatnonzero(index == material_index)
        if material.normal_map is None or not len(at):
            continue
        face, up = hits.face[at], normal[:, at]
        sampler = _sampler(material, "normal_map")
        along_u, along_v, has_tangents = _tangents(scene, face, sampler)
        tangent = along_u - _dot(up, along_u) * up
        length = np.sqrt(_dot(tangent, tangent))
        has_tangents &= length > 0
        tangent = tangent / np.where(has_tangents, length, 1)
        bitangent = _cross(up, tangent)
        bitangent = bitangent * np.where(_dot(bitangent, along_v) < 0, -1, 1)
        x, y, z = 2 * _sample(scene, material, "normal_map", face, hits.weights[:, at]).T - 1
        scale = np.float32(material.normal_scale)
        mapped = scale * (x * tangent + y * bitangent) + z * up
        is_mapped = has_tangents & (_dot(mapped, mapped) > 0)
        normal[:, at] = np.where(is_mapped, _unit(np.where(is_mapped, mapped, up)), up)
    return normal


def _tangents(
    scene: Scene, face: Int[np.ndarray, " hit"], sampler: Sampler
) -> tuple[Float[np.ndarray, "3 hit"], Float[np.ndarray, "3 hit"], Bool[np.ndarray, " hit"]]:
    """Per face, the world-space unit directions in which u and v grow; whether they exist."""
    a, b, c = scene.vertices[scene.faces[face]].transpose(1, 2, 0)
    corners = _coordinates(sampler, _uv(scene, sampler)[face].astype(np.float64))
    (u_a, v_a), (u_b, v_b), (u_c, v_c) = corners.transpose(1, 2, 0)
    area = (u_b - u_a) * (v_c - v_a) - (u_c - u_a) * (v_b - v_a)
    sign = np.sign(area)
    along_u = sign * ((v_c - v_a) * (b - a) - (v_b - v_a) * (c - a))
    along_v = sign * ((u_b - u_a) * (c - a) - (u_c - u_a) * (b - a))
    tiny = np.finfo(np.float64).tiny  # So that a direction of length 0 stays 0.
    unit = lambda vector: vector / np.maximum(np.sqrt(_dot(vector, vector)), tiny)
    return unit(along_u).astype(np.float32), unit(along_v).astype(np.float32), sign != 0


def _materials(
    scene: Scene, hits: Hits
) -> tuple[Float[np.ndarray, "hit 3"], Float[np.ndarray, " hit"], Float[np.ndarray, " hit"]]:
    """Base colour, metallic and roughness of every hit, in float32."""
    color = _interpolate(scene.colors, hits.face, hits.weights).T
    metallic = np.empty(len(color), np.float32)
    roughness = np.empty(len(color), np.float32)
    index = scene.face_materials.take(hits.face)
    for material_index in np.unique(index):
        material = scene.materials[material_index]
        at = np.flatnonzero(index == material_index)
        factor = np.array(material.color, np.float32)
        metallic[at], roughness[at] = material.metallic, material.roughness
        face, weights = hits.face[at], hits.weights[:, at]
        if material.texture is not None:
            factor = factor * _sample(scene, material, "texture", face, weights)
        if material.metallic_roughness is not None:
            sampled = _sample(scene, material, "metallic_roughness", face, weights)
            roughness[at] *= sampled[:, 1]
            metallic[at] *= sampled[:, 2]
        color[at] *= factor
    return color, metallic, roughness


def _sampler(material: Material, name: str) -> Sampler:
    """The sampler of the material's texture of that name."""
    return material.samplers.get(name, Sampler())


def _uv(scene: Scene, sampler: Sampler) -> Float[np.ndarray, "face 3 2"]:
    """The set of texture coordinates that a sampler asks for."""
    if sampler.use_second_uv and scene.second_uv is not None:
        return scene.second_uv
    return scene.uv


def _coordinates(
    sampler: Sampler, uv: Float[np.ndarray, "*point 2"]
) -> Float[np.ndarray, "*point 2"]:
    """The scene's texture coordinates after the sampler's transform."""
    transform = np.asarray(sampler.transform, uv.dtype)
    if np.array_equal(transform, np.eye(2, 3)):
        return uv
    return uv @ transform[:, :2].T + transform[:, 2]


def _sample(
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
    return sample_texture(texture, uv, srgb=name == "texture", sampler=sampler)


def _interpolate(
    corners: Float[np.ndarray, "face 3 value"],
    face: Int[np.ndarray, " hit"],
    weights: Float[np.ndarray, "3 hit"],
) -> Float[np.ndarray, "value hit"]:
    """Values given at the faces' corners, interpolated at the hits, in float32."""
    return np.einsum("in,nik->kn", weights.astype(np.float32), corners.take(face, axis=0))


def _dot(a: Sequence[Any] | np.ndarray, b: Sequence[Any] | np.ndarray) -> np.ndarray:
    """Dot products along the first axis, of length 3."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(
    a: Float[np.ndarray, "3 hit"], b: Float[np.ndarray, "3 hit"]
) -> Float[np.ndarray, "3 hit"]:
    """Cross products along the first axis."""
    return np.stack(
        [
            a[1] * b[2] - a[2] * b[1],
            a[2] * b[0] - a[0] * b[2],
            a[0] * b[1] - a[1] * b[0],
        ]
    )


def _unit(vector: Float[np.ndarray, "3 hit"]) -> Float[np.ndarray, "3 hit"]:
    """Vectors along the first axis, divided by their length."""
    return vector / np.sqrt(_dot(vector, vector))
