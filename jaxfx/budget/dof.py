"""Depth of field within an error."""

import itertools
import math
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Float

from jaxfx._numerics import check_depth, check_image
from jaxfx.budget._octaves import octaves
from jaxfx.budget._plan import Part, Plan, Search, Trial, check_call, plan
from jaxfx.dof.blend import blend
from jaxfx.dof.diffusion import implicit_diffusion
from jaxfx.dof.gather import gather
from jaxfx.dof.layered import layered
from jaxfx.dof.scatter import cheapest, largest_coc, scatter
from jaxfx.dof.separable import separable
from jaxfx.lens import FocusPlanes, ThinLens


# From which size on to try sprites at lower resolutions, in pixels; not below 3 epsilon.
_SPLITS = (8.0, 10.0)
# Taps of gather, whose errors tell how many would do; more than so many are not tried.
_FEW, _MORE, _MOST = 4, 16, 64
# The parts that are tried: so many to a side, of so many pixels each way and what reaches them,
# if they are less than this share of the picture; or else all of it.
_PARTS, _SIDE, _SHARE = 3, 64, 1 / 3


def _nothing(image: Any, depth: Any, lens: Any) -> Any:
    return jnp.asarray(image)


_METHODS = {
    "nothing": _nothing,
    "scatter": scatter,
    "scatter in octaves": octaves,
    "layered": layered,
    "separable": separable,
    "blend": blend,
    "implicit diffusion": implicit_diffusion,
    "gather": gather,
}
# Of scatter, direct taps against spans.
_KERNELS = {"tiles": "spans", "spans": "tiles"}
# What is tried beside the effect, its smaller circles, octaves and gather.
_OTHERS = ("separable", "implicit diffusion", "blend")


class Method(eqx.Module):
    """A method of depth of field and its options."""

    name: str = eqx.field(static=True)
    options: tuple[tuple[str, Any], ...] = eqx.field(static=True)

    def __init__(self, name: str, **options: Any):
        self.name, self.options = name, tuple(options.items())

    @property
    def title(self) -> str:
        """What it is."""
        return f"depth of field by {self.name}"

    def __call__(self, image: Any, depth: Any, lens: Any) -> Any:
        """As the effect."""
        return _METHODS[self.name](image, depth, lens, **dict(self.options))


def dof(
    image: Float[ArrayLike, "height width channel"],
    depth: Float[ArrayLike, "height width"],
    lens: ThinLens | FocusPlanes,
    *,
    max_error: int | float,
    target: Literal["scatter", "layered"] = "scatter",
) -> Plan:
    """The quickest depth of field within an error of `dof.scatter`.

    Where no circle of confusion passes its pixel, nothing is done, and nothing tried. Else the
    effect and cheaper ways are drawn on nine parts of this scene, or on all of it where it is
    small: the picture as it is; circles no larger than a power of two (the smallest that will
    do is searched by halving); sprites wider than 8 or 10 pixels in octaves, the larger at the
    lower resolution; scatter's other kernel; the separable filter, diffusion, blending; and
    gather, by as many taps as its variance asks for: from the errors of two numbers of taps
    follow the part that more taps can mend and the part that they can't. Of those within the
    error the quickest is measured on the whole scene and, if its error holds there, taken; or
    else the next, at the last the effect itself. The effect goes no farther in each tile than
    the largest circle that reaches it.

    It costs a program for each way, of which compiling is most, and on a large picture two
    renderings.

    **Arguments:**

    - `image`: height width channel, linear radiance.
    - `depth`: height width, scene units along the optical axis, inf for background.
    - `lens`: gives each depth its signed defocus, in pixels.
    - `max_error`: root mean square, linear image units, over all pixels and channels.
    - `target`: the effect that is approached: `dof.scatter` with `gamma=0`, `epsilon=2` and
      exact kernels, or `dof.layered`, from one layer.

    **Returns:** a `Plan`, to be called with `image, depth, lens`, of this scene or of others
    with no larger circles: those are drawn as large as this scene's largest.

    **Raises:** `ValueError` for a wrong shape, a negative `max_error`, an unknown `target` or
    traced data.

    **Gradient:** none through the choice; the plan's picture has that of what it draws.
    """
    max_error = check_call("dof", max_error, (image, depth, lens))
    image = check_image("dof(image)", image)
    depth = check_depth("dof(depth)", depth, image.shape[:2])
    if target not in ("scatter", "layered"):
        raise ValueError(f'`dof(target=...)` must be "scatter" or "layered", got {target!r}.')
    widest = float(jnp.nanmax(lens.circle_of_confusion(depth)))
    if widest <= 1 and target == "scatter":
        why = f"no circle of confusion passes its pixel: the largest is {widest:.2g} pixels."
        return plan(Method("nothing"), 0.0, 0.0, float("nan"), [f"all, for {why}"])

    largest = largest_coc("dof", depth, lens)
    effect = Method(target, max_coc=largest)
    data = (image, depth, lens)
    search = Search(effect, data, max_error, _parts(data, math.ceil(largest / 2) + 1))
    if search.trial(Method("nothing"), "all blur").error > max_error:
        _smaller_circles(search, target, largest)
        _other_methods(search, target, largest)
        _gathered(search, largest)
    return search.plan()


