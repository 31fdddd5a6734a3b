"""Materials and how their textures are read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np
from jaxtyping import UInt8, UInt16


TEXTURES = ("texture", "metallic_roughness", "normal_map")
WRAPS = ("repeat", "mirror", "clamp")


@final
@dataclass(frozen=True)
class Sampler:
    """How a texture is read: at which coordinates, and between and beyond its texels.

    **Arguments:**

    - `wrap`: what lies outside [0, 1], along u and along v: "repeat", "mirror" or "clamp",
      which goes on with the texel at the edge.
    - `nearest`: whether the nearest texel is taken. Else the read is bilinear.
    - `transform`: 2x3, from (u, v, 1) of the scene to the coordinates that are read.
    - `use_second_uv`: whether (u, v) comes from the scene's `second_uv`. Else it is `uv`.

    **Raises:** `ValueError` for another name of a wrap, or another transform.

    **Gradient:** none: these are the host's numbers.

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
    """A surface in the terms of glTF 2.0.

    Textures are height width 3, row 0 at the top, 8 or 16 bits as in the file; their values are
    over the type's largest.

    **Arguments:**

    - `color`: linear RGB; the corners' colours and the texture multiply it.
    - `texture`: sRGB, height width 3; or None.
    - `metallic`, `roughness`: in [0, 1].
    - `metallic_roughness`: linear, height width 3, multiplies the two: roughness in green,
      metallic in blue; or None.
    - `normal_map`: linear, height width 3; 2 * value - 1 is the normal along u, along v and off
      the surface; or None.
    - `normal_scale`: multiplies that normal along u and along v.
    - `samplers`: how the textures are read, by the names of the three arguments above; one that
      is not named repeats and is bilinear.

    **Raises:** `ValueError` for a number out of range or another kind of texture.

    **Gradient:** none: these are the host's numbers.
    """

    color: Sequence[float | int] = (1.0, 1.0, 1.0)
    texture: UInt8[np.ndarray, "a b 3"] | UInt16[np.ndarray, "a b 3"] | None = None
    metallic: float | int = 0.0
    roughness: float | int = 1.0
    metallic_roughness: UInt8[np.ndarray, "c d 3"] | UInt16[np.ndarray, "c d 3"] | None = None
    normal_map: UInt8[np.ndarray, "e f 3"] | UInt16[np.ndarray, "e f 3"] | None = None
    normal_scale: float | int = 1.0
    samplers: Mapping[str, Sampler] = field(default_factory=dict)

    def __post_init__(self):
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
