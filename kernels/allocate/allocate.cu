// The voxel blocks that the band of a depth image crosses: every pixel walks its ray cell by cell and enters the blocks
// into a hash set in device memory.
//
// Layout: a block of threads is 16 x 16 pixels, whose rays cross mostly the same voxel blocks; a small table in shared
// memory keeps what the block of threads has just entered, so that few entries go to the set itself. The set is open
// addressing with linear probing; a new key also goes to a list. What limits it: latency of the walk, 3 to 10 dependent
// steps a pixel, and the shared atomics that drop repetitions.
// Keys are absolute block coordinates, 21 bits an axis with 2^20 added, x highest: sorted, they are in the order of the
// reference.
#include "lookup.cuh"
#include "morton.cuh"

constexpr int EDGE = 16;
constexpr int RECENT = 512;
constexpr unsigned long long EMPTY = ~0ull;

struct View {
    float R[9];          // rows of R_WC, blocks per metre
    float origin[3];     // camera centre in its own block
    int base[3];         // that block
};

// Of the camera: pixel (x, y) has the ray ((x + x_offset) / fx, (y + y_offset) / fy, 1).
struct Rays {
    int width, height;
    float fx, fy, x_offset, y_offset;
};

// Which depths take part, half the width of the band, the outlier guard's largest relative difference (guard: whether
// it is used); ray: whether the band is measured along the ray.
struct Limits {
    float near_m, far_m, truncation_m, outlier_ratio;
    int guard, ray;
};

// The counts: keys in the list; not 0 if the set was too small or a key out of range; keys of blocks that do not exist,
// and the box around those: (2 OFFSET - 1) - the lowest of each coordinate with OFFSET added, and the highest.
enum { KEYS, INSUFFICIENT, MISSING, LOWEST, HIGHEST = LOWEST + 3 };

struct Set {
    unsigned long long* table;
    unsigned long long *list, *codes;  // codes: room for those of missing blocks
    int* count;          // see KEYS
    int mask, room;
};

// Whether one of the eight neighbours lies within a part of the pixel's own depth.
__device__ __forceinline__ bool supported(const float* depth, int x, int y, const Rays& rays, float d, float ratio) {
    const float tolerance = ratio * d;
    bool found = false;
    for (int k = 0; k < 9; k++) {
        const int i = x + k % 3 - 1, j = y + k / 3 - 1;
        if (k != 4 && i >= 0 && i < rays.width && j >= 0 && j < rays.height)
            found = found || fabsf(d - depth[(long long)j * rays.width + i]) < tolerance;
    }
    return found;
}

__device__ __forceinline__ void enter(const Set& set, unsigned long long* recent, unsigned long long key) {
    unsigned long long mixed = key * 0x9E3779B97F4A7C15ull;
    mixed ^= mixed >> 32;
    if (atomicExch(&recent[mixed % RECENT], key) == key) return;
    unsigned slot = (unsigned)(mixed >> 9) & (unsigned)set.mask;
    for (int tries = 0; tries < 256; tries++) {
        unsigned long long held = *(volatile unsigned long long*)&set.table[slot];
        if (held == EMPTY) held = atomicCAS(&set.table[slot], EMPTY, key);
        if (held == key) return;
        if (held == EMPTY) {
            const int at = atomicAdd(&set.count[KEYS], 1);
            if (at < set.room)
                set.list[at] = key;
            else
                set.count[INSUFFICIENT] = 1;
            return;
        }
        slot = (slot + 1) & (unsigned)set.mask;
    }
    set.count[INSUFFICIENT] = 1;
}

// The key of cell (x, y, z), relative to the camera's block; marks the set as insufficient if it does not fit.
__device__ __forceinline__ unsigned long long key_of(const Set& set, const View& view, const int* cell) {
    unsigned long long key = 0;
#pragma unroll
    for (int a = 0; a < 3; a++) {
        const int shifted = cell[a] + view.base[a] + OFFSET;
        if (shifted < 0 || shifted >= 2 * OFFSET) set.count[INSUFFICIENT] = 1;
        key = key << 21 | (unsigned long long)(shifted & (2 * OFFSET - 1));
    }
    return key;
}

