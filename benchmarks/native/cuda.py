"""Native peers on a GPU: scatter's sums, their adjoint, a shadow filter, a pyramid traversal.

Hand-written CUDA, launched by CuPy where that is installed. Arrays are contiguous float32; an
image is stored plane by plane.
"""

import numpy as np


# Threads per block, along x and y.
BLOCK = (32, 8)

SOURCE = r"""
#define WIDE 32
#define TALL 8

__device__ float clamp01(float x) { return fminf(fmaxf(x, 0.0f), 1.0f); }
__device__ float inside01(float x) { return x >= 0.0f && x < 1.0f ? 1.0f : 0.0f; }

// The mean half-width of a disc within a row of pixels, and its derivative in the radius.
__device__ float half_width(float r, int row, float* slope) {
    float a = fminf(fmaxf(row - 0.5f, -r), r), b = fminf(fmaxf(row + 0.5f, -r), r);
    float ca = sqrtf((r - a) * (r + a)), cb = sqrtf((r - b) * (r + b));
    float angle = atan2f(b, cb) - atan2f(a, ca);
    *slope = r * angle;
    return 0.5f * (b * cb - a * ca + r * r * angle);
}

__device__ float cover_of(float width, int column, float* slope) {
    int far = abs(column);
    float passed = far ? width + 0.5f - far : 2.0f * width;
    *slope = inside01(passed) * (far ? 1.0f : 2.0f);
    return clamp01(passed);
}

// The sources around a block are loaded to shared memory one row at a time.
#define FOR_ROWS(...)                                                                    \
    const int x = blockIdx.x * WIDE + threadIdx.x, y = blockIdx.y * TALL + threadIdx.y;  \
    const int here = y * width + x, size = height * width, span = WIDE + 2 * reach;      \
    const bool is_here = x < width && y < height;                                        \
    extern __shared__ float shared[];                                                    \
    float* line = shared + threadIdx.y * span * PLANES;                                  \
    __VA_ARGS__

// Loads a row of sources: value, leak, and half-width, which is negative outside the image.
#define LOAD_SOURCES(row)                                                                \
    for (int k = threadIdx.x; k < span; k += WIDE) {                                     \
        int sx = blockIdx.x * WIDE + k - reach, sy = y + row, s = sy * width + sx;       \
        bool known = sx >= 0 && sx < width && sy >= 0 && sy < height;                    \
        for (int c = 0; c < 4; ++c) line[c * span + k] = known ? value[c * size + s] : 0; \
        line[4 * span + k] = known ? leak[s] : 0;                                        \
        line[5 * span + k] = known ? half_width(radius[s], row, &slope) : -1;            \
    }

extern "C" __global__ void scatter(
    float* sums, const float* value, const float* radius, const float* leak, const float* coc,
    int height, int width, int reach
) {
    #define PLANES 6
    FOR_ROWS(float total[4] = {0, 0, 0, 0};)
    float own = is_here ? coc[here] : 0, sharp = 1 - clamp01(own - 1), slope;
    for (int row = -reach; row <= reach; ++row) {
        LOAD_SOURCES(row)
        __syncthreads();
        for (int column = -reach; column <= reach; ++column) {
            int k = threadIdx.x + reach + column;
            float weight = cover_of(line[5 * span + k], column, &slope);
            weight *= 1 - sharp * clamp01(line[4 * span + k] - own);
            for (int c = 0; c < 4; ++c) total[c] += weight * line[c * span + k];
        }
        __syncthreads();
    }
    if (is_here) for (int c = 0; c < 4; ++c) sums[c * size + here] = total[c];
    #undef PLANES
}

// Adjoint of the sums with respect to each source's value, radius and leak.
extern "C" __global__ void adjoint_source(
    float* value_bar, float* radius_bar, float* leak_bar, const float* value,
    const float* radius, const float* leak, const float* coc, const float* bar,
    int height, int width, int reach
) {
    #define PLANES 5
    FOR_ROWS(float total[6] = {0, 0, 0, 0, 0, 0}, mine[4] = {0, 0, 0, 0};)
    float r = is_here ? radius[here] : 0.5f, from = is_here ? leak[here] : 0;
    for (int c = 0; is_here && c < 4; ++c) mine[c] = value[c * size + here];
    for (int row = -reach; row <= reach; ++row) {
        for (int k = threadIdx.x; k < span; k += WIDE) {
            int sx = blockIdx.x * WIDE + k - reach, sy = y + row, s = sy * width + sx;
            bool known = sx >= 0 && sx < width && sy >= 0 && sy < height;
            for (int c = 0; c < 4; ++c) line[c * span + k] = known ? bar[c * size + s] : 0;
            line[4 * span + k] = known ? coc[s] : 0;
        }
        __syncthreads();
        float grow, slope, half = half_width(r, row, &grow);
        for (int column = -reach; column <= reach; ++column) {
            int k = threadIdx.x + reach + column;
            float cover = cover_of(half, column, &slope), there = line[4 * span + k];
            float sharp = 1 - clamp01(there - 1), rise = from - there, product = 0;
            float weight = 1 - sharp * clamp01(rise);
            for (int c = 0; c < 4; ++c) {
                total[c] += cover * weight * line[c * span + k];
                product += mine[c] * line[c * span + k];
            }
            total[4] += slope * grow * weight * product;
            total[5] -= cover * sharp * inside01(rise) * product;
        }
        __syncthreads();
    }
    if (!is_here) return;
    for (int c = 0; c < 4; ++c) value_bar[c * size + here] = total[c];
    radius_bar[here] = total[4];
    leak_bar[here] = total[5];
    #undef PLANES
}

// Adjoint of the sums with respect to the target's circle of confusion.
extern "C" __global__ void adjoint_target(
    float* coc_bar, const float* value, const float* radius, const float* leak,
    const float* coc, const float* bar, int height, int width, int reach
) {
    #define PLANES 6
    FOR_ROWS(float total = 0, mine[4] = {0, 0, 0, 0}, slope;)
    float own = is_here ? coc[here] : 0;
    float sharp = 1 - clamp01(own - 1), blurring = inside01(own - 1);
    for (int c = 0; is_here && c < 4; ++c) mine[c] = bar[c * size + here];
    for (int row = -reach; row <= reach; ++row) {
        LOAD_SOURCES(row)
        __syncthreads();
        for (int column = -reach; column <= reach; ++column) {
            int k = threadIdx.x + reach + column;
            float rise = line[4 * span + k] - own, product = 0;
            for (int c = 0; c < 4; ++c) product += mine[c] * line[c * span + k];
            float weight = sharp * inside01(rise) + blurring * clamp01(rise);
            total += cover_of(line[5 * span + k], column, &slope) * weight * product;
        }
        __syncthreads();
    }
    if (is_here) coc_bar[here] = total;
    #undef PLANES
}

extern "C" __global__ void pcf(
    float* lit, const float* map, const float* u, const float* v, const float* z, float bias,
    int rows, int columns, int height, int width, int side
) {
    int x = blockIdx.x * WIDE + threadIdx.x, y = blockIdx.y * TALL + threadIdx.y;
    if (x >= width || y >= height) return;
    int here = y * width + x, dark = 0;
    int left = (int)floorf(u[here]) - side / 2, top = (int)floorf(v[here]) - side / 2;
    for (int j = max(top, 0); j < min(top + side, rows); ++j)
        for (int i = max(left, 0); i < min(left + side, columns); ++i)
            dark += map[j * columns + i] < z[here] - bias;
    lit[here] = 1 - (float)dark / (side * side);
}

__device__ int held(float place, int node, int level) {
    return min(max((int)floorf(place), node << level), ((node + 1) << level) - 1);
}

// Traversal of a minimum pyramid: the time of each ray's hit, -1 for a miss.
extern "C" __global__ void walk(
    float* times, const float* values, const int* offsets, const int* columns,
    const float* origins, const float* directions, int levels, int height, int width, int rays
) {
    int ray = blockIdx.x * WIDE * TALL + threadIdx.y * WIDE + threadIdx.x;
    if (ray >= rays) return;
    float ox = origins[3 * ray], oy = origins[3 * ray + 1], oz = origins[3 * ray + 2];
    float dx = directions[3 * ray], dy = directions[3 * ray + 1], dz = directions[3 * ray + 2];
    const float never = 1e30f;
    int right = dx > 0, down = dy > 0, x = (int)floorf(ox), y = (int)floorf(oy);
    int level = levels - 1;
    float time = 0, found = -1;
    while (x >= 0 && x < width && y >= 0 && y < height && level < levels) {
        int node_x = x >> level, node_y = y >> level;
        float nearest = values[offsets[level] + node_y * columns[level] + node_x];
        int edge_x = (node_x + right) << level, edge_y = (node_y + down) << level;
        float leave_x = dx != 0 ? (edge_x - ox) / dx : never;
        float leave_y = dy != 0 ? (edge_y - oy) / dy : never;
        float leave = fminf(leave_x, leave_y);
        float reach = dz > 0 ? (nearest - oz) / dz : never;
        if (dz <= 0 && oz + time * dz >= nearest) reach = -never;
        if (fmaxf(time, reach) < leave) {
            if (level == 0) { found = fmaxf(time, reach); break; }
            if (reach > time) {
                time = reach;
                x = held(ox + time * dx, node_x, level);
                y = held(oy + time * dy, node_y, level);
            }
            level = max(level - 2, 0);
            continue;
        }
        if (leave >= never) break;
        time = leave;
        int last_x = x, last_y = y;
        x = leave_x <= leave_y ? edge_x - 1 + right : held(ox + time * dx, node_x, level);
        y = leave_y <= leave_x ? edge_y - 1 + down : held(oy + time * dy, node_y, level);
        int up = level + 2;
        if ((x >> up) != (last_x >> up) || (y >> up) != (last_y >> up)) level += 1;
    }
    times[ray] = found;
}
"""

