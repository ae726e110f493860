// Morton codes of blocks (gsfusion_nb/tsdf/morton.py).
#pragma once

constexpr int BITS = 21, OFFSET = 1 << (BITS - 1);

// Bit i of a 21-bit number becomes bit 3 i.
__device__ __forceinline__ unsigned long long spread(int number) {
    unsigned long long x = (unsigned long long)number;
    x = (x | x << 32) & 0x001F00000000FFFFull;
    x = (x | x << 16) & 0x001F0000FF0000FFull;
    x = (x | x << 8) & 0x100F00F00F00F00Full;
    x = (x | x << 4) & 0x10C30C30C30C30C3ull;
    return (x | x << 2) & 0x1249249249249249ull;
}

// Every third bit of a code, from the lowest on.
__device__ __forceinline__ int gathered(unsigned long long x) {
    x &= 0x1249249249249249ull;
    x = (x | x >> 2) & 0x10C30C30C30C30C3ull;
    x = (x | x >> 4) & 0x100F00F00F00F00Full;
    x = (x | x >> 8) & 0x001F0000FF0000FFull;
    x = (x | x >> 16) & 0x001F00000000FFFFull;
    return (int)((x | x >> 32) & ((1ull << BITS) - 1));
}
