// Vectors of lanes, and how state in memory becomes a vector.
//
// Memory layout everywhere: [group][item][component][lane], lane fastest.
//   L > 1: a lane is an environment, a group is L environments, and a per-item constant (a
//          tetrahedron's rest shape) is stored once and broadcast over the lanes.
//   L = 1: a group is one environment, and a vector takes `width` neighbouring ITEMS (tetrahedra,
//          triangles, nodes) of it; per-item constants are stored per lane, per-environment values
//          (a material) are broadcast.
// The physics in fem.h and contact.h is written once, against the few functions below.
#pragma once

namespace codesign {

#define CODESIGN_INLINE CUDA_CALLABLE static inline __attribute__((always_inline))

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

template <class V> CODESIGN_INLINE V max(V a, V b) { return a > b ? a : b; }
template <class V> CODESIGN_INLINE V min(V a, V b) { return a < b ? a : b; }
template <class V> CODESIGN_INLINE V root(V a) { return __builtin_elementwise_sqrt(a); }
template <class M> CODESIGN_INLINE bool any(M mask) { return __builtin_reduce_or(mask) != 0; }

template <int L> struct Lanes {
    static constexpr int width = L == 1 ? ITEM_LANES : L;  // floats in a vector
    static constexpr int copies = L == 1 ? ITEM_LANES : 1;  // stored lanes of per-item constants
    typedef typename Vector<width>::F F;
    typedef typename Vector<width>::I I;
    typedef typename Vector<width>::UnalignedF UnalignedF;
    typedef typename Vector<width>::UnalignedI UnalignedI;

    CODESIGN_INLINE F load(const float* p) { return *(const UnalignedF*)p; }
    CODESIGN_INLINE void store(float* p, F v) { *(UnalignedF*)p = v; }
    CODESIGN_INLINE F broadcast(float value) { return F {} + value; }
    CODESIGN_INLINE I broadcast(int value) { return I {} + value; }

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

    // A sum over items, per environment, in every lane of that environment.
    CODESIGN_INLINE F total(F v) {
        if constexpr (L == 1) {
            float sum = 0.0f;
            for (int lane = 0; lane < width; ++lane)
                sum += v[lane];
            return broadcast(sum);
        } else
            return v;
    }
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

    CODESIGN_INLINE F gather(const float* p, I index) {
        F v;
        for (int lane = 0; lane < width; ++lane)
            v[lane] = p[index[lane]];
        return v;
    }
};

// One 3-vector per lane.
template <class F> struct Vec3 {
    F x, y, z;
};
template <class F> CODESIGN_INLINE Vec3<F> operator+(Vec3<F> a, Vec3<F> b) {
    return { a.x + b.x, a.y + b.y, a.z + b.z };
}
template <class F> CODESIGN_INLINE Vec3<F> operator-(Vec3<F> a, Vec3<F> b) {
    return { a.x - b.x, a.y - b.y, a.z - b.z };
}
template <class F> CODESIGN_INLINE Vec3<F> operator*(F s, Vec3<F> a) {
    return { s * a.x, s * a.y, s * a.z };
}
template <class F> CODESIGN_INLINE F dot(Vec3<F> a, Vec3<F> b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class F> CODESIGN_INLINE Vec3<F> cross(Vec3<F> a, Vec3<F> b) {
    return { a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x };
}

// Node vectors are stored as [node][4][L]; the fourth component only pads to a 16-byte row, so
// that with L = 1 one load brings one node and eight of them transpose into lanes.
constexpr int ROW = 4;

template <int L> struct Nodes {
    typedef Lanes<L> W;
    typedef typename W::F F;

    CODESIGN_INLINE Vec3<F> load(const float* state, const int* node) {
        if constexpr (L == 1) {
            const UnalignedFloat4* rows = (const UnalignedFloat4*)state;
            const F a = pair(rows[node[0]], rows[node[4]]), b = pair(rows[node[1]], rows[node[5]]);
            const F c = pair(rows[node[2]], rows[node[6]]), d = pair(rows[node[3]], rows[node[7]]);
            const F ab = __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13);
            const F cd = __builtin_shufflevector(c, d, 0, 8, 1, 9, 4, 12, 5, 13);
            const F abz = __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
            const F cdz = __builtin_shufflevector(c, d, 2, 10, 3, 11, 6, 14, 7, 15);
            return { __builtin_shufflevector(ab, cd, 0, 1, 8, 9, 4, 5, 12, 13),
                __builtin_shufflevector(ab, cd, 2, 3, 10, 11, 6, 7, 14, 15),
                __builtin_shufflevector(abz, cdz, 0, 1, 8, 9, 4, 5, 12, 13) };
        } else {
            const float* p = state + (size_t)node[0] * ROW * L;
            return { W::load(p), W::load(p + L), W::load(p + 2 * L) };
        }
    }

    // Adds a force per lane to its node. Lanes follow one another, so nodes may repeat and the
    // order of summation, hence the last bit, is always the same.
    CODESIGN_INLINE void add(float* state, const int* node, Vec3<F> f) {
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
    CODESIGN_INLINE F pair(Float4 low, Float4 high) {
        return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
    }
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
