// Voxels by their coordinates, through the table of the blocks (gsfusion_nb/tsdf/octree.py).
#pragma once

constexpr int VOXELS = 512;
constexpr int NONE = -1;  // row of a block that is not allocated
constexpr int NODE_BITS = 4, IN_NODE = (1 << NODE_BITS) - 1;

// The number of each node of a box, and the pool row of each block of each node; those of node 0 are NONE.
struct Table {
    const int *nodes, *rows;
    int low[3], size[3];
};

// Of the voxels; W_rgb: weights of the colours, those of the distances if they have none of their own.
struct Pool {
    const float *D, *W, *planes, *W_rgb;
};

__device__ __forceinline__ int row_of(const Table& table, const int* block) {
    const int x = (block[0] >> NODE_BITS) - table.low[0], y = (block[1] >> NODE_BITS) - table.low[1];
    const int z = (block[2] >> NODE_BITS) - table.low[2];
    const int nx = table.size[0], ny = table.size[1], nz = table.size[2];
    if (x < 0 || y < 0 || z < 0 || x >= nx || y >= ny || z >= nz) return NONE;
    const int bx = block[0] & IN_NODE, by = block[1] & IN_NODE, bz = block[2] & IN_NODE;
    const int number = (bx << NODE_BITS | by) << NODE_BITS | bz;
    return table.rows[((long long)table.nodes[(x * ny + y) * nz + z] << 3 * NODE_BITS) + number];
}

// Number of a voxel in its block.
__device__ __forceinline__ int number_of(const int* voxel) {
    return 64 * (voxel[0] & 7) + 8 * (voxel[1] & 7) + (voxel[2] & 7);
}
