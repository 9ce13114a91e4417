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

constexpr float NEARLY_FLAT = 0.02f;  // volume ratio that the true stress divides by at least
// The rotation below is safe while (s1 + s2)(s2 + s3)(s3 + s1) / (s1 + s2 + s3)^3, 0.3 at rest, is
// above this, s being the principal stretches and the smallest one negative if mirrored.
constexpr float NEARLY_DOUBLE = 0.005f;
// Newton's step on the sum of the stretches, relative to it, that is taken for the last: it leaves
// an error of its square.
constexpr float LAST_STEP = 2e-4f;
constexpr int MORE_STEPS = 40;  // a stretch of 1,000 takes 25
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

// The polar decomposition F = R S by invariants of the stretch S: its trace i, second invariant
// ii and determinant J solve i^2 = |F|^2 + 2 ii and ii^2 = |cof F|^2 + 2 J i, and the derivative of
// the trace by F is R = (F ((ii + |F|^2) I - F^T F) + i cof F) / (i ii - J).
// Whatever error i has, R F^T is symmetric, so that no torque is left. Mirrored elements (J < 0)
// get the nearest rotation, too. No memory of the last step is needed.
template <class F> struct Polar {
    Mat3<F> cofactor;
    F determinant, squares, minors;  // J, |F|^2, |cof F|^2
    F trace, second, divisor;  // i, ii, i ii - J

    CODESIGN_INLINE Polar of(const Mat3<F>& A) {
        const Vec3<F> p = row(A, 0), q = row(A, 1), r = row(A, 2);
        const Vec3<F> qr = cross(q, r), rp = cross(r, p), pq = cross(p, q);
        Polar s;
        s.cofactor = from_rows(qr, rp, pq);
        s.determinant = dot(p, qr);
        s.squares = dot(p, p) + dot(q, q) + dot(r, r);
        s.minors = dot(qr, qr) + dot(rp, rp) + dot(pq, pq);
        return s;
    }

    // Solves for the trace of `count` elements together, whose chains of divisions overlap. From
    // above the largest root, (3 + |F|^2) / 2 >= sqrt(3) |F| >= i, Newton's iteration does not
    // overshoot it. Two steps do for strains of 10 %; a lane that is done then stays as it is, so
    // that it does not depend on its neighbours.
    template <int COUNT> CODESIGN_INLINE void solve(Polar s[COUNT]) {
        F down[COUNT];
        for (int k = 0; k < COUNT; ++k)
            s[k].trace = 0.5f * s[k].squares + 1.5f;
        for (int k = 0; k < COUNT; ++k)
            s[k].trace = s[k].trace - excess(s[k]);
        for (int k = 0; k < COUNT; ++k) {
            down[k] = excess(s[k]);
            s[k].trace = s[k].trace - down[k];
        }
        for (int k = 0; k < COUNT; ++k) {
            auto going = down[k] > LAST_STEP * s[k].trace;
            for (int step = 0; step < MORE_STEPS && any(going); ++step) {
                const F more = excess(s[k]);
                s[k].trace = s[k].trace - (going ? more : more * 0.0f);
                going = going & (more > LAST_STEP * s[k].trace);
            }
            complete(s[k]);
        }
    }

    // How far Newton's step goes down from the trace.
    CODESIGN_INLINE F excess(Polar& s) {
        complete(s);
        const F excess = s.second * s.second - s.minors - 2.0f * s.determinant * s.trace;
        return 0.5f * excess / max(s.divisor, 1e-6f * s.squares * s.trace);
    }

    // What follows from the trace.
    CODESIGN_INLINE void complete(Polar& s) {
        s.second = 0.5f * (s.trace * s.trace - s.squares);
        s.divisor = s.trace * s.second - s.determinant;
    }

    // scale F + turn R.
    CODESIGN_INLINE Mat3<F> combine(const Polar& s, const Mat3<F>& A, F scale, F turn) {
        const Vec3<F> x = column(A, 0), y = column(A, 1), z = column(A, 2);
        const F share = turn / s.divisor;
        const F whole = scale + share * (s.second + s.squares), cofactor = share * s.trace;
        const F xx = whole - share * dot(x, x), xy = -share * dot(x, y);
        const F yy = whole - share * dot(y, y), yz = -share * dot(y, z);
        const F zz = whole - share * dot(z, z), zx = -share * dot(z, x);
        Mat3<F> M;
        for (int i = 0; i < 9; i += 3) {
            const F a = A.a[i], b = A.a[i + 1], c = A.a[i + 2];
            M.a[i] = a * xx + b * xy + c * zx + cofactor * s.cofactor.a[i];
            M.a[i + 1] = a * xy + b * yy + c * yz + cofactor * s.cofactor.a[i + 1];
            M.a[i + 2] = a * zx + b * yz + c * zz + cofactor * s.cofactor.a[i + 2];
        }
        return M;
    }
};

