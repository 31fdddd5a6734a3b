"""Materials, their textures, and how a texture is sampled."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import final

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16

from jaxfx._checks import option
from jaxfx.io import linear_from_srgb


# The fields of `Material` that are textures, and the names of wrap modes and shaders.
TEXTURES = ("texture", "metallic_roughness", "normal_map")
WRAPS = ("repeat", "mirror", "clamp")
SHADERS = ("blinn", "ggx", "ggx_conserving")


@final
@dataclass(frozen=True)
class Sampler:
    """How a texture is sampled: the coordinates, the filter, and the wrap mode.

    **Arguments:**

    - `wrap`: how the texture continues outside [0, 1], along u and along v: "repeat", "mirror"
      or "clamp" (to the texel at the edge).
    - `nearest`: True samples the nearest texel, False interpolates bilinearly.
    - `transform`: 2x3, from (u, v, 1) of the scene to the texture coordinates.
    - `use_second_uv`: True takes (u, v) from the scene's `second_uv`, False from its `uv`.

    **Raises:** `ValueError` for an unknown wrap mode or a transform that is not a finite 2x3.

    **Gradient:** none; the host side.

    **Example:**

    >>> from jaxfx import scene
    >>> scene.Sampler(wrap=("clamp", "repeat"), nearest=True).wrap
    ('clamp', 'repeat')

    Source: glTF 2.0 (Khronos 2017), 3.8.4; KHR_texture_transform.
    """

    wrap: tuple[str, str] = ("repeat", "repeat")
    nearest: bool = False
    transform: Sequence[Sequence[float | int]] = ((1, 0, 0), (0, 1, 0))
    use_second_uv: bool = False

    def __post_init__(self):
        if len(self.wrap) != 2 or not set(self.wrap) <= set(WRAPS):
            raise ValueError(
                f"`Sampler(wrap=...)` must be two of {', '.join(WRAPS)}, got {self.wrap}."
            )
        if np.shape(self.transform) != (2, 3) or not np.isfinite(self.transform).all():
            raise ValueError(
                f"`Sampler(transform=...)` must be a finite 2x3, got {self.transform}."
            )


@final
@dataclass(frozen=True, eq=False)
class Material:
    """A surface in the terms of glTF 2.0: base colour, metallic, roughness, normal map.

    Textures are height width 3, row 0 at the top, uint8 or uint16 as in the file. A code stands
    for its ratio to the largest code of its type.

    **Arguments:**

    - `color`: linear RGB. The base colour is `color` x `texture` x the corners' colours.
    - `texture`: sRGB, height width 3; or None.
    - `metallic`, `roughness`: in [0, 1].
    - `metallic_roughness`: linear, height width 3: green multiplies `roughness`, blue
      multiplies `metallic`; or None.
    - `normal_map`: linear, height width 3: `2 * value - 1` is the normal in the axes (along u,
      along v, off the surface); or None.
    - `normal_scale`: multiplies the normal's components along u and v.
    - `samplers`: a `Sampler` for each texture, by the name of the argument: "texture",
      "metallic_roughness" or "normal_map". The default repeats and is bilinear.
    - `shader`: how it reflects: "ggx" as glTF states it; "ggx_conserving" the same, but that no
      more light comes back at grazing angles than falls in; "blinn" with Blinn's highlight, and
      without any where the roughness is 1 and the metallic 0. Materials of glTF files and
      trimesh's `PBRMaterial` are "ggx", those of other files "blinn".

    **Raises:** `ValueError` for an unknown shader, a number out of range, or a texture of
    another shape or type.

    **Gradient:** none; the host side.

    **Example:**

    >>> from jaxfx import scene
    >>> gold = scene.Material(color=(0.95, 0.62, 0.22), metallic=0.9, roughness=0.4)
    >>> gold.texture is None
    True
    """

    color: Sequence[float | int] = (1.0, 1.0, 1.0)
    texture: UInt8[np.ndarray, "a b 3"] | UInt16[np.ndarray, "a b 3"] | None = None
    metallic: float | int = 0.0
    roughness: float | int = 1.0
    metallic_roughness: UInt8[np.ndarray, "c d 3"] | UInt16[np.ndarray, "c d 3"] | None = None
    normal_map: UInt8[np.ndarray, "e f 3"] | UInt16[np.ndarray, "e f 3"] | None = None
    normal_scale: float | int = 1.0
    samplers: Mapping[str, Sampler] = field(default_factory=dict)
    shader: str = "blinn"

    def __post_init__(self):
        option("Material(shader=...)", self.shader, SHADERS)
        if np.shape(self.color) != (3,) or not np.isfinite(self.color).all():
            raise ValueError(f"`Material(color=...)` must be linear RGB, got {self.color}.")
        for name in ("metallic", "roughness"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ValueError(f"`Material({name}=...)` must be in [0, 1], got {value}.")
        if not np.isfinite(self.normal_scale):
            raise ValueError(
                f"`Material(normal_scale=...)` must be finite, got {self.normal_scale}."
            )
        if not set(self.samplers) <= set(TEXTURES):
            raise ValueError(
                f"`Material(samplers=...)` must be named {', '.join(TEXTURES)}, "
                f"got {', '.join(self.samplers)}."
            )
        for name in TEXTURES:
            texture = getattr(self, name)
            if texture is None:
                continue
            shape, dtype = np.shape(texture), np.asarray(texture).dtype
            if (
                len(shape) != 3
                or shape[2] != 3
                or 0 in shape
                or dtype not in (np.uint8, np.uint16)
            ):
                raise ValueError(
                    f"`Material({name}=...)` must hold bytes, or 16 bits, of shape "
                    f"(height, width, 3), got {dtype} of shape {shape}."
                )


@cache
def table(dtype: np.dtype, srgb: bool) -> Float[np.ndarray, " code"]:
    """The float32 value of each code of an unsigned type; with `srgb`, in linear light."""
    largest = np.iinfo(dtype).max
    values = np.arange(largest + 1) / largest
    return (linear_from_srgb(values) if srgb else values).astype(np.float32)


def sample_texture(
    texture: UInt8[np.ndarray, "height width 3"] | UInt16[np.ndarray, "height width 3"],
    uv: Float[np.ndarray, "point 2"],
    *,
    srgb: bool,
    sampler: Sampler,
) -> Float[np.ndarray, "point 3"]:
    """The texture at coordinates `uv`, to which the sampler's transform is already applied.

    Texel (row j, column i) has its centre at u = (i + 0.5) / width, v = 1 - (j + 0.5) / height.
    With `srgb`, texels are converted to linear light before they are interpolated.
    """
    height, width = texture.shape[:2]
    x_weight, left, right = _texel_pair(uv[:, 0], width, sampler.wrap[0], sampler.nearest)
    y_weight, top, bottom = _texel_pair(1 - uv[:, 1], height, sampler.wrap[1], sampler.nearest)
    texels, value = texture.reshape(-1, 3), table(texture.dtype, srgb)

    def row(start):
        at_left, at_right = (
            value.take(texels.take(start + column, axis=0)) for column in (left, right)
        )
        return at_left + x_weight * (at_right - at_left)

    above, below = row(top * width), row(bottom * width)
    return above + y_weight * (below - above)


def _texel_pair(
    coordinate: Float[np.ndarray, " point"], size: int, wrap: str, nearest: bool
) -> tuple[Float[np.ndarray, "point 1"], Int[np.ndarray, " point"], Int[np.ndarray, " point"]]:
    """Along one axis: the second texel's weight in [0, 1), and the indices of both texels."""
    if wrap == "clamp":
        coordinate = np.clip(coordinate, -1, 2)
    else:  # Whole periods are taken off first, so that a large coordinate keeps its fraction.
        period = 1 if wrap == "repeat" else 2
        coordinate = coordinate - period * np.floor(coordinate / period)
    position = coordinate * size - (0 if nearest else 0.5)
    first = np.floor(position)
    weight = np.zeros_like(position) if nearest else position - first
    index = first.astype(np.intp)
    lower, upper = (_wrapped(i, size, wrap) for i in (index, index + 1))
    return weight.astype(np.float32)[:, None], lower, upper


def _wrapped(index: Int[np.ndarray, " point"], size: int, wrap: str) -> np.ndarray:
    """Texel indices brought into [0, size) by a wrap mode."""
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "repeat":
        return index % size
    index = index % (2 * size)
    return np.minimum(index, 2 * size - 1 - index)
