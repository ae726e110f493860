// Voxels by their coordinates, through the dense table of the blocks (gsfusion_nb/tsdf/octree.py).
#pragma once

constexpr int VOXELS = 512;
constexpr int NONE = -1;  // row of a block that is not allocated

// Pool row of every block of a box, -1 where there is none.
struct Table {
    const int* rows;
    int low[3], size[3];
};

// Of the voxels; W_rgb: weights of the colours, those of the distances if they have none of their own.
struct Pool {
    const float *D, *W, *planes, *W_rgb;
};

__device__ __forceinline__ int row_of(const Table& table, const int* block) {
    const int x = block[0] - table.low[0], y = block[1] - table.low[1], z = block[2] - table.low[2];
    const int nx = table.size[0], ny = table.size[1], nz = table.size[2];
    if (x < 0 || y < 0 || z < 0 || x >= nx || y >= ny || z >= nz) return NONE;
    return table.rows[(x * ny + y) * nz + z];
}

// Number of a voxel in its block.
__device__ __forceinline__ int number_of(const int* voxel) {
    return 64 * (voxel[0] & 7) + 8 * (voxel[1] & 7) + (voxel[2] & 7);
}
