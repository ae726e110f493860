// Marching cubes straight from the sparse blocks: mark and count, then emit. Order and numbering are the reference's.
//
// Layout: one block of 128 threads a voxel block. Its 9 x 9 x 9 corners (the last layers belong to neighbours) go to
// shared memory as two bits each; a thread then looks at four cubes along z. An edge is one bit, number 3 voxel + axis
// of its lower end, 48 words a block: a vertex's number is the sum of the words before plus the bits before in its own,
// so faces find their vertices without a search. What limits it: memory, 8 bytes a voxel read twice; nothing else is of
// the size of the map.
constexpr int THREADS = 128;
constexpr int VOXELS = 512;
constexpr int WORDS = 48;       // 3 x 512 edge bits of a block
constexpr int SIDE = 9;
constexpr int MOST = 5;         // triangles of a cube

struct Map {
    const float *D, *W;
    const int* neighbour;       // [B, 8]: rows of the block and its upper neighbours, 4 x + 2 y + z; -1: none
    float min_weight;
};

struct Table {
    const signed char *triangles, *count;  // edges of the triangles of every case, and how many triangles
};

// Where the vertices are: bits of the edges that have one [B, 48], and the vertices of all earlier words.
struct Edges {
    const unsigned* words;
    const int* before;
};

// Bit 0: negative; bit 1: observed often enough. Corner (x, y, z) of block b, 0 to 8 an axis.
__device__ __forceinline__ unsigned char corner_bits(const Map& m, int b, int x, int y, int z) {
    const int row = m.neighbour[8LL * b + (x >> 3) * 4 + (y >> 3) * 2 + (z >> 3)];
    if (row < 0) return 0;
    const long long at = (long long)row * VOXELS + (x & 7) * 64 + (y & 7) * 8 + (z & 7);
    const float w = m.W[at];
    return (unsigned char)((m.D[at] < 0.0f ? 1 : 0) | (w >= m.min_weight && w > 0.0f ? 2 : 0));
}

__device__ __forceinline__ void load_corners(const Map& m, int b, unsigned char* corners) {
    for (int i = threadIdx.x; i < SIDE * SIDE * SIDE; i += THREADS)
        corners[i] = corner_bits(m, b, i / (SIDE * SIDE), i / SIDE % SIDE, i % SIDE);
    __syncthreads();
}

// Set of negative corners, bit x + 2 y + 4 z; 0 for a cube that is not meshed.
__device__ __forceinline__ int case_of(const unsigned char* corners, int n) {
    const unsigned char* lowest = corners + (n >> 6) * SIDE * SIDE + (n >> 3 & 7) * SIDE + (n & 7);
    int all = 2, negative = 0;
#pragma unroll
    for (int c = 0; c < 8; c++) {
        const int bits = lowest[(c & 1) * SIDE * SIDE + (c >> 1 & 1) * SIDE + (c >> 2)];
        all &= bits;
        negative |= (bits & 1) << c;
    }
    return all && negative != 255 ? negative : 0;
}

// Number of the edge of a cube in the order of all edges: 3 x (place in the pool of its lower voxel) + axis.
// edge: the reference's number; its axis is edge / 4, and its lower corner one of the four without that axis' bit.
__device__ __forceinline__ long long edge_key(const Map& m, int b, int n, int edge) {
    const int axis = edge >> 2, k = edge & 3;
    const int low = (1 << axis) - 1, corner = (k & low) | (k & ~low) << 1;
    const int x = (n >> 6) + (corner & 1), y = (n >> 3 & 7) + (corner >> 1 & 1), z = (n & 7) + (corner >> 2);
    const long long row = m.neighbour[8LL * b + (x >> 3) * 4 + (y >> 3) * 2 + (z >> 3)];
    return 3 * (row * VOXELS + (x & 7) * 64 + (y & 7) * 8 + (z & 7)) + axis;
}

