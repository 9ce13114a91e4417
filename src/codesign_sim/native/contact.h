// Penalty contact with anchored Coulomb friction against two fingers and a table.
#pragma once
#include "lanes.h"

namespace codesign {

constexpr int OBSTACLES = 3;  // left finger, right finger, table
constexpr int TABLE = 2;
constexpr int QUADRATURE = 3;  // points per surface triangle, exact for quadratic pressure
constexpr int ANCHOR = 4;  // where the point stuck (obstacle frame), and whether it sticks
// Motion of the fingers: position (3) and way (3), first and last quaternion (4 each), width and
// change of width, half the angle between the quaternions and 1 / its sine.
constexpr int MOTION = 18;
constexpr int GRID = 8;  // origin (3), cells per metre, size in cells (3), unused
constexpr int GRID_INDEX = 3;  // offset in the pool, points from y to y + 1, from z to z + 1
constexpr int REPORT = 4;  // force on the object (3), deepest penetration

// A trilinear distance changes by at most sqrt(3) times the way; and some for rounding.
constexpr float STEEPEST = 1.75f;

// What scene.settings holds; the same order as SETTINGS in kernels.py.
enum Setting {
    SUBSTEPS,
    TIME_STEP,
    STIFFNESS_DAMPING,
    MASS_DAMPING,
    DAMP_ABOUT_RIGID,
    GRAVITY_X,
    GRAVITY_Y,
    GRAVITY_Z,
    TOP_SPEED,
    CONTACT_STIFFNESS,
    OBSTACLE_BITS,  // which obstacles are there
    FRACTION,  // of the fingers' motion, at the first step
    FRACTION_STEP,
    FINGER_SPEED,
    CONTACT_SKIN  // distance that points travel between two markings of what is near
};

template <class F> struct Rigid {
    F r[9];
    Vec3<F> t;
};

template <class F> CODESIGN_INLINE Vec3<F> into(const Rigid<F>& pose, Vec3<F> p) {
    const Vec3<F> d = p - pose.t;
    return { pose.r[0] * d.x + pose.r[3] * d.y + pose.r[6] * d.z,
        pose.r[1] * d.x + pose.r[4] * d.y + pose.r[7] * d.z,
        pose.r[2] * d.x + pose.r[5] * d.y + pose.r[8] * d.z };
}
template <class F> CODESIGN_INLINE Vec3<F> turn(const Rigid<F>& pose, Vec3<F> v) {
    return { pose.r[0] * v.x + pose.r[1] * v.y + pose.r[2] * v.z,
        pose.r[3] * v.x + pose.r[4] * v.y + pose.r[5] * v.z,
        pose.r[6] * v.x + pose.r[7] * v.y + pose.r[8] * v.z };
}

// Sine of a quarter turn at most, by its series to single precision.
template <class F> CODESIGN_INLINE F sine(F x) {
    const F y = x * x;
    const F tail = 1.0f / 362880 - y * (1.0f / 39916800);
    return x * (1.0f - y * (1.0f / 6 - y * (1.0f / 120 - y * (1.0f / 5040 - y * tail))));
}

// Left and right finger after a fraction of their motion, which is straight and at constant speed.
template <int L>
CODESIGN_INLINE void place_fingers(
    const float* motion, float fraction, Rigid<typename Lanes<L>::F> pose[2]) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    F m[MOTION];
    for (int k = 0; k < MOTION; ++k)
        m[k] = W::environment(motion + k * W::environments);
    const F s = W::broadcast(fraction), rest = W::broadcast(1.0f - fraction);
    const F first = sine(rest * m[16]) * m[17], last = sine(s * m[16]) * m[17];
    const F x = first * m[6] + last * m[10], y = first * m[7] + last * m[11];
    const F z = first * m[8] + last * m[12], w = first * m[9] + last * m[13];
    const Rigid<F> middle = { { 1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z),
                                  2.0f * (x * z + w * y), 2.0f * (x * y + w * z),
                                  1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x),
                                  2.0f * (x * z - w * y), 2.0f * (y * z + w * x),
                                  1.0f - 2.0f * (x * x + y * y) },
        { m[0] + s * m[3], m[1] + s * m[4], m[2] + s * m[5] } };
    const F half = 0.5f * (m[14] + s * m[15]);
    const Vec3<F> opening = { half * middle.r[1], half * middle.r[4], half * middle.r[7] };
    pose[0] = pose[1] = middle;
    pose[0].t = middle.t + opening;
    pose[1].t = middle.t - opening;
}

