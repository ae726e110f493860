// Which tiles each Gaussian touches: count, then list. The box is that of the ellipse alpha = 1/255 (opacity-aware) and
// each row of tiles is cut exactly, so that no tile is listed that the Gaussian does not reach.
//
// Layout: one thread a Gaussian, 128 a block. A Gaussian with more than FEW tiles is listed by its whole warp, 32
// columns at a time, so that a large one does not hold up 31 others. Counting is limited by memory (48 bytes a row),
// listing by the latency of its scattered 6-byte writes. Both take the same roots with the same roundings.
#include "splat.cuh"

constexpr int FEW = 8;

struct Grid {
    int width, height, tiles_x;
};

// The (splat, tile) pairs to be written. order: of rows; end: of each of them in that order, one past its last
// pair; count: by row; active: of each tile, whether it is wanted, or null for all. Of the two arrays of tiles the one
// that is wide enough is not null.
struct Pairs {
    const long long *order, *end;
    const int* count;
    const unsigned char* active;
    short* short_tile;
    int *tile, *ids;
};

// before [tiles_y, tiles_x + 1]: number of wanted tiles before each column, or null if all are wanted.
extern "C" __global__ void __launch_bounds__(128) count_tiles(
    const float4* splats, const float* depth, const int* before, int* count, int N, Grid grid) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= N) return;
    int n = 0;
    if (depth[i] < __int_as_float(0x7f800000)) {
        const Splat s = load_splat(splats, i);
        const Range rows = tile_rows(s, grid.height);
        for (int ty = rows.first; ty < rows.end; ty++) {
            const Range columns = tile_columns(s, ty, grid.width);
            const int* line = before + ty * (grid.tiles_x + 1);
            n += before ? line[columns.end] - line[columns.first] : columns.end - columns.first;
        }
    }
    count[i] = n;
}

// Keys are 16 bits wide where all numbers of tiles fit, which halves the passes of the sort.
__device__ __forceinline__ void write_pair(const Pairs& pairs, int at, int t, int g) {
    if (pairs.short_tile)
        pairs.short_tile[at] = (short)t;
    else
        pairs.tile[at] = t;
    pairs.ids[at] = g;
}

extern "C" __global__ void __launch_bounds__(128, 8) list_tiles(const float4* splats, Pairs pairs, int N, Grid grid) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x, lane = threadIdx.x % 32;
    int g = 0, n = 0, at = 0;
    if (i < N) {
        g = (int)pairs.order[i];
        n = pairs.count[g];
        at = (int)pairs.end[i] - n;
    }
    if (n > 0 && n <= FEW) {
        const Splat s = load_splat(splats, g);
        const Range rows = tile_rows(s, grid.height);
        for (int ty = rows.first; ty < rows.end; ty++) {
            const Range columns = tile_columns(s, ty, grid.width);
            for (int tx = columns.first; tx < columns.end; tx++) {
                const int t = ty * grid.tiles_x + tx;
                if (!pairs.active || pairs.active[t]) write_pair(pairs, at++, t, g);
            }
        }
    }
    unsigned large = __ballot_sync(FULL, n > FEW);
    while (large) {
        const int owner = __ffs(large) - 1;
        large &= large - 1;
        const int row = __shfl_sync(FULL, g, owner);
        int place = __shfl_sync(FULL, at, owner);
        const Splat s = load_splat(splats, row);
        const Range rows = tile_rows(s, grid.height);
        for (int ty = rows.first; ty < rows.end; ty++) {
            const Range columns = tile_columns(s, ty, grid.width);
            for (int first = columns.first; first < columns.end; first += 32) {
                const int tx = first + lane, t = ty * grid.tiles_x + tx;
                const unsigned listed = __ballot_sync(FULL, tx < columns.end && (!pairs.active || pairs.active[t]));
                const int mine = place + __popc(listed & ((1u << lane) - 1));
                if (listed >> lane & 1) write_pair(pairs, mine, t, row);
                place += __popc(listed);
            }
        }
    }
}
