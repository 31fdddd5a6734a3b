"""Native peer of reprojection: traversal of a minimum pyramid, ray by ray, in numba."""

import math

import numba
import numpy as np


@numba.njit(inline="always")
def _held(place, node, level):
    """A coordinate as a column or row, clamped to a cell of a level."""
    return min(max(math.floor(place), node << level), ((node + 1) << level) - 1)


@numba.njit(parallel=True, cache=True)
def _walk(values, offsets, columns, size, thickness, origins, directions, times, steps):
    """Fills the time of each ray's hit and its steps, in scalar code as in C.

    Rays start inside the image. Start and changes of level are those of `reproject.intersect`:
    both take the same steps, so that only the time per step is compared.
    """
    never = np.float32(np.inf)
    one, top = np.float32(1), len(offsets) - 1
    for ray in numba.prange(len(origins)):
        ox, oy, oz = origins[ray]
        dx, dy, dz = directions[ray]
        right, down = int(dx > 0), int(dy > 0)
        per_x = one / dx if dx != 0 else never
        per_y = one / dy if dy != 0 else never
        x, y, level = math.floor(ox), math.floor(oy), top
        time, found, count = np.float32(0), np.float32(-1), 0
        while 0 <= x < size[1] and 0 <= y < size[0]:
            count += 1
            node_x, node_y = x >> level, y >> level
            nearest = values[offsets[level] + node_y * columns[level] + node_x]
            edge_x, edge_y = (node_x + right) << level, (node_y + down) << level
            leave_x = (np.float32(edge_x) - ox) * per_x if dx != 0 else never
            leave_y = (np.float32(edge_y) - oy) * per_y if dy != 0 else never
            leave = min(leave_x, leave_y)
            if dz > 0:
                reach = (nearest - oz) / dz
            else:
                reach = -never if oz + time * dz >= nearest else never
            if max(time, reach) < leave:
                if level == 0:
                    found = max(time, reach)
                    break
                if reach > time:
                    time = reach
                    x = _held(ox + time * dx, node_x, level)
                    y = _held(oy + time * dy, node_y, level)
                level = max(level - 2, 0)
                if count == 1 and dz > 0:
                    span = thickness / dz * max(abs(dx), abs(dy))
                    level = min(level, math.ceil(math.log2(max(span / 4, 1))))
                continue
            if leave == never:
                break
            time, last_x, last_y = leave, x, y
            x = (
                edge_x - 1 + right
                if leave_x <= leave_y
                else _held(ox + time * dx, node_x, level)
            )
            y = (
                edge_y - 1 + down
                if leave_y <= leave_x
                else _held(oy + time * dy, node_y, level)
            )
            if (x >> (level + 2)) != (last_x >> (level + 2)) or (
                (y >> (level + 2)) != (last_y >> (level + 2))
            ):
                level += 1
            if level > top:
                break
        times[ray], steps[ray] = found, count


def walk(pyramid, origins, directions):
    """The time of each ray's hit, -1 for a miss, and the steps that it took."""
    times, steps = np.empty(len(origins), np.float32), np.empty(len(origins), np.int32)
    columns = np.array([shape[1] for shape in pyramid.shapes])
    offsets, size = np.array(pyramid.offsets), np.array(pyramid.shapes[0])
    values = np.asarray(pyramid.values)
    depth = values[: size[0] * size[1]]
    thickness = depth.max() - values[-1]
    _walk(values, offsets, columns, size, thickness, origins, directions, times, steps)
    return times, steps
