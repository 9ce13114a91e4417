// 3-vectors, and arithmetic on one number as on a vector of lanes.
#pragma once

namespace codesign {

#ifdef __CUDACC__
#define CODESIGN_INLINE __device__ static __forceinline__
#define CODESIGN_RARE __device__ static __noinline__
#else
#define CODESIGN_INLINE static inline __attribute__((always_inline))
#define CODESIGN_RARE static __attribute__((noinline, cold))
#endif

template <class V> CODESIGN_INLINE V max(V a, V b) { return a > b ? a : b; }
template <class V> CODESIGN_INLINE V min(V a, V b) { return a < b ? a : b; }

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
template <class F> CODESIGN_INLINE Vec3<F> operator-(Vec3<F> a) { return { -a.x, -a.y, -a.z }; }
template <class F> CODESIGN_INLINE Vec3<F> operator*(F s, Vec3<F> a) {
    return { s * a.x, s * a.y, s * a.z };
}
template <class F> CODESIGN_INLINE F dot(Vec3<F> a, Vec3<F> b) {
    return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class F> CODESIGN_INLINE Vec3<F> cross(Vec3<F> a, Vec3<F> b) {
    return { a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x };
}

}  // namespace codesign
