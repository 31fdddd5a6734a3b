"""The arguments that `warp`, `blend`, `choose` and `intersect` share.

`jaxfx.budget` and `jaxfx.fit` check theirs here too.
"""

from collections.abc import Sequence
from typing import Any, Literal, get_args

from jaxtyping import Array

from jaxfx._arguments import check_camera
from jaxfx._checks import check_image, items, number, option, parameter, whole_number
from jaxfx._numerics import working_dtype
from jaxfx.camera import Camera, PinholeCamera
from jaxfx.reproject._traversal import LARGEST_SIDE


Search = Literal["pyramid", "descent", "linear", "relief"]


def check_image_depth(caller: str, depth: Any, shape: tuple[int, ...]) -> Array:
    """`depth` as a float array of `shape`, whatever its values; `ValueError` otherwise."""
    array = parameter(f"{caller}(depth)", depth, None)
    if array.shape != shape or max(shape) > LARGEST_SIDE:
        raise ValueError(
            f"`{caller}(depth)` must have the image's height and width {shape}, each at most "
            f"{LARGEST_SIDE}, got {array.shape}."
        )
    return array


def check_images(
    caller: str, images: Any, depths: Any, cameras: Any, target: Any
) -> tuple[list[Array], list[Array], list[PinholeCamera], Camera]:
    """Lists of images, depths and cameras, checked; `ValueError` names a wrong one."""
    check_lengths(caller, images=images, depths=depths, cameras=cameras)
    images = [check_image(f"{caller}(images)", image) for image in images]
    shapes = [image.shape[:2] for image in images]
    return images, check_depths(caller, depths, shapes, cameras, target), list(cameras), target


def check_depths(
    caller: str, depths: Sequence, shapes: Sequence, cameras: Sequence, target: Any
) -> list[Array]:
    """Depths of the given shapes in the types to compute in; `ValueError` also for a camera."""
    pairs = zip(depths, shapes, strict=True)
    depths = [check_image_depth(caller, depth, shape) for depth, shape in pairs]
    for camera in cameras:
        check_camera(f"{caller}(cameras)", camera, PinholeCamera)
    check_camera(f"{caller}(target)", target)
    return [depth.astype(working_dtype(depth.dtype)) for depth in depths]


def check_lengths(caller: str, **lists: Any) -> None:
    """Raise `ValueError` unless all are sequences of one length, at least 1."""
    expected = "a sequence with an item for each camera"
    lengths = {
        name: len(items(f"{caller}({name})", values, expected))
        for name, values in lists.items()
    }
    if len(set(lengths.values())) > 1 or 0 in lengths.values():
        name = next(iter(lists))
        raise ValueError(
            f"`{caller}({name})` must have an item for each camera, at least one, "
            f"got lengths {lengths}."
        )


def check_size(
    caller: str, height: Any, width: Any, default: tuple[int, ...]
) -> tuple[int, int]:
    """Height and width of the result in pixels: both given, or those of `default`."""
    if height is None and width is None:
        height, width = default
    expected = "a positive integer in pixels; height and width are given both or none"
    return (
        whole_number(f"{caller}(height=...)", height, expected=expected),
        whole_number(f"{caller}(width=...)", width, expected=expected),
    )


def check_search(caller: str, search: str) -> None:
    """Raise `ValueError` for a search that is none of the four."""
    option(f"{caller}(search=...)", search, get_args(Search))


def check_threshold(caller: str, hole_threshold: Any) -> float:
    """The threshold as a number; `ValueError` unless it is positive."""
    return number(f"{caller}(hole_threshold=...)", hole_threshold, expected="a positive number")