// Depth below the surface (positive inside) and the way out: the gradient of the distance.
template <class F> struct Surface {
    F depth;
    Vec3<F> outward;
};

template <class F> CODESIGN_INLINE F deepest(const Surface<F> s[QUADRATURE]) {
    return max(max(s[0].depth, s[1].depth), s[2].depth);
}

// The pool holds, for each grid point, its distance and that of its neighbour along y: so the four
// corners of a cell's face are side by side.
template <int L> struct DistanceGrid {
    typedef Lanes<L> W;
    typedef typename W::F F;
    typedef typename W::I I;
    const float* pool;
    Vec3<F> origin, size;
    F per_metre;
    I offset, stride_y, stride_z;

    CODESIGN_INLINE DistanceGrid load(const float* pool, const float* g, const int* i) {
        constexpr int E = W::environments;
        return { pool, { W::environment(g), W::environment(g + E), W::environment(g + 2 * E) },
            { W::environment(g + 4 * E), W::environment(g + 5 * E), W::environment(g + 6 * E) },
            W::environment(g + 3 * E), W::environment(i), W::environment(i + E),
            W::environment(i + 2 * E) };
    }

    CODESIGN_INLINE Vec3<F> cells(const DistanceGrid& grid, Vec3<F> p) {
        return grid.per_metre * (p - grid.origin);
    }

    // Trilinear signed distance `u` cells from the grid's origin (in the grid).
    CODESIGN_INLINE Surface<F> interpolate(const DistanceGrid& grid, Vec3<F> u) {
        const I ix = W::whole(u.x), iy = W::whole(u.y), iz = W::whole(u.z);
        const F tx = u.x - W::real(ix), ty = u.y - W::real(iy), tz = u.z - W::real(iz);
        const I at = grid.offset + 2 * (ix + grid.stride_y * iy + grid.stride_z * iz);
        F near[4], far[4];  // (x, y), (x, y + 1), (x + 1, y), (x + 1, y + 1) at z and z + 1
        W::gather(grid.pool, at, near);
        W::gather(grid.pool, at + 2 * grid.stride_z, far);
        const F slope[4]
            = { near[2] - near[0], near[3] - near[1], far[2] - far[0], far[3] - far[1] };
        const F mean[4] = { near[0] + tx * slope[0], near[1] + tx * slope[1],
            far[0] + tx * slope[2], far[1] + tx * slope[3] };
        const F low = mean[0] + ty * (mean[1] - mean[0]), high = mean[2] + ty * (mean[3] - mean[2]);
        const F sx = slope[0] + ty * (slope[1] - slope[0]);
        const F sxh = slope[2] + ty * (slope[3] - slope[2]);
        const Vec3<F> n = { sx + tz * (sxh - sx),
            (mean[1] - mean[0]) + tz * ((mean[3] - mean[2]) - (mean[1] - mean[0])), high - low };
        return { -(low + tz * (high - low)), n };
    }

    // Whether any of the points touches, and how. Outside the grid there is no contact. What the
    // points wait for overlaps.
    CODESIGN_INLINE bool sample(
        const DistanceGrid& grid, const Vec3<F> p[QUADRATURE], Surface<F> s[QUADRATURE]) {
        const F zero = W::broadcast(0.0f);
        Vec3<F> u[QUADRATURE];
        decltype(zero < zero) inside[QUADRATURE];
        for (int q = 0; q < QUADRATURE; ++q) {
            u[q] = cells(grid, p[q]);
            const Vec3<F> v = u[q];
            // Written so that a position that is not a number counts as outside, too.
            inside[q] = (min(v.x, min(v.y, v.z)) >= 0.0f) & (v.x < grid.size.x)
                & (v.y < grid.size.y) & (v.z < grid.size.z);
        }
        if (!any(inside[0] | inside[1] | inside[2]))
            return false;
        for (int q = 0; q < QUADRATURE; ++q) {
            s[q] = interpolate(grid,
                { inside[q] ? u[q].x : zero, inside[q] ? u[q].y : zero,
                    inside[q] ? u[q].z : zero });
            s[q].depth = inside[q] ? s[q].depth : zero - 1.0f;
        }
        return any(deepest(s) > zero);
    }

    // Whether a point can get below the surface by travelling less than `margin`.
    CODESIGN_INLINE bool reaches(const DistanceGrid& grid, Vec3<F> p, F margin) {
        const F zero = W::broadcast(0.0f);
        const Vec3<F> u = cells(grid, p);
        const F m = grid.per_metre * margin;
        const auto around = (u.x > -m) & (u.y > -m) & (u.z > -m) & (u.x < grid.size.x + m)
            & (u.y < grid.size.y + m) & (u.z < grid.size.z + m);
        if (!any(around))
            return false;
        const F last = zero + 1e-3f;  // keeps to the last cell
        const Vec3<F> v = { min(max(u.x, zero), grid.size.x - last),
            min(max(u.y, zero), grid.size.y - last), min(max(u.z, zero), grid.size.z - last) };
        const Vec3<F> within = { around ? v.x : zero, around ? v.y : zero, around ? v.z : zero };
        return any(around & (interpolate(grid, within).depth > -STEEPEST * margin));
    }
};

