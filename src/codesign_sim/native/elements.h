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
// Half the change of the slope over Newton's step on the sum of the stretches, relative to the
// slope. A step of third order then leaves an error of about 1e-7.
constexpr float SMALL_BEND = 5e-3f;
// Newton's step, relative to that sum, that is taken for the last. It leaves an error of its square.
constexpr float LAST_STEP = 2e-4f;
constexpr int MOST_STEPS = 42;  // a stretch of 1,000 takes 27
constexpr int FLAT_STEPS = 24;

// The rotation nearest to a flat or inverted F: Mueller et al. 2016, "A robust method to extract
// the rotational part of deformations". Never a reflection, so an inverted element is pushed
// back to its own side.
template <class F> CODESIGN_INLINE Mat3<F> robust_rotation(const Mat3<F>& A) {
    const F zero = F {}, one = zero + 1.0f;
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

// scale F + turn R, written F (whole I + share F^T F) + cofactor cof F.
template <class F> struct Blend {
    F whole, share, cofactor;
};

// The polar decomposition F = R S by invariants of the stretch S: its trace i, second invariant
// ii and determinant J solve i^2 = |F|^2 + 2 ii and ii^2 = |cof F|^2 + 2 J i, and the derivative of
// the trace by F is R = (F ((ii + |F|^2) I - F^T F) + i cof F) / (i ii - J).
// Whatever error i has, R F^T is symmetric, so that no torque is left. Mirrored elements (J < 0)
// get the nearest rotation, too. No memory of the last step is needed.
template <class F> struct Polar {
    F xx, yy, zz, xy, yz, zx;  // F^T F
    F determinant, squares, minors;  // J, |F|^2, |cof F|^2

    CODESIGN_INLINE Polar of(const Mat3<F>& A) {
        const Vec3<F> x = column(A, 0), y = column(A, 1), z = column(A, 2);
        Polar s;
        s.determinant = dot(row(A, 0), cross(row(A, 1), row(A, 2)));
        s.xx = dot(x, x), s.yy = dot(y, y), s.zz = dot(z, z);
        s.xy = dot(x, y), s.yz = dot(y, z), s.zx = dot(z, x);
        s.squares = s.xx + s.yy + s.zz;
        s.minors = (s.xx * s.yy - s.xy * s.xy) + (s.yy * s.zz - s.yz * s.yz)
            + (s.zz * s.xx - s.zx * s.zx);
        return s;
    }

    // scale F + (slope (i - 3) + turn) R. Where F has no rotation that is safe to compute so, A
    // becomes the answer and the blend leaves it as it is.
    //
    // One step of third order from 1 + sqrt(2 J + |F|^2 - 1), which is right to second order in the
    // strain, does for strains of 30 %. It is accepted where Newton's step from there passes
    // Kantorovich's criterion by far, and on the largest root, where ii and the derivative are
    // positive.
    //
    // The chains of divisions of `COUNT` elements overlap, step by step.
    template <int COUNT>
    CODESIGN_INLINE void blend(const Polar s[COUNT], Mat3<F> A[COUNT], const F scale[COUNT],
        const F slope[COUNT], const F turn[COUNT], Blend<F> out[COUNT]) {
        F guess[COUNT], rise[COUNT], per_slope[COUNT], trace[COUNT], second[COUNT], divisor[COUNT];
        decltype(guess[0] < guess[0]) done[COUNT];
        for (int k = 0; k < COUNT; ++k)
            guess[k] = root(max(2.0f * s[k].determinant + (s[k].squares - 1.0f), F {})) + 1.0f;
        for (int k = 0; k < COUNT; ++k)
            rise[k] = guess[k] * guess[k] - s[k].squares;
        for (int k = 0; k < COUNT; ++k)
            per_slope[k] = 1.0f / (rise[k] * guess[k] - 2.0f * s[k].determinant);
        for (int k = 0; k < COUNT; ++k) {
            const F value = 0.25f * rise[k] * rise[k] - s[k].minors
                - 2.0f * s[k].determinant * guess[k];
            const F newton = value * per_slope[k];
            const F bend = (1.5f * rise[k] + s[k].squares) * per_slope[k] * newton;
            trace[k] = guess[k] - (newton + newton * bend);
            done[k] = max(bend, -bend) < SMALL_BEND;
        }
        for (int k = 0; k < COUNT; ++k) {
            second[k] = second_of(s[k], trace[k]);
            divisor[k] = trace[k] * second[k] - s[k].determinant;
            done[k] = done[k] & (min(second[k], trace[k]) > F {})
                & (divisor[k] > NEARLY_DOUBLE * trace[k] * s[k].squares);
        }
        for (int k = 0; k < COUNT; ++k)
            out[k] = mix(s[k], trace[k], second[k], divisor[k], scale[k],
                slope[k] * (trace[k] - 3.0f) + turn[k]);
        auto all = done[0];
        for (int k = 1; k < COUNT; ++k)
            all = all & done[k];
        if (!every(all))
            for (int k = 0; k < COUNT; ++k)
                out[k] = blend_slowly(s[k], A[k], scale[k], slope[k], turn[k], out[k], done[k]);
    }

    // How to combine F^T F and cof F once the trace is known.
    CODESIGN_INLINE Mat3<F> apply(const Polar& s, const Mat3<F>& A, const Blend<F>& b) {
        const F xx = b.whole + b.share * s.xx, xy = b.share * s.xy;
        const F yy = b.whole + b.share * s.yy, yz = b.share * s.yz;
        const F zz = b.whole + b.share * s.zz, zx = b.share * s.zx;
        Mat3<F> M;
        for (int i = 0; i < 3; ++i) {
            const Vec3<F> a = row(A, i), normal = cross(row(A, (i + 1) % 3), row(A, (i + 2) % 3));
            M.a[3 * i] = a.x * xx + a.y * xy + a.z * zx + b.cofactor * normal.x;
            M.a[3 * i + 1] = a.x * xy + a.y * yy + a.z * yz + b.cofactor * normal.y;
            M.a[3 * i + 2] = a.x * zx + a.y * yz + a.z * zz + b.cofactor * normal.z;
        }
        return M;
    }

private:
    CODESIGN_INLINE F second_of(const Polar& s, F trace) {
        return 0.5f * (trace * trace - s.squares);
    }
    CODESIGN_INLINE Blend<F> mix(
        const Polar& s, F trace, F second, F divisor, F scale, F turn) {
        const F share = -turn / divisor;
        return { scale - share * (second + s.squares), share, -share * trace };
    }

    // The same for lanes that are not `done`: Newton's iteration from above the largest root,
    // (3 + |F|^2) / 2 >= sqrt(3) |F| >= i, which does not overshoot it, or the robust rotation. Done
    // lanes stay as they are, so that they do not depend on their neighbours.
    template <class M>
    CODESIGN_RARE Blend<F> blend_slowly(const Polar& s, Mat3<F>& A, F scale, F slope, F turn,
        const Blend<F>& usual, M done) {
        F trace = 0.5f * s.squares + 1.5f, second = second_of(s, trace);
        F divisor = trace * second - s.determinant;
        auto going = !done;
        for (int step = 0; step < MOST_STEPS && any(going); ++step) {
            const F excess = second * second - s.minors - 2.0f * s.determinant * trace;
            const F down = 0.5f * excess / max(divisor, 1e-6f * s.squares * trace);
            trace = going ? trace - down : trace;
            going = going & (down > LAST_STEP * trace);
            second = second_of(s, trace);
            divisor = trace * second - s.determinant;
        }
        const Blend<F> slow = mix(s, trace, second, divisor, scale, slope * (trace - 3.0f) + turn);
        const auto safe = done | (divisor >= NEARLY_DOUBLE * trace * s.squares);
        if (!every(safe)) {
            const Mat3<F> R = robust_rotation(A);
            F excess = F {} - 3.0f;
            for (int k = 0; k < 9; ++k)
                excess = excess + R.a[k] * A.a[k];
            for (int k = 0; k < 9; ++k)
                A.a[k] = safe ? A.a[k] : scale * A.a[k] + (slope * excess + turn) * R.a[k];
        }
        const F zero = F {}, one = zero + 1.0f;
        return { done ? usual.whole : safe ? slow.whole : one,
            done ? usual.share : safe ? slow.share : zero,
            done ? usual.cofactor : safe ? slow.cofactor : zero };
    }
};

// Rest shape of a tetrahedron: [7][copies]: B00, B01, B02, B11, B12, B22 of the inverse B of the rest
// edges [X0-X1, X0-X2, X0-X3], and the rest volume. The rest frame of every tetrahedron is turned so
// that B is upper triangular, which neither forces nor von Mises stresses notice.
constexpr int SHAPE = 7;

// Deformation gradient F = [x0-x1, x0-x2, x0-x3] B.
template <class F> CODESIGN_INLINE Mat3<F> deformation(const Vec3<F> x[4], const F* B) {
    const Vec3<F> e1 = x[0] - x[1], e2 = x[0] - x[2], e3 = x[0] - x[3];
    const Vec3<F> p = B[0] * e1, q = B[1] * e1 + B[3] * e2, r = B[2] * e1 + B[4] * e2 + B[5] * e3;
    return { { p.x, q.x, r.x, p.y, q.y, r.y, p.z, q.z, r.z } };
}

// One vector of tetrahedra at node positions x.
template <int L> struct Element {
    typedef Lanes<L> W;
    typedef typename W::F F;
    const int* node;  // four times W::copies
    const float* shape;

    template <class Scene>
    CODESIGN_INLINE Element load(const Scene& scene, int t, const float* x, Mat3<F>& A) {
        constexpr int C = W::copies;
        Element e;
        e.shape = W::constants(scene.tet_shapes.data, t, SHAPE);
        e.node = W::constants(scene.tet_nodes.data, t, 4);
        Vec3<F> corner[4];
        for (int c = 0; c < 4; ++c)
            corner[c] = Nodes<L>::load(x, e.node + c * C);
        F B[6];
        inverse(e, B);
        A = deformation(corner, B);
        return e;
    }
    CODESIGN_INLINE void inverse(const Element& e, F B[6]) {
        for (int k = 0; k < 6; ++k)
            B[k] = W::item(e.shape + k * W::copies);
    }
    CODESIGN_INLINE F volume(const Element& e) { return W::item(e.shape + 6 * W::copies); }
};

// Gives every tetrahedron's forces to its corners, from the first Piola-Kirchhoff stress
// P = 2 mu (F - R) + lambda (tr S - 3) R.
template <int L, class Scene>
CODESIGN_INLINE void give_elastic_forces(
    const Scene& scene, int group, const float* x, const Forces& forces) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies, E = W::environments;
    const float* material = scene.materials.data + (size_t)group * 4 * E;
    const F mu = W::environment(material), lambda = W::environment(material + E);
    constexpr int BATCH = W::batch;
    const int count = W::count(scene.tet_items);
    for (int first = W::first(); first < count; first += BATCH * W::stride()) {
        Element<L> elements[BATCH];
        Mat3<F> A[BATCH];
        Polar<F> polars[BATCH];
        Blend<F> blends[BATCH];  // to V P
        F scales[BATCH], slopes[BATCH], turns[BATCH];
        for (int k = 0; k < BATCH; ++k) {
            const int t = min(first + k * W::stride(), count - 1);
            elements[k] = Element<L>::load(scene, t, x, A[k]);
            polars[k] = Polar<F>::of(A[k]);
        }
        for (int k = 0; k < BATCH; ++k) {
            const F volume = Element<L>::volume(elements[k]);
            scales[k] = 2.0f * mu * volume, slopes[k] = lambda * volume, turns[k] = -scales[k];
        }
        Polar<F>::template blend<BATCH>(polars, A, scales, slopes, turns, blends);
        for (int k = 0; k < BATCH; ++k) {
            const int t = first + k * W::stride();
            if (t >= count)
                break;
            const Element<L>& e = elements[k];
            const Mat3<F> P = Polar<F>::apply(polars[k], A[k], blends[k]);
            const Vec3<F> p = column(P, 0), q = column(P, 1), r = column(P, 2);
            F B[6];
            Element<L>::inverse(e, B);
            Vec3<F> f[4];  // f_{1..3} = V P B^T, by columns
            f[1] = B[0] * p + B[1] * q + B[2] * r;
            f[2] = B[3] * q + B[4] * r;
            f[3] = B[5] * r;
            f[0] = -(f[1] + f[2] + f[3]);
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
        Mat3<F> A;
        Element<L>::load(scene, t, x, A);
        const Polar<F> polar = Polar<F>::of(A);
        const F zero = F {}, one = zero + 1.0f, scale = 2.0f * mu, back = -scale;
        Mat3<F> for_stress = A, for_rotation = A;
        Blend<F> stress, rotation;
        Polar<F>::template blend<1>(&polar, &for_stress, &scale, &lambda, &back, &stress);
        Polar<F>::template blend<1>(&polar, &for_rotation, &zero, &zero, &one, &rotation);
        const Mat3<F> P = Polar<F>::apply(polar, for_stress, stress);
        const Mat3<F> R = Polar<F>::apply(polar, for_rotation, rotation);
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
