// Vectors of lanes: how the items of environments become the vectors that the physics computes with.
//
// The physics (elements.h, contact.h, fem.h) is written once against Lanes<L> and Nodes<L>, and all
// that differs between machines is here and in team.h. Memory is laid out as
// [group][item][component][lane] everywhere:
//   L > 1: a lane is an environment and a group is L environments. Constants of an item (a
//          tetrahedron's rest shape) are stored once and broadcast over the lanes.
//   L = 1: a group is one environment, and a vector takes ITEM_LANES neighbouring ITEMS
//          (tetrahedra, triangles, nodes) of it; constants of an item are stored per lane, values
//          of an environment (a material) are broadcast.
//   TEAM:  a group is one environment and a team of threads shares its items, see team.h.
#pragma once
#include "vec3.h"

namespace codesign {

template <int L> struct Lanes;
template <int L> struct Nodes;

}  // namespace codesign

#include "team.h"
#ifndef __CUDACC__

namespace codesign {

// Lanes of a vector when one environment fills it with its own items.
constexpr int ITEM_LANES = 8;

template <int W> struct Vector {
    typedef float F __attribute__((vector_size(4 * W)));
    typedef int I __attribute__((vector_size(4 * W)));
    // Warp's allocations are only sure to be aligned to a float.
    typedef float UnalignedF __attribute__((vector_size(4 * W), aligned(4)));
    typedef int UnalignedI __attribute__((vector_size(4 * W), aligned(4)));
};

typedef Vector<4>::F Float4;
typedef Vector<4>::UnalignedF UnalignedFloat4;
typedef Vector<8>::F Float8;

CODESIGN_INLINE Float8 pair(Float4 low, Float4 high) {
    return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
}

// Transposes eight rows of four.
CODESIGN_INLINE void columns(const Float4 rows[8], Float8 out[4]) {
    const Float8 a = pair(rows[0], rows[4]), b = pair(rows[1], rows[5]);
    const Float8 c = pair(rows[2], rows[6]), d = pair(rows[3], rows[7]);
    const Float8 ab = __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13);
    const Float8 cd = __builtin_shufflevector(c, d, 0, 8, 1, 9, 4, 12, 5, 13);
    const Float8 abh = __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
    const Float8 cdh = __builtin_shufflevector(c, d, 2, 10, 3, 11, 6, 14, 7, 15);
    out[0] = __builtin_shufflevector(ab, cd, 0, 1, 8, 9, 4, 5, 12, 13);
    out[1] = __builtin_shufflevector(ab, cd, 2, 3, 10, 11, 6, 7, 14, 15);
    out[2] = __builtin_shufflevector(abh, cdh, 0, 1, 8, 9, 4, 5, 12, 13);
    out[3] = __builtin_shufflevector(abh, cdh, 2, 3, 10, 11, 6, 7, 14, 15);
}

template <class V> CODESIGN_INLINE V root(V a) { return __builtin_elementwise_sqrt(a); }
template <class M> CODESIGN_INLINE bool any(M mask) { return __builtin_reduce_or(mask) != 0; }
template <class M> CODESIGN_INLINE bool every(M mask) { return __builtin_reduce_and(mask) != 0; }

template <int L> struct Lanes {
    static constexpr int width = L == 1 ? ITEM_LANES : L;  // floats in a vector
    static constexpr int copies = L == 1 ? ITEM_LANES : 1;  // stored lanes of per-item constants
    static constexpr int batch = 4;  // tetrahedra whose arithmetic overlaps
    static constexpr int environments = L;  // stored lanes of per-environment values
    typedef typename Vector<width>::F F;
    typedef typename Vector<width>::I I;
    typedef typename Vector<width>::UnalignedF UnalignedF;
    typedef typename Vector<width>::UnalignedI UnalignedI;

    // Items that one thread visits: all, one after the other.
    CODESIGN_INLINE int first() { return 0; }
    CODESIGN_INLINE int stride() { return 1; }
    CODESIGN_INLINE int count(int items) { return items; }
    CODESIGN_INLINE void barrier() {}

    // Where item t begins, in constants and in state of `components` values per item.
    template <class T> CODESIGN_INLINE T* constants(T* base, int t, int components) {
        return base + (size_t)t * components * copies;
    }
    CODESIGN_INLINE float* state(float* base, int t, int components) {
        return base + (size_t)t * components * width;
    }

    CODESIGN_INLINE float* corners(float*, int, int) { return nullptr; }

    CODESIGN_INLINE F load(const float* p) { return *(const UnalignedF*)p; }
    CODESIGN_INLINE void store(float* p, F v) { *(UnalignedF*)p = v; }
    CODESIGN_INLINE F broadcast(float value) { return value - F {}; }
    CODESIGN_INLINE I broadcast(int value) { return value - I {}; }

    // A constant of an item (area, rest shape): the same for every environment.
    CODESIGN_INLINE F item(const float* p) {
        if constexpr (L == 1)
            return load(p);
        else
            return broadcast(p[0]);
    }

    // A value of an environment (modulus, finger pose): the same for every item.
    CODESIGN_INLINE F environment(const float* p) {
        if constexpr (L == 1)
            return broadcast(p[0]);
        else
            return load(p);
    }
    CODESIGN_INLINE I environment(const int* p) {
        if constexpr (L == 1)
            return broadcast(p[0]);
        else
            return *(const UnalignedI*)p;
    }

    // Sums over the items, per environment, in every lane of that environment.
    CODESIGN_INLINE void total(F* values, int count) {
        if constexpr (L == 1)
            for (int k = 0; k < count; ++k) {
                float sum = 0.0f;
                for (int lane = 0; lane < width; ++lane)
                    sum += values[k][lane];
                values[k] = broadcast(sum);
            }
    }
    // Whether it holds for any thread.
    CODESIGN_INLINE bool somewhere(bool anything) { return anything; }
    CODESIGN_INLINE F largest(F v) {
        if constexpr (L == 1) {
            float top = v[0];
            for (int lane = 1; lane < width; ++lane)
                top = v[lane] > top ? v[lane] : top;
            return broadcast(top);
        } else
            return v;
    }
    // Writes a value of an environment back.
    CODESIGN_INLINE void store_environment(float* p, F v) {
        if constexpr (L == 1)
            p[0] = v[0];
        else
            store(p, v);
    }

    CODESIGN_INLINE I whole(F v) { return __builtin_convertvector(v, I); }
    CODESIGN_INLINE F real(I v) { return __builtin_convertvector(v, F); }
    // Four numbers of each lane, side by side in memory from p[index] on.
    CODESIGN_INLINE void gather(const float* p, I index, F out[4]) {
        Float8 part[width / 8][4];
        for (int k = 0; k < width; k += 8) {
            Float4 rows[8];
            for (int lane = 0; lane < 8; ++lane)
                rows[lane] = *(const UnalignedFloat4*)(p + (unsigned)index[k + lane]);
            columns(rows, part[k / 8]);
        }
        for (int k = 0; k < 4; ++k)
            if constexpr (width == 8)
                out[k] = part[0][k];
            else
                out[k] = __builtin_shufflevector(part[0][k], part[1][k], 0, 1, 2, 3, 4, 5, 6, 7, 8,
                    9, 10, 11, 12, 13, 14, 15);
    }
};