// triangles [B]: of each block. words [B, 48]: bits of the edges that have a vertex; zero before.
extern "C" __global__ void __launch_bounds__(128) mark_edges(Map m, Table table, int* triangles, unsigned* words) {
    __shared__ unsigned char corners[SIDE * SIDE * SIDE];
    __shared__ int total;
    const int b = blockIdx.x;
    if (threadIdx.x == 0) total = 0;
    load_corners(m, b, corners);
    for (int n = 4 * threadIdx.x; n < 4 * (int)threadIdx.x + 4; n++) {
        const int number = case_of(corners, n);
        if (!number) continue;
        const int count = table.count[number];
        atomicAdd(&total, count);
        unsigned used = 0;
        for (int i = 0; i < 3 * count; i++) used |= 1u << table.triangles[number * 3 * MOST + i];
        while (used) {
            const long long key = edge_key(m, b, n, __ffs(used) - 1);
            used &= used - 1;
            atomicOr(&words[key >> 5], 1u << (key & 31));
        }
    }
    __syncthreads();
    if (threadIdx.x == 0) triangles[b] = total;
}

extern "C" __global__ void __launch_bounds__(128) count_vertices(const unsigned* words, int* vertices, int n_words) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i < n_words) vertices[i] = __popc(words[i]);
}

// One thread an edge bit. planes [B, 3, 512]: colours. coords [B, 3]: of the blocks.
extern "C" __global__ void __launch_bounds__(128) emit_vertices(
    Map m, Edges edges, const float* planes, const int* coords, double voxel_size_m, float* vertices, float* rgb) {
    const int b = blockIdx.x, edge = blockIdx.y * THREADS + threadIdx.x;
    const long long word = (long long)b * WORDS + edge / 32;
    const unsigned bits = edges.words[word];
    if (!(bits >> (edge % 32) & 1)) return;
    const int at = edges.before[word] + __popc(bits & ((1u << (edge % 32)) - 1));
    const int n = edge / 3, axis = edge % 3;
    const int here[3] = {n >> 6, n >> 3 & 7, n & 7};
    const int there[3] = {here[0] + (axis == 0), here[1] + (axis == 1), here[2] + (axis == 2)};
    const int row = m.neighbour[8LL * b + (there[0] >> 3) * 4 + (there[1] >> 3) * 2 + (there[2] >> 3)];
    const int other = (there[0] & 7) * 64 + (there[1] & 7) * 8 + (there[2] & 7);
    const float D0 = m.D[(long long)b * VOXELS + n], D1 = m.D[(long long)row * VOXELS + other], t = D0 / (D0 - D1);
#pragma unroll
    for (int k = 0; k < 3; k++) {
        const double place = coords[3LL * b + k] * 8.0 + here[k] + 0.5 + (axis == k ? (double)t : 0.0);
        vertices[3LL * at + k] = (float)(place * voxel_size_m);
        const float c0 = planes[(3LL * b + k) * VOXELS + n], c1 = planes[(3LL * row + k) * VOXELS + other];
        rgb[3LL * at + k] = t < 0.5f ? c0 + t * (c1 - c0) : c1 - (c1 - c0) * (1.0f - t);
    }
}

// first [B]: triangles of earlier blocks.
extern "C" __global__ void __launch_bounds__(128) emit_triangles(
    Map m, Table table, Edges edges, const int* triangles, const int* first, long long* faces) {
    __shared__ unsigned char corners[SIDE * SIDE * SIDE];
    __shared__ int of_warp[THREADS / 32];
    const int b = blockIdx.x, lane = threadIdx.x % 32, warp = threadIdx.x / 32;
    if (triangles[b] == 0) return;
    load_corners(m, b, corners);
    int number[4], mine = 0;
#pragma unroll
    for (int k = 0; k < 4; k++) {
        number[k] = case_of(corners, 4 * threadIdx.x + k);
        if (number[k]) mine += table.count[number[k]];
    }
    int sum = mine;  // of this lane and those before
#pragma unroll
    for (int step = 1; step < 32; step *= 2) {
        const int other = __shfl_up_sync(0xffffffffu, sum, step);
        if (lane >= step) sum += other;
    }
    if (lane == 31) of_warp[warp] = sum;
    __syncthreads();
    long long at = first[b] + sum - mine;
    for (int w = 0; w < warp; w++) at += of_warp[w];
#pragma unroll
    for (int k = 0; k < 4; k++) {
        const int corners_of_all = number[k] ? 3 * table.count[number[k]] : 0;
        for (int i = 0; i < corners_of_all; i++) {
            const long long key = edge_key(m, b, 4 * threadIdx.x + k, table.triangles[number[k] * 3 * MOST + i]);
            const unsigned bits = edges.words[key >> 5];
            faces[3 * at + i] = edges.before[key >> 5] + __popc(bits & ((1u << (key & 31)) - 1));
        }
        at += corners_of_all / 3;
    }
}
