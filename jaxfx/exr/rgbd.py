"""An image and its depth from one EXR file, as renderers name them."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfx import depth as depths
from jaxfx._files import StrPath
from jaxfx.exr._parts import MAX_PIXELS, full_names, planes_of, read_parts
from jaxfx.exr.layers import assemble


# The words by which a pass says what it is, the likeliest first.
_IMAGE = ("combined", "rgba", "rgb", "color", "beauty")
_DEPTH = ("depth", "z", "zdepth")


class RGBD(NamedTuple):
    """An image and its depth, of the same pixels, as `read_rgbd` finds them in a file.

    - `image`: height width channel, linear, float32.
    - `depth`: height width, in the file's units, along the axis; NaN where it is missing, inf
      for background.
    """

    image: Float[np.ndarray, "height width channel"]
    depth: Float[np.ndarray, "height width"]


def read_rgbd(
    path: StrPath,
    *,
    layer: str | None = None,
    max_pixels: int = MAX_PIXELS,
    verify: bool = True,
) -> RGBD:
    """Read an image and its depth from one file: Blender's multilayer EXR, say.

    The image is the pass `Combined` of a layer (or `rgba`, `rgb`, `color`, `beauty`, or what
    has no name but the layer's), the depth its pass `Depth` (or `Z`, `zdepth`). A second layer
    of depth is a second call: `behind=exr.read_rgbd(path, layer="Behind")`.

    >>> image, depth = exr.read_rgbd("render.exr", layer="ViewLayer")  # doctest: +SKIP

    **Arguments:**

    - `path`: the file.
    - `layer`: the name in front of the passes, `"ViewLayer"` say, of a view too
      (`"ViewLayer.left"`). Without it the passes with no name in front, which are those of the
      first view, or the only layer that has both; where none has, the only image and the
      only depth.
    - `max_pixels`, `verify`: as for `read`.

    **Returns:** the image, height width channel, with the channels that the file has (1, 3 or
    4, alpha premultiplied), linear; and the depth, height width, in the file's units, along
    the axis. Both are float32. The depth's holes are as in `depth.clean`: NaN where it is
    missing, inf where nothing is there, which Blender writes as 1e10, in halves as 65504.

    **Raises:** `ValueError` and `OSError`, as `read`; it names the layers of the file where
    none or several will do, and where image and depth are not of the same pixels.

    **Gradient:** none; the host side.
    """
    parts = read_parts(path, max_pixels, verify)
    channels = full_names(path, parts)
    layers = assemble(path, planes_of(channels))
    images, named = images_of(layers)
    depth_keys = depths_of(layers)
    # What bears no name is of the first view, whose name some of its passes may bear.
    if view := parts[0].header.get(
        "view", next(iter(parts[0].header.get("multiView", [])), "")
    ):
        for found in (images, depth_keys):
            if key := [found[name] for name in ("", view) if name in found]:
                found[""] = found[view] = key[0]
    both = images.keys() & depth_keys.keys()
    if layer is None and not both and images and depth_keys:
        # Each is looked for by itself: an image without a name before a layer's depth, say.
        keys = (
            images[choose_image(path, images, named, None)],
            depth_keys[choose(path, "a depth", depth_keys, None)],
        )
    else:
        chosen = choose(path, "an image and a depth", both, layer, [*layers])
        keys = images[chosen], depth_keys[chosen]
    windows = [_windows(channels, key) for key in keys]
    if len(windows[0] | windows[1]) != 1:
        raise ValueError(
            f"`{path}` must have `{keys[0]}` and `{keys[1]}` in the same pixels, got the data "
            f"windows {sorted(windows[0] | windows[1])}."
        )
    image, depth = layers[keys[0]], flat(layers[keys[1]])
    return RGBD(image.astype(np.float32), np.asarray(depths.clean(depth.astype(np.float32))))


def _windows(channels: Mapping[str, tuple], key: str) -> set[tuple]:
    """The data windows of a layer's channels."""
    return {
        tuple(np.ravel(part.header["dataWindow"]).tolist())
        for full, (part, _) in channels.items()
        if key in (full, full.rpartition(".")[0])
    }


def images_of(layers: Mapping[str, np.ndarray]) -> tuple[dict[str, str], list[str]]:
    """The keys of `layers` that are images, by layer; and those layers whose pass says so."""
    wide = [key for key, a in layers.items() if a.ndim == 3 and a.shape[2] in (1, 3, 4)]
    named = _by_layer(wide, _IMAGE)
    return named | {key: key for key in wide if _layer_of(key, _IMAGE) is None}, [*named]


def depths_of(layers: Mapping[str, np.ndarray]) -> dict[str, str]:
    """The keys of `layers` that are depths, by layer."""
    single = [key for key, a in layers.items() if flat(a).ndim == 2]
    return _by_layer(single, _DEPTH)


def flat(array: np.ndarray) -> np.ndarray:
    """Without the last axis where that has one channel."""
    return array[..., 0] if array.ndim == 3 and array.shape[2] == 1 else array


def _layer_of(key: str, words: Iterable[str]) -> tuple[str, str] | None:
    """A layer and the word of its pass; None where `key` has no such word."""
    parts = key.split(".")
    for i, part in reversed([*enumerate(parts)]):
        if part.lower() in words:
            return ".".join(parts[:i] + parts[i + 1 :]), part.lower()
    return None


def _by_layer(keys: Iterable[str], words: tuple[str, ...]) -> dict[str, str]:
    """The first of `words` that each layer has a pass of, as the key of that pass."""
    found: dict[str, str] = {}
    for word in reversed(words):
        for key in keys:
            if (split := _layer_of(key, words)) and split[1] == word:
                found[split[0]] = key
    return found


def choose_image(
    path: StrPath, images: Mapping[str, str], named: list[str], layer: str | None
) -> str:
    """`layer`; without one the nameless image, or the only one that a pass calls so."""
    fewest = named if layer is None and "" not in images and named else images
    return choose(path, "an image", fewest, layer)


def choose(
    path: StrPath,
    what: str,
    names: Iterable[str],
    layer: str | None,
    others: Iterable[str] = (),
) -> str:
    """`layer` if it is one of `names`; without one, the nameless one, or the only one."""
    names = sorted(names)
    if layer is None and ("" in names or len(names) == 1):
        return names[0]
    if layer in names:
        return str(layer)
    wanted = "one layer" if layer is None else f"a layer `{layer}`"
    got = f"such layers: {names}" if names else f"none among {sorted(others)}"
    raise ValueError(f"`{path}` must have {wanted} with {what}, got {got}.")