def _parts(data: Any, margin: int) -> list[Part]:
    """Parts of a scene with what reaches them; none if there are not much fewer pixels."""
    image, depth, lens = data
    side, size = _SIDE + 2 * margin, depth.shape
    if side > min(size) or (_PARTS * side) ** 2 > _SHARE * size[0] * size[1]:
        return []
    core = (slice(margin, margin + _SIDE),) * 2
    corners = [[(n - side) * i // (_PARTS - 1) for i in range(_PARTS)] for n in size]
    windows = [
        (slice(row, row + side), slice(column, column + side))
        for row, column in itertools.product(*corners)
    ]
    return [Part((image[window], depth[window], lens), core) for window in windows]


def _smaller_circles(search: Search, target: str, largest: float) -> None:
    """Try the effect with ever smaller circles, halving the ladder down to the least."""
    sizes = [2.0**octave for octave in range(1, 12) if 2**octave < largest]
    low, high = 0, len(sizes)
    while low < high:
        middle = (low + high) // 2
        text = f"what circles of confusion have above {sizes[middle]:g} pixels"
        error = search.trial(Method(target, max_coc=sizes[middle]), text).error
        low, high = (low, middle) if error <= search.max_error else (middle + 1, high)


def _other_methods(search: Search, target: str, largest: float) -> None:
    """Try what is not the effect, but may be near it."""
    for split in _SPLITS:
        if split < largest:
            text = f"details of sprites wider than {split:g} pixels, at less resolution"
            search.trial(Method("scatter in octaves", max_coc=largest, split=split), text)
    for name in _OTHERS:
        search.trial(Method(name, max_coc=largest), f"exact discs, by {name}")
    if target == "layered":
        search.trial(Method("scatter", max_coc=largest), "what hides what, by scatter")
        return
    height, width = search.whole[0].data[1].shape
    if (kernel := cheapest(height, width, largest)) in _KERNELS:
        text = f'the kernel "{kernel}", by "{_KERNELS[kernel]}"'
        search.trial(Method("scatter", max_coc=largest, kernel=_KERNELS[kernel]), text)


def _gathered(search: Search, largest: float) -> None:
    """Try gather by some taps, by more, and by as many as should do."""

    def errs(taps: int) -> Trial:
        how = Method("gather", max_coc=largest, taps=taps)
        return search.trial(how, f"exact discs, by gather of {taps} taps")

    few = errs(_FEW)
    # More taps take longer still.
    if few.seconds > search.seconds or few.error <= search.max_error:
        return
    more = errs(_MORE)
    # The squared error is `bias + variance / taps`.
    variance = (few.error**2 - more.error**2) / (1 / _FEW - 1 / _MORE)
    room = search.max_error**2 - (more.error**2 - variance / _MORE)
    if room > 0 and _MORE < variance / room <= _MOST:
        errs(2 ** math.ceil(math.log2(variance / room)))