// Forces in N on points at `p`, in the obstacle's frame: the penalty along the normal, and the
// anchored tangential spring returned to the Coulomb cone. Updates the anchors.
template <int L>
CODESIGN_INLINE void contact_forces(const Vec3<typename Lanes<L>::F> p[QUADRATURE],
    const Surface<typename Lanes<L>::F> surfaces[QUADRATURE], typename Lanes<L>::F stiffness,
    typename Lanes<L>::F friction, float* anchors, Vec3<typename Lanes<L>::F> forces[QUADRATURE]) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int V = W::width;
    const F zero = W::broadcast(0.0f), one = W::broadcast(1.0f), tiny = W::broadcast(1e-20f);
    Vec3<F> normals[QUADRATURE];
    for (int q = 0; q < QUADRATURE; ++q) {
        const Vec3<F> n = surfaces[q].outward;
        normals[q] = (one / root(max(dot(n, n), tiny))) * n;
    }
    for (int q = 0; q < QUADRATURE; ++q) {
        float* anchor = anchors + q * ANCHOR * V;
        const Vec3<F> at = p[q], normal = normals[q];
        const auto touching = surfaces[q].depth > zero;
        const auto stuck = touching & (W::load(anchor + 3 * V) > 0.5f);
        // A new contact sticks where it is.
        const Vec3<F> a = { stuck ? W::load(anchor) : at.x, stuck ? W::load(anchor + V) : at.y,
            stuck ? W::load(anchor + 2 * V) : at.z };
        const Vec3<F> stretch = at - a;
        Vec3<F> hold = stretch - dot(stretch, normal) * normal;
        const F depth = touching ? surfaces[q].depth : zero;
        const F limit = friction * depth;  // same stiffness along the surface as across it
        const F length2 = dot(hold, hold);
        const auto slips = length2 > limit * limit;
        if (any(slips))
            hold = (slips ? limit / root(max(length2, tiny)) : one) * hold;
        const Vec3<F> now = at - hold;
        W::store(anchor, now.x);
        W::store(anchor + V, now.y);
        W::store(anchor + 2 * V, now.z);
        W::store(anchor + 3 * V, touching ? one : zero);
        const F push = stiffness * depth;
        const F drag = touching ? zero - stiffness : zero;
        forces[q] = push * normal + drag * hold;
    }
}