// Cells that the segment near .. far of a ray passes, in order: as many steps along each axis as its end cells are
// apart, each time across the nearest wall (Amanatides & Woo 1987).
__device__ __forceinline__ void walk(
    const Set& set, const View& view, unsigned long long* recent, const float* d, float near, float far) {
    int cell[3], left[3], step[3];
    float wall[3], stride[3];  // z where the next wall is, and from wall to wall
#pragma unroll
    for (int a = 0; a < 3; a++) {
        const float from = floorf(d[a] * near + view.origin[a]), to = floorf(d[a] * far + view.origin[a]);
        cell[a] = (int)from;
        left[a] = abs((int)to - cell[a]);
        step[a] = d[a] > 0.0f ? 1 : -1;
        stride[a] = fabsf(1.0f / d[a]);
        wall[a] = (from + (d[a] > 0.0f ? 1.0f : 0.0f) - view.origin[a]) / d[a];
    }
    enter(set, recent, key_of(set, view, cell));
    while (left[0] + left[1] + left[2] > 0) {
        int axis = -1;
        float nearest = 0.0f;
#pragma unroll
        for (int a = 0; a < 3; a++)
            if (left[a] > 0 && (axis < 0 || wall[a] < nearest)) axis = a, nearest = wall[a];
#pragma unroll
        for (int a = 0; a < 3; a++)  // no array is indexed by a variable: it would go to local memory
            if (a == axis) cell[a] += step[a], left[a]--, wall[a] += stride[a];
        enter(set, recent, key_of(set, view, cell));
    }
}

extern "C" __global__ void __launch_bounds__(256) band_blocks(
    const float* depth, Rays rays, Limits limits, View view, Set set) {
    __shared__ unsigned long long recent[RECENT];
    for (int i = threadIdx.x; i < RECENT; i += blockDim.x) recent[i] = EMPTY;
    __syncthreads();
    const int x = blockIdx.x * EDGE + threadIdx.x % EDGE, y = blockIdx.y * EDGE + threadIdx.x / EDGE;
    if (x >= rays.width || y >= rays.height) return;
    const float d = depth[(long long)y * rays.width + x];
    if (!(d > 0.0f && d >= limits.near_m && d <= limits.far_m)) return;
    if (limits.guard && !supported(depth, x, y, rays, d, limits.outlier_ratio)) return;
    const float sx = ((float)x + rays.x_offset) / rays.fx, sy = ((float)y + rays.y_offset) / rays.fy;
    const float half = limits.ray ? limits.truncation_m / sqrtf(sx * sx + sy * sy + 1.0f) : limits.truncation_m;
    const float direction[3] = {
        view.R[0] * sx + view.R[1] * sy + view.R[2], view.R[3] * sx + view.R[4] * sy + view.R[5],
        view.R[6] * sx + view.R[7] * sy + view.R[8]};
    walk(set, view, recent, direction, fmaxf(d - half, 0.0f), d + half);
}

// Of the keys in the list those whose blocks are not in the volume's table, as Morton codes; their number and box.
extern "C" __global__ void __launch_bounds__(256) missing_blocks(Set set, Table table) {
    const int n = min(set.count[KEYS], set.room);
    for (int i = blockIdx.x * blockDim.x + threadIdx.x; i < n; i += gridDim.x * blockDim.x) {
        int shifted[3], block[3];
        unsigned long long code = 0;
#pragma unroll
        for (int a = 0; a < 3; a++) {
            shifted[a] = (int)(set.list[i] >> (BITS * (2 - a)) & (2 * OFFSET - 1)), block[a] = shifted[a] - OFFSET;
            code |= spread(shifted[a]) << a;
        }
        if (row_of(table, block) != NONE) continue;
        set.codes[atomicAdd(&set.count[MISSING], 1)] = code;
#pragma unroll
        for (int a = 0; a < 3; a++) {
            atomicMax(&set.count[LOWEST + a], 2 * OFFSET - 1 - shifted[a]);
            atomicMax(&set.count[HIGHEST + a], shifted[a]);
        }
    }
}

// coords [n, 3]: of the blocks with these Morton codes.
extern "C" __global__ void __launch_bounds__(128) decode_blocks(
    const unsigned long long* codes, long long* coords, int n) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
#pragma unroll
    for (int a = 0; a < 3; a++) coords[3ll * i + a] = gathered(codes[i] >> a) - OFFSET;
}