// With L = 1 one load brings one node's row, and eight of them transpose into lanes.
template <int L> struct Nodes {
    typedef Lanes<L> W;
    typedef typename W::F F;

    CODESIGN_INLINE Vec3<F> load(const float* state, const int* node) {
        if constexpr (L == 1) {
            Float4 rows[8];
            for (int lane = 0; lane < 8; ++lane)
                rows[lane] = ((const UnalignedFloat4*)state)[node[lane]];
            F xyz[4];
            columns(rows, xyz);
            return { xyz[0], xyz[1], xyz[2] };
        } else {
            const float* p = state + (size_t)node[0] * ROW * L;
            return { W::load(p), W::load(p + L), W::load(p + 2 * L) };
        }
    }

    // Hands a force per lane to its node, by adding it at once. Lanes follow one another, so nodes may repeat and the
    // order of summation, hence the last bit, is always the same.
    CODESIGN_INLINE void give(const Forces& forces, float*, const int* node, Vec3<F> f) {
        float* state = forces.nodes;
        if constexpr (L == 1) {
            Float4 rows[8];
            transpose(f, rows);
            for (int lane = 0; lane < 8; ++lane) {
                UnalignedFloat4* row = (UnalignedFloat4*)state + node[lane];
                *row = *row + rows[lane];
            }
        } else {
            float* p = state + (size_t)node[0] * ROW * L;
            W::store(p, W::load(p) + f.x);
            W::store(p + L, W::load(p + L) + f.y);
            W::store(p + 2 * L, W::load(p + 2 * L) + f.z);
        }
    }

    // Takes back what was left at a corner: here, nothing was.
    CODESIGN_INLINE void withdraw(float*) {}

    // The force that a node was given. It starts anew from zero.
    template <class Scene>
    CODESIGN_INLINE Vec3<F> collect(const Scene&, const Forces& forces, const int* node) {
        const Vec3<F> sum = load(forces.nodes, node);
        const F zero = W::broadcast(0.0f);
        store(forces.nodes, node, { zero, zero, zero });
        return sum;
    }

    CODESIGN_INLINE void store(float* state, const int* node, Vec3<F> f) {
        if constexpr (L == 1) {
            Float4 rows[8];
            transpose(f, rows);
            for (int lane = 0; lane < 8; ++lane)
                ((UnalignedFloat4*)state)[node[lane]] = rows[lane];
        } else {
            float* p = state + (size_t)node[0] * ROW * L;
            W::store(p, f.x);
            W::store(p + L, f.y);
            W::store(p + 2 * L, f.z);
        }
    }

private:
    CODESIGN_INLINE void transpose(Vec3<F> f, Float4 rows[8]) {
        const F zero = W::broadcast(0.0f);
        const F xy = __builtin_shufflevector(f.x, f.y, 0, 8, 1, 9, 4, 12, 5, 13);
        const F xyh = __builtin_shufflevector(f.x, f.y, 2, 10, 3, 11, 6, 14, 7, 15);
        const F z0 = __builtin_shufflevector(f.z, zero, 0, 8, 1, 9, 4, 12, 5, 13);
        const F z0h = __builtin_shufflevector(f.z, zero, 2, 10, 3, 11, 6, 14, 7, 15);
        const F r0 = __builtin_shufflevector(xy, z0, 0, 1, 8, 9, 4, 5, 12, 13);
        const F r1 = __builtin_shufflevector(xy, z0, 2, 3, 10, 11, 6, 7, 14, 15);
        const F r2 = __builtin_shufflevector(xyh, z0h, 0, 1, 8, 9, 4, 5, 12, 13);
        const F r3 = __builtin_shufflevector(xyh, z0h, 2, 3, 10, 11, 6, 7, 14, 15);
        const F all[4] = { r0, r1, r2, r3 };
        for (int k = 0; k < 4; ++k) {
            rows[k] = __builtin_shufflevector(all[k], all[k], 0, 1, 2, 3);
            rows[k + 4] = __builtin_shufflevector(all[k], all[k], 4, 5, 6, 7);
        }
    }
};

}  // namespace codesign

#endif