// One obstacle for one group: a finger at its pose, or the table z = 0.
template <int L> struct Obstacle {
    typedef Lanes<L> W;
    typedef typename W::F F;
    bool finger, present;
    Rigid<F> pose;
    DistanceGrid<L> grid;
    float* anchors;  // [triangle item][quadrature point][ANCHOR][width]

    template <class Scene>
    CODESIGN_INLINE Obstacle load(const Scene& scene, int group, int o, const Rigid<F> pose[2]) {
        constexpr int E = W::environments;
        const bool finger = o != TABLE;
        const int side = finger ? o : 0;
        const size_t f = (size_t)group * 2 + side;
        const size_t anchors = ((size_t)group * OBSTACLES + o) * scene.triangle_items;
        return { finger, (int(scene.settings.data[OBSTACLE_BITS]) >> o & 1) != 0,
            pose[side],
            DistanceGrid<L>::load(scene.grids.data, scene.grid_frames.data + f * GRID * E,
                scene.grid_indices.data + f * GRID_INDEX * E),
            scene.anchors.data + anchors * QUADRATURE * ANCHOR * W::width };
    }

    // Anchor of a triangle's first point; the next is ANCHOR * width further on.
    CODESIGN_INLINE float* anchor(const Obstacle& o, int triangle) {
        return W::state(o.anchors, triangle, QUADRATURE * ANCHOR);
    }

    // Whether a point of the world can come to touch by travelling less than `margin`.
    CODESIGN_INLINE bool reaches(const Obstacle& o, Vec3<F> p, F margin) {
        if (!o.finger)
            return any(p.z < margin);
        return DistanceGrid<L>::reaches(o.grid, into(o.pose, p), margin);
    }

    // Forces on points of the world that are near the obstacle, and the depth of the deepest.
    CODESIGN_INLINE F push(const Obstacle& o, const Vec3<F> p[QUADRATURE], F stiffness, F friction,
        float* anchors, Vec3<F> forces[QUADRATURE]) {
        const F zero = W::broadcast(0.0f), one = W::broadcast(1.0f);
        Vec3<F> at[QUADRATURE];
        Surface<F> s[QUADRATURE];
        for (int q = 0; q < QUADRATURE; ++q) {
            at[q] = o.finger ? into(o.pose, p[q]) : p[q];
            s[q] = { zero - at[q].z, { zero, zero, one } };
        }
        if (o.finger ? DistanceGrid<L>::sample(o.grid, at, s) : any(deepest(s) > zero)) {
            contact_forces<L>(at, s, stiffness, friction, anchors, forces);
            for (int q = 0; q < QUADRATURE; ++q)
                forces[q] = o.finger ? turn(o.pose, forces[q]) : forces[q];
            return deepest(s);
        }
        for (int q = 0; q < QUADRATURE; ++q) {
            W::store(anchors + (q * ANCHOR + 3) * W::width, zero);
            forces[q] = { zero, zero, zero };
        }
        return zero;
    }
};

// Contact forces summed over the steps, and the depths at the last one.
template <int L> struct Ledger {
    Vec3<typename Lanes<L>::F> impulse[OBSTACLES];
    typename Lanes<L>::F deepest[OBSTACLES];
};

// Corners of a surface triangle and its three quadrature points, at (2/3, 1/6, 1/6) and so on.
template <int L> struct Triangle {
    typedef Lanes<L> W;
    typedef typename W::F F;
    const int* node;  // three times W::copies
    F area;
    Vec3<F> points[QUADRATURE];

    // A time beta ahead of positions x moving at v.
    template <class Scene>
    CODESIGN_INLINE Triangle load(
        const Scene& scene, int t, const float* x, const float* v, F beta) {
        constexpr int C = W::copies;
        const F half = W::broadcast(0.5f), sixth = W::broadcast(1.0f / 6.0f);
        Triangle a;
        a.node = W::constants(scene.triangle_nodes.data, t, 3);
        a.area = W::item(W::constants(scene.triangle_areas.data, t, 1));
        Vec3<F> corner[3];
        for (int c = 0; c < 3; ++c)
            corner[c] = Nodes<L>::load(x, a.node + c * C)
                + beta * Nodes<L>::load(v, a.node + c * C);
        const Vec3<F> middle = sixth * (corner[0] + corner[1] + corner[2]);
        for (int q = 0; q < QUADRATURE; ++q)
            a.points[q] = half * corner[q] + middle;
        return a;
    }
};

