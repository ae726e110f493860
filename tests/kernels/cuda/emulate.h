// CUDA C++ on a CPU, for tests: the threads of a block are fibres that take turns, so that barriers, shuffles, votes,
// atomics and shared memory behave as on a GPU. Blocks run one after another. A barrier that some threads never reach
// ends the launch with a sentence, and so does a warp operation that a lane has left out.
#pragma once

#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <tuple>
#include <utility>
#include <vector>

#define __global__
#define __device__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __shared__ static

struct float3 { float x, y, z; };
struct alignas(16) float4 { float x, y, z, w; };
struct alignas(16) int4 { int x, y, z, w; };
struct Index { int x = 0, y = 0, z = 0; };

inline float3 make_float3(float x, float y, float z) { return {x, y, z}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

inline Index threadIdx, blockIdx, blockDim, gridDim;

namespace emulator {

constexpr int WARP = 32;
constexpr std::size_t STACK = 256 * 1024;

struct Warp {
    std::uint64_t slot[2][WARP] = {};
    int arrived = 0;
    unsigned generation = 0;
};

struct Fibre {
    ucontext_t context;
    bool done = false;
};

struct Block {
    std::vector<Fibre> fibres;
    std::vector<Warp> warps;
    std::vector<char*> stacks;
    ucontext_t scheduler;
    int current = 0, arrived = 0, votes = 0, result = 0;
    unsigned generation = 0;
    bool progress = false;
    void (*call)(void*) = nullptr;
    void* argument = nullptr;
};

inline Block block;

inline void yield() {
    const int me = block.current;
    swapcontext(&block.fibres[me].context, &block.scheduler);
}

inline int lane() { return block.current % WARP; }
inline Warp& warp() { return block.warps[block.current / WARP]; }

// Every lane leaves a value and goes on when all have; the two sets of slots alternate, so none is overwritten early.
inline const std::uint64_t* meet(std::uint64_t value) {
    Warp& w = warp();
    const unsigned generation = w.generation;
    w.slot[generation & 1][lane()] = value;
    const int lanes = std::min<int>(WARP, blockDim.x - block.current / WARP * WARP);
    if (++w.arrived == lanes) {
        w.arrived = 0, w.generation++, block.progress = true;
    } else {
        while (w.generation == generation) yield();
    }
    return w.slot[generation & 1];
}

inline int barrier(bool vote) {
    const unsigned generation = block.generation;
    block.votes += vote;
    if (++block.arrived == blockDim.x) {
        block.result = block.votes, block.votes = block.arrived = 0;
        block.generation++, block.progress = true;
    } else {
        while (block.generation == generation) yield();
    }
    return block.result;
}

template <class T>
std::uint64_t bits_of(T value) {
    std::uint64_t bits = 0;
    std::memcpy(&bits, &value, sizeof value);
    return bits;
}

template <class T>
T value_of(std::uint64_t bits) {
    T value;
    std::memcpy(&value, &bits, sizeof value);
    return value;
}

inline void enter() {
    block.call(block.argument);
    block.fibres[block.current].done = true;
    block.progress = true;
}

// The lanes of a warp in turn until none gets on; how many have ended.
inline int run_warp(int number, int threads) {
    int ended = 0;
    for (block.progress = true; block.progress;) {
        block.progress = false;
        for (int i = number * WARP; i < std::min(threads, number * WARP + WARP); i++) {
            if (block.fibres[i].done) continue;
            block.current = i, threadIdx.x = i;
            swapcontext(&block.scheduler, &block.fibres[i].context);
            ended += block.fibres[i].done;
        }
    }
    return ended;
}

// One block of threads; a sentence if its threads wait for each other for ever.
inline const char* run_block(int threads) {
    block.arrived = block.votes = 0;
    block.warps.assign((threads + WARP - 1) / WARP, Warp());
    block.fibres.assign(threads, Fibre());
    while ((int)block.stacks.size() < threads) block.stacks.push_back(static_cast<char*>(std::malloc(STACK)));
    for (int i = 0; i < threads; i++) {
        ucontext_t& c = block.fibres[i].context;
        getcontext(&c);
        c.uc_stack.ss_sp = block.stacks[i], c.uc_stack.ss_size = STACK, c.uc_link = &block.scheduler;
        makecontext(&c, enter, 0);
    }
    const int warps = block.warps.size();
    for (int left = threads; left > 0;) {
        const int before = left;
        const unsigned generation = block.generation;
        // A warp runs as far as it can before the next one has its turn, first to last and last to first by turns:
        // what one leaves for another without a barrier comes too late or too early.
        for (int i = 0; i < warps; i++) left -= run_warp(blockIdx.x % 2 ? warps - 1 - i : i, threads);
        if (left == before && block.generation == generation)
            return "some threads wait at a barrier or warp operation that others never reach";
    }
    return nullptr;
}

template <class... A, std::size_t... I>
const char* run_grid(void (*kernel)(A...), int x, int y, int threads, void** values, std::index_sequence<I...>) {
    auto bound = [&] { kernel(*static_cast<A*>(values[I])...); };
    block.call = [](void* f) { (*static_cast<decltype(bound)*>(f))(); };
    block.argument = &bound;
    gridDim = {x, y, 1}, blockDim = {threads, 1, 1};
    for (int j = 0; j < y; j++)
        for (int i = 0; i < x; i++) {
            blockIdx = {i, j, 0};
            if (const char* problem = run_block(threads)) return problem;
        }
    return nullptr;
}

template <class... A>
const char* run(void (*kernel)(A...), int x, int y, int threads, void** values) {
    return run_grid(kernel, x, y, threads, values, std::index_sequence_for<A...>());
}

}  // namespace emulator

#define EMULATE(KERNEL)                                                                     \
    extern "C" const char* emulate_##KERNEL(int x, int y, int threads, void** values) {     \
        return emulator::run(KERNEL, x, y, threads, values);                                \
    }

