// Co-rotated linear elasticity of one tetrahedron per lane (paper section III-C).
#pragma once
#include "lanes.h"

namespace codesign {

// Row-major 3x3 matrix per lane.
template <class F> struct Mat3 {
    F a[9];
};

template <class F> CODESIGN_INLINE Vec3<F> row(const Mat3<F>& m, int i) {
    return { m.a[3 * i], m.a[3 * i + 1], m.a[3 * i + 2] };
}
template <class F> CODESIGN_INLINE Vec3<F> column(const Mat3<F>& m, int j) {
    return { m.a[j], m.a[3 + j], m.a[6 + j] };
}
template <class F> CODESIGN_INLINE Mat3<F> from_rows(Vec3<F> p, Vec3<F> q, Vec3<F> r) {
    return { { p.x, p.y, p.z, q.x, q.y, q.z, r.x, r.y, r.z } };
}

constexpr float NEARLY_FLAT = 0.02f;  // below this volume ratio Newton's iteration is not safe
// Squared last step of Newton's iteration. The error left, half of it, is a symmetric stretch by
// 5e-6: 0.03 Pa at E = 9 kPa, and no torque.
constexpr float ROTATION_STEP2 = 1e-5f;
constexpr int NEWTON_STEPS = 8;
constexpr int FLAT_STEPS = 24;

// The rotation nearest to a flat or inverted F: Mueller et al. 2016, "A robust method to extract
// the rotational part of deformations". Never a reflection, so an inverted element is pushed
// back to its own side.
template <class F> CODESIGN_INLINE Mat3<F> robust_rotation(const Mat3<F>& A) {
    const F zero = A.a[0] * 0.0f, one = zero + 1.0f;
    F w = one, x = zero, y = zero, z = zero;
    Mat3<F> R;
    for (int step = 0;; ++step) {
        R = { { one - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z), 2.0f * (x * z + w * y),
            2.0f * (x * y + w * z), one - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x),
            2.0f * (x * z - w * y), 2.0f * (y * z + w * x), one - 2.0f * (x * x + y * y) } };
        if (step == FLAT_STEPS)
            return R;
        Vec3<F> turn = { zero, zero, zero };
        F along = zero;
        for (int j = 0; j < 3; ++j) {
            turn = turn + cross(column(R, j), column(A, j));
            along = along + dot(column(R, j), column(A, j));
        }
        // A half turn away from the answer both vanish; the small offset keeps it finite.
        const F scale = 1.0f / (max(along, -along) + 1e-4f);
        const F hx = 0.5f * scale * turn.x, hy = 0.5f * scale * turn.y, hz = 0.5f * scale * turn.z;
        const F nw = w - hx * x - hy * y - hz * z, nx = x + hx * w + hy * z - hz * y;
        const F ny = y + hy * w + hz * x - hx * z, nz = z + hz * w + hx * y - hy * x;
        const F unit = 1.0f / root(nw * nw + nx * nx + ny * ny + nz * nz);
        w = nw * unit, x = nx * unit, y = ny * unit, z = nz * unit;
    }
}

// Rotation of the polar decomposition F = R S: Newton's iteration R <- (R + R^-T) / 2, which
// converges quadratically and needs no memory of the last step (a single warm-started step
// would lose angular momentum).
template <class F> CODESIGN_INLINE Mat3<F> rotation(const Mat3<F>& A) {
    Mat3<F> R = A;
    F det = A.a[0] * 0.0f;
    const F safe_volume = det + NEARLY_FLAT;
    F going = safe_volume;  // positive in lanes that need another step, whatever others need
    for (int step = 0; step < NEWTON_STEPS; ++step) {
        const Vec3<F> p = row(R, 0), q = row(R, 1), r = row(R, 2);
        const Mat3<F> cofactor = from_rows(cross(q, r), cross(r, p), cross(p, q));
        const F volume = dot(p, row(cofactor, 0));
        if (step == 0)
            det = volume;
        const F half = 0.5f / max(volume, safe_volume);
        F step2 = det * 0.0f;
        for (int k = 0; k < 9; ++k) {
            const F next = 0.5f * R.a[k] + half * cofactor.a[k];
            const F move = next - R.a[k];
            step2 = step2 + move * move;
            R.a[k] = step < 2 ? next : (going > 0.0f ? next : R.a[k]);
        }
        if (step > 0) {
            going = min(going, step2 - ROTATION_STEP2);
            if (!any(going > 0.0f))
                break;
        }
    }
    const auto flat = det < NEARLY_FLAT;
    if (any(flat)) {
        const Mat3<F> robust = robust_rotation(A);
        for (int k = 0; k < 9; ++k)
            R.a[k] = flat ? robust.a[k] : R.a[k];
    }
    return R;
}

// Rest shape of a tetrahedron: [10][copies]: inverse rest edge matrix (row major), rest volume.
constexpr int SHAPE = 10;