// Gives the contact forces of the triangles near an obstacle to their corners, and enters them.
// Looking a time beta ahead damps the contact against the moving obstacle.
template <int L, class Scene>
CODESIGN_INLINE void give_contact_forces(const Scene& scene, int group, const float* x,
    const float* v, const Rigid<typename Lanes<L>::F> poses[2], const Forces& forces,
    Ledger<L>& ledger) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies;
    const F zero = W::broadcast(0.0f), half = W::broadcast(0.5f), sixth = W::broadcast(1.0f / 6.0f);
    const F beta = W::broadcast(scene.settings.data[STIFFNESS_DAMPING]);
    const F friction
        = W::environment(scene.materials.data + ((size_t)group * 4 + 3) * W::environments);
    const float per_area = scene.settings.data[CONTACT_STIFFNESS] / QUADRATURE;
    const int triangles = W::count(scene.triangle_items);
    const int* near = scene.near_obstacle.data + (size_t)group * triangles;
    Obstacle<L> obstacles[OBSTACLES];
    for (int o = 0; o < OBSTACLES; ++o) {
        obstacles[o] = Obstacle<L>::load(scene, group, o, poses);
        ledger.deepest[o] = zero;
    }
    for (int t = W::first(); t < triangles; t += W::stride()) {
        if (!near[t])
            continue;
        const auto triangle = Triangle<L>::load(scene, t, x, v, beta);
        const Vec3<F> none = { zero, zero, zero };
        Vec3<F> push[QUADRATURE] = { none, none, none };
        for (int o = 0; o < OBSTACLES; ++o) {
            if (!(near[t] & (1 << o)))
                continue;
            Vec3<F> more[QUADRATURE];
            const F depth = Obstacle<L>::push(obstacles[o], triangle.points,
                per_area * triangle.area, friction, Obstacle<L>::anchor(obstacles[o], t), more);
            ledger.deepest[o] = max(ledger.deepest[o], triangle.area > zero ? depth : zero);
            for (int q = 0; q < QUADRATURE; ++q)
                push[q] = push[q] + more[q];
            ledger.impulse[o] = ledger.impulse[o] + (more[0] + more[1] + more[2]);
        }
        const Vec3<F> even = sixth * (push[0] + push[1] + push[2]);
        float* corners = W::corners(forces.triangles, t, 3);
        for (int c = 0; c < 3; ++c)
            Nodes<L>::give(
                forces, corners + c * 3 * C, triangle.node + c * C, even + half * push[c]);
    }
}

// Marks the triangles that can touch an obstacle before any node or finger has travelled by
// `margin`. Triangles no longer marked lose their anchors, and the forces left at their corners.
template <int L, class Scene>
CODESIGN_INLINE void mark_near(const Scene& scene, int group, const float* x,
    const Rigid<typename Lanes<L>::F> poses[2], const Forces& forces,
    typename Lanes<L>::F margin) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    const F zero = W::broadcast(0.0f);
    const int triangles = W::count(scene.triangle_items);
    int* near = scene.near_obstacle.data + (size_t)group * triangles;
    Obstacle<L> obstacles[OBSTACLES];
    for (int o = 0; o < OBSTACLES; ++o)
        obstacles[o] = Obstacle<L>::load(scene, group, o, poses);
    for (int t = W::first(); t < triangles; t += W::stride()) {
        const auto triangle = Triangle<L>::load(scene, t, x, x, zero);
        int now = 0;
        for (int o = 0; o < OBSTACLES; ++o) {
            for (int q = 0; q < QUADRATURE && obstacles[o].present && !(now >> o & 1); ++q)
                now |= Obstacle<L>::reaches(obstacles[o], triangle.points[q], margin) << o;
            if (near[t] & ~now & (1 << o)) {
                float* anchor = Obstacle<L>::anchor(obstacles[o], t);
                for (int q = 0; q < QUADRATURE; ++q)
                    W::store(anchor + (q * ANCHOR + 3) * W::width, zero);
            }
        }
        if (near[t] && !now) {
            float* corners = W::corners(forces.triangles, t, 3);
            for (int c = 0; c < 3; ++c)
                Nodes<L>::withdraw(corners + c * 3 * W::copies);
        }
        near[t] = now;
    }
}

}  // namespace codesign