# The planes that each kernel keeps in shared memory.
SHARED = {"scatter": 6, "adjoint_source": 5, "adjoint_target": 6, "pcf": 0, "walk": 0}


def cupy():
    """CuPy where it is installed and finds a device, else None."""
    try:
        import cupy

        cupy.cuda.runtime.getDeviceCount()
    except Exception:  # The package, a driver or a device is missing.
        return None
    return cupy


def launch(module, name, grid, arguments, reach=0):
    """Start one kernel of `SOURCE`, compiled by CuPy, without waiting for it."""
    shared = 4 * SHARED[name] * BLOCK[1] * (BLOCK[0] + 2 * reach)
    module.get_function(name)(grid, BLOCK, arguments, shared_mem=shared)


def grid_of(height, width):
    """The number of blocks that cover an image, along x and y."""
    return -(-width // BLOCK[0]), -(-height // BLOCK[1])


def sums(cupy, module, planes, reach, bar=None):
    """A function that launches scatter's sums or, given `bar`, their adjoint; and the outputs.

    `planes` are `value`, `radius`, `leak` and `coc`, on the device.
    """
    height, width = planes[0].shape[1:]
    sizes, grid = tuple(map(np.int32, (height, width, reach))), grid_of(height, width)
    if bar is None:
        out = cupy.empty_like(planes[0])
        return lambda: launch(module, "scatter", grid, (out, *planes, *sizes), reach), (out,)
    out = tuple(map(cupy.empty_like, planes))

    def adjoint():
        inputs = (*planes, bar, *sizes)
        launch(module, "adjoint_source", grid, (*out[:3], *inputs), reach)
        launch(module, "adjoint_target", grid, (out[3], *inputs), reach)

    return adjoint, out