// Deformation gradient F = [x1-x0, x2-x0, x3-x0] B.
template <class F> CODESIGN_INLINE Mat3<F> deformation(const Vec3<F> x[4], const F* B) {
    const Vec3<F> e1 = x[1] - x[0], e2 = x[2] - x[0], e3 = x[3] - x[0];
    Mat3<F> A;
    for (int j = 0; j < 3; ++j) {
        A.a[j] = e1.x * B[j] + e2.x * B[3 + j] + e3.x * B[6 + j];
        A.a[3 + j] = e1.y * B[j] + e2.y * B[3 + j] + e3.y * B[6 + j];
        A.a[6 + j] = e1.z * B[j] + e2.z * B[3 + j] + e3.z * B[6 + j];
    }
    return A;
}

// First Piola-Kirchhoff stress P = 2 mu (F - R) + lambda tr(R^T F - I) R.
template <class F>
CODESIGN_INLINE Mat3<F> piola(const Mat3<F>& A, const Mat3<F>& R, F mu, F lambda) {
    F trace = A.a[0] * 0.0f - 3.0f;
    for (int k = 0; k < 9; ++k)
        trace = trace + R.a[k] * A.a[k];
    const F pressure = lambda * trace;
    Mat3<F> P;
    for (int k = 0; k < 9; ++k)
        P.a[k] = 2.0f * mu * (A.a[k] - R.a[k]) + pressure * R.a[k];
    return P;
}

// One vector of tetrahedra at node positions x.
template <int L> struct Element {
    typedef Lanes<L> W;
    typedef typename W::F F;
    const int* node;  // four times W::copies
    F B[9], volume;
    Mat3<F> A;  // deformation gradient

    template <class Scene>
    CODESIGN_INLINE Element load(const Scene& scene, int t, const float* x) {
        constexpr int C = W::copies;
        const float* shape = scene.tet_shapes.data + (size_t)t * SHAPE * C;
        Element e;
        e.node = scene.tet_nodes.data + (size_t)t * 4 * C;
        Vec3<F> corner[4];
        for (int c = 0; c < 4; ++c)
            corner[c] = Nodes<L>::load(x, e.node + c * C);
        for (int k = 0; k < 9; ++k)
            e.B[k] = W::item(shape + k * C);
        e.volume = W::item(shape + 9 * C);
        e.A = deformation(corner, e.B);
        return e;
    }
};

template <int L, class Scene>
CODESIGN_INLINE void add_elastic_forces(
    const Scene& scene, int group, const float* x, float* force) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies;
    const float* material = scene.materials.data + (size_t)group * 4 * L;
    const F mu = W::environment(material), lambda = W::environment(material + L);
    for (int t = 0; t < scene.tet_items; ++t) {
        const Element<L> e = Element<L>::load(scene, t, x);
        const Mat3<F> P = piola(e.A, rotation(e.A), mu * e.volume, lambda * e.volume);
        Vec3<F> f[4];
        for (int c = 0; c < 3; ++c) {  // f_{1..3} = - V P B^T, by columns
            const Vec3<F> b = { e.B[3 * c], e.B[3 * c + 1], e.B[3 * c + 2] };
            f[c + 1] = { -dot(row(P, 0), b), -dot(row(P, 1), b), -dot(row(P, 2), b) };
        }
        f[0] = W::broadcast(-1.0f) * (f[1] + f[2] + f[3]);
        for (int c = 0; c < 4; ++c)
            Nodes<L>::add(force, e.node + c * C, f[c]);
    }
}

template <class F> CODESIGN_INLINE F von_mises(const Mat3<F>& s) {
    const F a = s.a[0] - s.a[4], b = s.a[4] - s.a[8], c = s.a[8] - s.a[0];
    const F xy = 0.5f * (s.a[1] + s.a[3]), yz = 0.5f * (s.a[5] + s.a[7]);
    const F zx = 0.5f * (s.a[2] + s.a[6]);
    return root(0.5f * (a * a + b * b + c * c) + 3.0f * (xy * xy + yz * yz + zx * zx));
}

// Von Mises stress per tetrahedron, both measures: [group][tet item][2][lane].
template <int L, class Scene> CODESIGN_INLINE void stress(const Scene& scene, int group) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    const float* material = scene.materials.data + (size_t)group * 4 * L;
    const F mu = W::environment(material), lambda = W::environment(material + L);
    const float* x = scene.positions.data + (size_t)group * scene.node_rows * ROW * L;
    float* out = scene.stresses.data + (size_t)group * scene.tet_items * 2 * W::width;
    for (int t = 0; t < scene.tet_items; ++t, out += 2 * W::width) {
        const Mat3<F> A = Element<L>::load(scene, t, x).A;
        const Mat3<F> R = rotation(A);
        const Mat3<F> P = piola(A, R, mu, lambda);
        const F volume = dot(row(A, 0), cross(row(A, 1), row(A, 2)));
        const F shrink = 1.0f / max(volume, W::broadcast(NEARLY_FLAT));
        Mat3<F> cauchy, corotated;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                cauchy.a[3 * i + j] = shrink * dot(row(P, i), row(A, j));  // P F^T / det F
                corotated.a[3 * i + j] = dot(column(R, i), column(P, j));  // R^T P
            }
        W::store(out, von_mises(cauchy));
        W::store(out + W::width, von_mises(corotated));
    }
}

}  // namespace codesign
