// The image quadtree bottom-up: sums of the smallest cells, added four by four; each cell tells how many leaves it has.
//
// Layout: the cells of a level are numbered depth first, so the children of cell r are 4 r to 4 r + 3 (top left, bottom
// left, top right, bottom right), and 64 cells in a row make a square. sum_cells: a block of threads sums 64 cells, four
// threads each, and climbs three levels; add_levels: a block takes 1024 cells and climbs five; emit_leaves: one thread
// a cell of the deepest level walks down from the root and counts the leaves that it passes. What limits it: starting
// the kernels. The picture is read once, 3 bytes a pixel, and the leaves are written, 20 bytes each; what one level
// hands to the next stays in the caches.
// Sums are integers, and the contrast is computed in the reference's order of operations: the leaves are the same.
constexpr int LANES = 4;  // threads that share a cell
constexpr int CELLS = 64;  // of a block of sum_cells
constexpr int NODES = 256;  // of a block of add_levels, in the first level that it makes
constexpr int ROOT = 3;  // place of the whole picture in `leaves`: siblings are read together, from a multiple of four
constexpr unsigned ALL = 0xffffffffu;

struct Rule {
    int width, height, levels;  // cells of level `levels` are not cut
    int min_cell_px, released, red, green, blue, denominator;
    double normaliser, threshold;
};

// What a parent needs to know of a part of the picture.
struct Part {
    long long red, green, blue, squares;
    long long leaves;  // of the tree below, if the cells above are all cut
};

struct Cell {
    int x, y, w, h;
};

__device__ __forceinline__ long long place(int level, unsigned rank) {
    return ROOT + ((1LL << 2 * level) - 1) / 3 + rank;
}

__device__ __forceinline__ Cell child(const Cell& c, unsigned k) {
    const int w = c.w >> 1, h = c.h >> 1;
    return {k & 2 ? c.x + w : c.x, k & 1 ? c.y + h : c.y, k & 2 ? c.w - w : w, k & 1 ? c.h - h : h};
}

__device__ __forceinline__ Cell cell_of(int width, int height, int level, unsigned rank) {
    Cell c = {0, 0, width, height};
    for (int bit = 2 * level - 2; bit >= 0; bit -= 2) c = child(c, rank >> bit & 3);
    return c;
}

__device__ __forceinline__ bool is_cut(const Rule& rule, const Cell& c, const Part& p) {
    if (c.w / 2 <= rule.min_cell_px || c.h / 2 <= rule.min_cell_px) return false;
    const double area = (double)((long long)c.w * c.h), pixels = (double)((long long)rule.width * rule.height);
    const double r = (double)p.red / area, g = (double)p.green / area, b = (double)p.blue / area;
    double V = (double)p.squares / area;
    V = V - rule.red * r * r;
    V = V - rule.green * g * g;
    V = V - rule.blue * b * b;
    V = (V > 0.0 ? V : 0.0) / rule.denominator;
    const double value = rule.released ? V * pixels / rule.normaliser : sqrt(V) / 255.0;
    return value > rule.threshold;
}

__device__ __forceinline__ void add(Part& sum, const Part& p) {
    sum.red += p.red, sum.green += p.green, sum.blue += p.blue;
    sum.squares += p.squares, sum.leaves += p.leaves;
}

// From `nodes` cells of a level, one a thread, to the one above them all.
__device__ __forceinline__ void climb(
    const Rule& rule, Part own, Part* shared, int nodes, int level, int* leaves, Part* top) {
    const int t = threadIdx.x;
    for (;; nodes /= 4, level--) {
        if (t < nodes) {
            const unsigned rank = blockIdx.x * nodes + t;
            if (level >= rule.levels || !is_cut(rule, cell_of(rule.width, rule.height, level, rank), own))
                own.leaves = 1;
            if (level < rule.levels) leaves[place(level, rank)] = (int)own.leaves;
            shared[t] = own;
        }
        if (nodes == 1) break;
        __syncthreads();
        if (4 * t < nodes) {
            own = {0, 0, 0, 0, 0};
            for (int k = 0; k < 4; k++) add(own, shared[4 * t + k]);
        }
        __syncthreads();
    }
    if (t == 0) top[blockIdx.x] = own;
}

