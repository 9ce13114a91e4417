// A team of threads that shares one environment: the threads of a block on CUDA. Compiled for the
// CPU, where the tests use it, the team is a single thread.
//
// Every thread computes with plain numbers. Memory is laid out as with L = 1, with TEAM_LANES
// items side by side, so that the threads of a warp read neighbouring numbers. Threads must not add
// to the same node: each item leaves the forces on its corners in a place of its own, and each node
// collects them in a fixed order, so that equal inputs give equal bits.
#pragma once
#include "vec3.h"

namespace codesign {

constexpr int TEAM = 0;  // the L of a team
constexpr int TEAM_LANES = 32;
constexpr int MOST_SUMS = 16;  // values that Lanes<TEAM>::total takes at once
constexpr int ROW = 4;  // values per node and lane: x, y, z and padding to a 16-byte row

// Where the forces of a group go: to the nodes, or left at the corners of the tetrahedra and of
// the surface triangles.
struct Forces {
    float *nodes, *tets, *triangles;
};

CODESIGN_INLINE float root(float a) { return sqrtf(a); }
CODESIGN_INLINE bool any(bool mask) { return mask; }
CODESIGN_INLINE bool any(int mask) { return mask != 0; }
CODESIGN_INLINE bool every(bool mask) { return mask; }
CODESIGN_INLINE bool every(int mask) { return mask != 0; }

template <> struct Lanes<TEAM> {
    static constexpr int width = TEAM_LANES;
    static constexpr int copies = TEAM_LANES;
    static constexpr int batch = 1;
    static constexpr int environments = 1;
    typedef float F;
    typedef int I;

#ifdef __CUDACC__
    CODESIGN_INLINE int first() { return threadIdx.x; }
    CODESIGN_INLINE int stride() { return blockDim.x; }
    CODESIGN_INLINE void barrier() { __syncthreads(); }
    CODESIGN_INLINE bool somewhere(bool mask) { return __syncthreads_or(mask); }

    // Calls combine(a, b) over the team in a fixed order, for each of `count` values.
    template <class Combine> CODESIGN_INLINE void reduce(F* values, int count, Combine combine) {
        __shared__ float partial[32][MOST_SUMS];
        for (int k = 0; k < count; ++k)
            for (int step = 16; step > 0; step /= 2)
                values[k] = combine(values[k], __shfl_xor_sync(0xffffffffu, values[k], step));
        if (threadIdx.x % 32 == 0)
            for (int k = 0; k < count; ++k)
                partial[threadIdx.x / 32][k] = values[k];
        __syncthreads();
        for (int k = 0; k < count; ++k) {
            values[k] = partial[0][k];
            for (int warp = 1; warp < blockDim.x / 32; ++warp)
                values[k] = combine(values[k], partial[warp][k]);
        }
        __syncthreads();
    }
    CODESIGN_INLINE void total(F* values, int count) {
        reduce(values, count, [](F a, F b) { return a + b; });
    }
    CODESIGN_INLINE F largest(F v) {
        reduce(&v, 1, [](F a, F b) { return max(a, b); });
        return v;
    }
#else
    CODESIGN_INLINE int first() { return 0; }
    CODESIGN_INLINE int stride() { return 1; }
    CODESIGN_INLINE void barrier() {}
    CODESIGN_INLINE bool somewhere(bool mask) { return mask; }
    CODESIGN_INLINE void total(F*, int) {}
    CODESIGN_INLINE F largest(F v) { return v; }
#endif

    CODESIGN_INLINE int count(int items) { return items * TEAM_LANES; }
    template <class T> CODESIGN_INLINE T* constants(T* base, int t, int components) {
        return base + (size_t)(t / TEAM_LANES) * components * TEAM_LANES + t % TEAM_LANES;
    }
    CODESIGN_INLINE float* state(float* base, int t, int components) {
        return constants(base, t, components);
    }
    // Where item t leaves the forces on its corners.
    CODESIGN_INLINE float* corners(float* base, int t, int count) {
        return constants(base, t, 3 * count);
    }

    CODESIGN_INLINE F load(const float* p) { return *p; }
    CODESIGN_INLINE void store(float* p, F v) { *p = v; }
    CODESIGN_INLINE F broadcast(float value) { return value; }
    CODESIGN_INLINE F item(const float* p) { return *p; }
    CODESIGN_INLINE F environment(const float* p) { return *p; }
    CODESIGN_INLINE I environment(const int* p) { return *p; }
    CODESIGN_INLINE void store_environment(float* p, F v) {
        if (first() == 0)
            *p = v;
    }
    CODESIGN_INLINE I whole(F v) { return (int)v; }
    CODESIGN_INLINE F real(I v) { return (float)v; }
    CODESIGN_INLINE void gather(const float* p, I index, F out[4]) {
        for (int k = 0; k < 4; ++k)
            out[k] = p[index + k];
    }
};

template <> struct Nodes<TEAM> {
    CODESIGN_INLINE Vec3<float> load(const float* state, const int* node) {
        const float* p = state + (size_t)*node * ROW;
        return { p[0], p[1], p[2] };
    }
    CODESIGN_INLINE void store(float* state, const int* node, Vec3<float> f) {
        float* p = state + (size_t)*node * ROW;
        p[0] = f.x, p[1] = f.y, p[2] = f.z;
    }
    CODESIGN_INLINE void give(const Forces&, float* corner, const int*, Vec3<float> f) {
        corner[0] = f.x, corner[TEAM_LANES] = f.y, corner[2 * TEAM_LANES] = f.z;
    }
    CODESIGN_INLINE void withdraw(float* corner) {
        corner[0] = corner[TEAM_LANES] = corner[2 * TEAM_LANES] = 0.0f;
    }
    template <class Scene>
    CODESIGN_INLINE Vec3<float> collect(const Scene& scene, const Forces& forces, const int* node) {
        Vec3<float> sum = { 0.0f, 0.0f, 0.0f };
        const int* start = scene.corner_starts.data + *node;
        for (int k = start[0]; k < start[1]; ++k) {
            const float* corner = forces.tets + scene.corners.data[k];
            sum = sum + Vec3<float> { corner[0], corner[TEAM_LANES], corner[2 * TEAM_LANES] };
        }
        return sum;
    }
};

}  // namespace codesign