// First Piola-Kirchhoff stress P = 2 mu (F - R) + lambda tr(R^T F - I) R, and the rotation R.
template <class F> struct Elastic {
    Mat3<F> piola, rotation;

    template <bool WITH_ROTATION>
    CODESIGN_INLINE Elastic of(const Mat3<F>& A, const Polar<F>& s, F mu, F lambda) {
        const F zero = mu * 0.0f;
        Elastic e;
        const F turn = lambda * (s.trace - 3.0f) - 2.0f * mu;
        e.piola = Polar<F>::combine(s, A, 2.0f * mu, turn);
        if (WITH_ROTATION)
            e.rotation = Polar<F>::combine(s, A, zero, zero + 1.0f);
        const auto unsafe = s.divisor < NEARLY_DOUBLE * s.trace * s.squares;
        if (any(unsafe)) {
            const Mat3<F> R = robust_rotation(A);
            F trace = zero - 3.0f;
            for (int k = 0; k < 9; ++k)
                trace = trace + R.a[k] * A.a[k];
            for (int k = 0; k < 9; ++k) {
                const F safe = 2.0f * mu * (A.a[k] - R.a[k]) + lambda * trace * R.a[k];
                e.piola.a[k] = unsafe ? safe : e.piola.a[k];
                if (WITH_ROTATION)
                    e.rotation.a[k] = unsafe ? R.a[k] : e.rotation.a[k];
            }
        }
        return e;
    }
};

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
        const float* shape = W::constants(scene.tet_shapes.data, t, SHAPE);
        Element e;
        e.node = W::constants(scene.tet_nodes.data, t, 4);
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

// Gives every tetrahedron's forces to its corners.
template <int L, class Scene>
CODESIGN_INLINE void give_elastic_forces(
    const Scene& scene, int group, const float* x, const Forces& forces) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies, E = W::environments;
    const float* material = scene.materials.data + (size_t)group * 4 * E;
    const F mu = W::environment(material), lambda = W::environment(material + E);
    constexpr int B = W::batch;
    const int count = W::count(scene.tet_items);
    for (int first = W::first(); first < count; first += B * W::stride()) {
        Element<L> elements[B];
        Polar<F> polars[B];
        for (int k = 0; k < B; ++k) {
            const int t = min(first + k * W::stride(), count - 1);
            elements[k] = Element<L>::load(scene, t, x);
            polars[k] = Polar<F>::of(elements[k].A);
        }
        Polar<F>::template solve<B>(polars);
        for (int k = 0; k < B; ++k) {
            const int t = first + k * W::stride();
            if (t >= count)
                break;
            const Element<L>& e = elements[k];
            const Mat3<F> P = Elastic<F>::template of<false>(
                e.A, polars[k], mu * e.volume, lambda * e.volume).piola;
            Vec3<F> f[4];
            for (int c = 0; c < 3; ++c) {  // f_{1..3} = - V P B^T, by columns
                const Vec3<F> b = { e.B[3 * c], e.B[3 * c + 1], e.B[3 * c + 2] };
                f[c + 1] = { -dot(row(P, 0), b), -dot(row(P, 1), b), -dot(row(P, 2), b) };
            }
            f[0] = W::broadcast(-1.0f) * (f[1] + f[2] + f[3]);
            float* corners = W::corners(forces.tets, t, 4);
            for (int c = 0; c < 4; ++c)
                Nodes<L>::give(forces, corners + c * 3 * C, e.node + c * C, f[c]);
        }
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
    constexpr int E = W::environments;
    const float* material = scene.materials.data + (size_t)group * 4 * E;
    const F mu = W::environment(material), lambda = W::environment(material + E);
    const float* x = scene.positions.data + (size_t)group * scene.node_rows * ROW * E;
    float* all = scene.stresses.data + (size_t)group * scene.tet_items * 2 * W::width;
    for (int t = W::first(); t < W::count(scene.tet_items); t += W::stride()) {
        const Mat3<F> A = Element<L>::load(scene, t, x).A;
        Polar<F> polar = Polar<F>::of(A);
        Polar<F>::template solve<1>(&polar);
        const auto elastic = Elastic<F>::template of<true>(A, polar, mu, lambda);
        const Mat3<F>&P = elastic.piola, &R = elastic.rotation;
        const F volume = dot(row(A, 0), cross(row(A, 1), row(A, 2)));
        const F shrink = 1.0f / max(volume, W::broadcast(NEARLY_FLAT));
        Mat3<F> cauchy, corotated;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
                cauchy.a[3 * i + j] = shrink * dot(row(P, i), row(A, j));  // P F^T / det F
                corotated.a[3 * i + j] = dot(column(R, i), column(P, j));  // R^T P
            }
        float* out = W::state(all, t, 2);
        W::store(out, von_mises(cauchy));
        W::store(out + W::width, von_mises(corotated));
    }
}

}  // namespace codesign