inline void __syncthreads() { emulator::barrier(false); }
inline int __syncthreads_count(bool vote) { return emulator::barrier(vote); }

template <class T>
T __shfl_sync(unsigned, T value, int from) {
    return emulator::value_of<T>(emulator::meet(emulator::bits_of(value))[from]);
}
template <class T>
T __shfl_xor_sync(unsigned, T value, int mask) {
    const int lane = emulator::lane();
    return emulator::value_of<T>(emulator::meet(emulator::bits_of(value))[lane ^ mask]);
}
template <class T>
T __shfl_up_sync(unsigned, T value, int distance) {
    const int lane = emulator::lane();
    const std::uint64_t* all = emulator::meet(emulator::bits_of(value));
    return emulator::value_of<T>(all[lane >= distance ? lane - distance : lane]);
}
inline unsigned __ballot_sync(unsigned, bool vote) {
    const std::uint64_t* all = emulator::meet(vote);
    unsigned bits = 0;
    for (int i = 0; i < emulator::WARP; i++) bits |= (unsigned)all[i] << i;
    return bits;
}
inline bool __any_sync(unsigned mask, bool vote) { return __ballot_sync(mask, vote) != 0; }
inline bool __all_sync(unsigned mask, bool vote) { return __ballot_sync(mask, !vote) == 0; }

template <class T, class U>
T atomicAdd(T* at, U value) {
    const T old = *at;
    *at = old + value;
    return old;
}
template <class T>
T atomicExch(T* at, T value) {
    return std::exchange(*at, value);
}
template <class T>
T atomicCAS(T* at, T expected, T value) {
    const T old = *at;
    if (old == expected) *at = value;
    return old;
}
template <class T>
T atomicMin(T* at, T value) {
    const T old = *at;
    *at = std::min(old, value);
    return old;
}

template <class T>
T atomicMax(T* at, T value) {
    const T old = *at;
    *at = std::max(old, value);
    return old;
}

template <class T>
T atomicOr(T* at, T value) {
    const T old = *at;
    *at = old | value;
    return old;
}

inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __float_as_int(float x) { return emulator::value_of<int>(emulator::bits_of(x)); }
inline int min(int a, int b) { return std::min(a, b); }
inline int max(int a, int b) { return std::max(a, b); }
inline float __int_as_float(int x) { return emulator::value_of<float>(emulator::bits_of(x)); }