// leaves: of every cell above level `levels`, at place(). top [blocks]: what add_levels goes on with.
extern "C" __global__ void __launch_bounds__(256) sum_cells(
    const unsigned char* rgb, int* leaves, Part* top, int nodes, int level, Rule rule) {
    __shared__ Part shared[CELLS];
    const int t = threadIdx.x;
    Part own = {0, 0, 0, 0, 4};
    if (t < LANES * nodes) {
        const Cell c = cell_of(rule.width, rule.height, level, blockIdx.x * nodes + t / LANES);
        for (int x = c.x + t % LANES; x < c.x + c.w; x += LANES) {
            const unsigned char* pixel = rgb + 3 * ((long long)c.y * rule.width + x);
#pragma unroll 4
            for (int i = 0; i < c.h; i++, pixel += 3LL * rule.width) {
                const int r = pixel[0], g = pixel[1], b = pixel[2];
                own.red += r, own.green += g, own.blue += b;
                own.squares += rule.red * r * r + rule.green * g * g + rule.blue * b * b;
            }
        }
    }
#pragma unroll
    for (int step = 1; step < LANES; step *= 2) {
        own.red += __shfl_xor_sync(ALL, own.red, step);
        own.green += __shfl_xor_sync(ALL, own.green, step);
        own.blue += __shfl_xor_sync(ALL, own.blue, step);
        own.squares += __shfl_xor_sync(ALL, own.squares, step);
    }
    if (t % LANES == 0) shared[t / LANES] = own;
    __syncthreads();
    if (t < nodes) own = shared[t];
    climb(rule, own, shared, nodes, level, leaves, top);
}

// below: sums of the cells of level + 1.
extern "C" __global__ void __launch_bounds__(256) add_levels(
    const Part* below, int* leaves, Part* top, int nodes, int level, Rule rule) {
    __shared__ Part shared[NODES];
    Part own = {0, 0, 0, 0, 0};
    if ((int)threadIdx.x < nodes) {
        const Part* parts = below + 4 * ((long long)blockIdx.x * nodes + threadIdx.x);
        for (int k = 0; k < 4; k++) add(own, parts[k]);
    }
    climb(rule, own, shared, nodes, level, leaves, top);
}

// The rows of the leaves [COLUMNS, total], as in levels.py.
enum { X0, Y0, WIDTH, HEIGHT, LEVEL, COLUMNS };

// A leaf is written by the first of the deepest cells inside it.
extern "C" __global__ void __launch_bounds__(256) emit_leaves(
    const int* leaves, int* out, int total, int levels, int width, int height) {
    const unsigned rank = blockIdx.x * blockDim.x + threadIdx.x;
    if (rank >> 2 * levels) return;
    Cell c = {0, 0, width, height};
    int level = 0, before = 0, own = total;
    for (; level < levels && own > 1; level++) {
        const int bit = 2 * (levels - level - 1);
        const unsigned k = rank >> bit & 3;
        int4 four = {1, 1, 1, 1};
        if (level + 1 < levels) four = *(const int4*)(leaves + place(level + 1, rank >> bit & ~3u));
        own = k == 0 ? four.x : k == 1 ? four.y : k == 2 ? four.z : four.w;
        before += (k > 0 ? four.x : 0) + (k > 1 ? four.y : 0) + (k > 2 ? four.z : 0);
        c = child(c, k);
    }
    if (rank & ((1u << 2 * (levels - level)) - 1)) return;
    int column[COLUMNS];
    column[X0] = c.x, column[Y0] = c.y, column[WIDTH] = c.w, column[HEIGHT] = c.h, column[LEVEL] = level;
#pragma unroll
    for (int i = 0; i < COLUMNS; i++) out[(long long)i * total + before] = column[i];
}
