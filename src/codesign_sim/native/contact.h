// Penalty contact with anchored Coulomb friction against two fingers and a table.
#pragma once
#include "lanes.h"

namespace codesign {

constexpr int OBSTACLES = 3;  // left finger, right finger, table
constexpr int TABLE = 2;
constexpr int QUADRATURE = 3;  // points per surface triangle, exact for quadratic pressure
constexpr int ANCHOR = 4;  // where the point stuck (obstacle frame), and whether it sticks
constexpr int POSE = 12;  // rotation (row major) and translation of a finger
constexpr int GRID = 8;  // origin (3), cells per metre, size in cells (3), unused
constexpr int GRID_INDEX = 3;  // offset in the pool, stride of y, stride of z
constexpr int REPORT = 4;  // force on the object (3), deepest penetration

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
    FINGER_SPEED,
    NEAR_MARGIN
};

template <class F> struct Rigid {
    F r[9];
    Vec3<F> t;
};

template <int L> CODESIGN_INLINE Rigid<typename Lanes<L>::F> load_pose(const float* p) {
    Rigid<typename Lanes<L>::F> pose;
    for (int k = 0; k < 9; ++k)
        pose.r[k] = Lanes<L>::environment(p + k * L);
    pose.t = { Lanes<L>::environment(p + 9 * L), Lanes<L>::environment(p + 10 * L),
        Lanes<L>::environment(p + 11 * L) };
    return pose;
}
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

// Depth below the surface (positive inside) and the outward unit normal.
template <class F> struct Surface {
    F depth;
    Vec3<F> normal;
};

template <int L> struct DistanceGrid {
    typedef Lanes<L> W;
    typedef typename W::F F;
    typedef typename W::I I;
    const float* pool;
    Vec3<F> origin, size;
    F per_metre;
    I offset, stride_y, stride_z;

    CODESIGN_INLINE DistanceGrid load(const float* pool, const float* g, const int* i) {
        return { pool, { W::environment(g), W::environment(g + L), W::environment(g + 2 * L) },
            { W::environment(g + 4 * L), W::environment(g + 5 * L), W::environment(g + 6 * L) },
            W::environment(g + 3 * L), W::environment(i), W::environment(i + L),
            W::environment(i + 2 * L) };
    }

    // Trilinear signed distance and its gradient; outside the grid there is no contact.
    CODESIGN_INLINE Surface<F> sample(const DistanceGrid& grid, Vec3<F> p) {
        const F zero = W::broadcast(0.0f), one = W::broadcast(1.0f);
        const Vec3<F> u = grid.per_metre * (p - grid.origin);
        // Written so that a position that is not a number counts as outside, too.
        const auto inside = (u.x >= 0.0f) & (u.y >= 0.0f) & (u.z >= 0.0f) & (u.x < grid.size.x)
            & (u.y < grid.size.y) & (u.z < grid.size.z);
        if (!any(inside))
            return { zero - 1.0f, { zero, zero, zero } };
        const Vec3<F> v = { inside ? u.x : zero, inside ? u.y : zero, inside ? u.z : zero };
        const I ix = __builtin_convertvector(v.x, I), iy = __builtin_convertvector(v.y, I);
        const I iz = __builtin_convertvector(v.z, I);
        const F tx = v.x - __builtin_convertvector(ix, F);
        const F ty = v.y - __builtin_convertvector(iy, F);
        const F tz = v.z - __builtin_convertvector(iz, F);
        const I at = grid.offset + ix + grid.stride_y * iy + grid.stride_z * iz;
        F mean[4], slope[4];  // along x, on the four edges (y, z) of the cell
        for (int k = 0; k < 4; ++k) {
            const I edge = at + (k & 1 ? grid.stride_y : grid.stride_y * 0)
                + (k & 2 ? grid.stride_z : grid.stride_z * 0);
            const F low = W::gather(grid.pool, edge), high = W::gather(grid.pool, edge + 1);
            slope[k] = high - low;
            mean[k] = low + tx * slope[k];
        }
        const F low = mean[0] + ty * (mean[1] - mean[0]), high = mean[2] + ty * (mean[3] - mean[2]);
        const F sx = slope[0] + ty * (slope[1] - slope[0]);
        const F sxh = slope[2] + ty * (slope[3] - slope[2]);
        Vec3<F> n = { sx + tz * (sxh - sx),
            (mean[1] - mean[0]) + tz * ((mean[3] - mean[2]) - (mean[1] - mean[0])), high - low };
        n = (one / root(max(dot(n, n), zero + 1e-20f))) * n;
        const F depth = -(low + tz * (high - low));
        return { inside ? depth : zero - 1.0f, n };
    }
};

// Force in N on a point at `p`, in the obstacle's frame: the penalty along the normal, and the
// anchored tangential spring returned to the Coulomb cone. Updates the anchor.
template <int L>
CODESIGN_INLINE Vec3<typename Lanes<L>::F> contact_force(Vec3<typename Lanes<L>::F> p,
    Surface<typename Lanes<L>::F> surface, typename Lanes<L>::F stiffness,
    typename Lanes<L>::F friction, float* anchor) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int V = W::width;
    const F zero = W::broadcast(0.0f), one = W::broadcast(1.0f);
    const auto touching = surface.depth > zero;
    const auto stuck = touching & (W::load(anchor + 3 * V) > 0.5f);
    // A new contact sticks where it is.
    const Vec3<F> a = { stuck ? W::load(anchor) : p.x, stuck ? W::load(anchor + V) : p.y,
        stuck ? W::load(anchor + 2 * V) : p.z };
    const Vec3<F> stretch = p - a;
    const Vec3<F> slip = stretch - dot(stretch, surface.normal) * surface.normal;
    const F depth = touching ? surface.depth : zero;
    const F length = root(dot(slip, slip));
    const F limit = friction * depth;  // same stiffness along the surface as across it
    const F kept = min(one, limit / max(length, zero + 1e-12f));
    const Vec3<F> hold = kept * slip;
    const Vec3<F> now = p - hold;
    W::store(anchor, now.x);
    W::store(anchor + V, now.y);
    W::store(anchor + 2 * V, now.z);
    W::store(anchor + 3 * V, touching ? one : zero);
    const F push = stiffness * depth;
    const F drag = touching ? zero - stiffness : zero;
    return push * surface.normal + drag * hold;
}

// One obstacle for one group: a finger at its pose, or the table z = 0.
template <int L> struct Obstacle {
    typedef Lanes<L> W;
    typedef typename W::F F;
    bool finger;
    Rigid<F> pose;
    DistanceGrid<L> grid;
    float* anchors;  // [triangle item][quadrature point][ANCHOR][width]

    template <class Scene>
    CODESIGN_INLINE Obstacle load(const Scene& scene, int group, int o, const float* poses) {
        const bool finger = o != TABLE;
        const int side = finger ? o : 0;
        const size_t f = (size_t)group * 2 + side;
        const size_t anchors = ((size_t)group * OBSTACLES + o) * scene.triangle_items;
        return { finger, load_pose<L>(poses + side * POSE * L),
            DistanceGrid<L>::load(scene.grids.data, scene.grid_frames.data + f * GRID * L,
                scene.grid_indices.data + f * GRID_INDEX * L),
            scene.anchors.data + anchors * QUADRATURE * ANCHOR * W::width };
    }

    CODESIGN_INLINE float* anchor(const Obstacle& o, int triangle, int point) {
        return o.anchors + ((size_t)triangle * QUADRATURE + point) * ANCHOR * W::width;
    }

    // Whether a point of the world is within `margin` of where contact can be.
    CODESIGN_INLINE bool reaches(const Obstacle& o, Vec3<F> p, F margin) {
        if (!o.finger)
            return any(p.z < margin);
        const Vec3<F> q = into(o.pose, p) - o.grid.origin;
        const Vec3<F> high = (1.0f / o.grid.per_metre) * o.grid.size;
        return any((q.x > -margin) & (q.y > -margin) & (q.z > -margin) & (q.x < high.x + margin)
            & (q.y < high.y + margin) & (q.z < high.z + margin));
    }

    // Force on a point of the world, and how deep it is (negative outside).
    CODESIGN_INLINE Vec3<F> push(const Obstacle& o, Vec3<F> p, F stiffness, F friction,
        float* anchor, F& depth) {
        const F zero = W::broadcast(0.0f), one = W::broadcast(1.0f);
        if (!o.finger) {
            const Surface<F> s = { zero - p.z, { zero, zero, one } };
            depth = s.depth;
            return contact_force<L>(p, s, stiffness, friction, anchor);
        }
        const Vec3<F> local = into(o.pose, p);
        const Surface<F> s = DistanceGrid<L>::sample(o.grid, local);
        depth = s.depth;
        if (any(s.depth > zero))
            return turn(o.pose, contact_force<L>(local, s, stiffness, friction, anchor));
        W::store(anchor + 3 * W::width, zero);
        return { zero, zero, zero };
    }
};

// Adds the contact forces to the nodes and to `impulse`, and notes the greatest depths.
template <int L, class Scene>
CODESIGN_INLINE void add_contact_forces(const Scene& scene, int group, const float* x,
    const float* v, const float* poses, float* force, float* impulse, float* deepest) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies, V = W::width;
    const F zero = W::broadcast(0.0f), half = W::broadcast(0.5f), sixth = W::broadcast(1.0f / 6.0f);
    const F beta = W::broadcast(scene.settings.data[STIFFNESS_DAMPING]);
    const F friction = W::environment(scene.materials.data + ((size_t)group * 4 + 3) * L);
    const float per_area = scene.settings.data[CONTACT_STIFFNESS] / QUADRATURE;
    const int* near = scene.near_obstacle.data + (size_t)group * scene.triangle_items;
    for (int o = 0; o < OBSTACLES; ++o) {
        const auto obstacle = Obstacle<L>::load(scene, group, o, poses);
        Vec3<F> sum = { zero, zero, zero };
        F greatest = zero;
        for (int t = 0; t < scene.triangle_items; ++t) {
            if (!(near[t] & (1 << o)))
                continue;
            const int* node = scene.triangle_nodes.data + (size_t)t * 3 * C;
            const F area = W::item(scene.triangle_areas.data + (size_t)t * C);
            Vec3<F> corner[3], share[3];
            for (int c = 0; c < 3; ++c) {
                // A time beta ahead, which damps the contact against the moving obstacle.
                corner[c] = Nodes<L>::load(x, node + c * C)
                    + beta * Nodes<L>::load(v, node + c * C);
                share[c] = { zero, zero, zero };
            }
            const Vec3<F> middle = sixth * (corner[0] + corner[1] + corner[2]);
            for (int q = 0; q < QUADRATURE; ++q) {  // at (2/3, 1/6, 1/6) and so on
                F depth;
                const Vec3<F> f = Obstacle<L>::push(obstacle, half * corner[q] + middle,
                    per_area * area, friction, Obstacle<L>::anchor(obstacle, t, q), depth);
                greatest = max(greatest, area > zero ? depth : zero);
                sum = sum + f;
                for (int c = 0; c < 3; ++c)
                    share[c] = share[c] + sixth * f;
                share[q] = share[q] + half * f;
            }
            for (int c = 0; c < 3; ++c)
                Nodes<L>::add(force, node + c * C, share[c]);
        }
        float* total = impulse + o * 3 * V;
        W::store(total, W::load(total) + sum.x);
        W::store(total + V, W::load(total + V) + sum.y);
        W::store(total + 2 * V, W::load(total + 2 * V) + sum.z);
        W::store(deepest + o * V, greatest);
    }
}

// Marks the triangles that can reach an obstacle before the next marking: the first corner within
// `margin`, which covers a triangle's size. Triangles that are not marked drop their anchors.
template <int L, class Scene>
CODESIGN_INLINE void mark_near(const Scene& scene, int group, const float* x, const float* poses,
    typename Lanes<L>::F margin) {
    typedef Lanes<L> W;
    int* near = scene.near_obstacle.data + (size_t)group * scene.triangle_items;
    for (int t = 0; t < scene.triangle_items; ++t)
        near[t] = 0;
    for (int o = 0; o < OBSTACLES; ++o) {
        const bool present = int(scene.settings.data[OBSTACLE_BITS]) >> o & 1;
        const auto obstacle = Obstacle<L>::load(scene, group, o, poses);
        for (int t = 0; t < scene.triangle_items; ++t) {
            const int* node = scene.triangle_nodes.data + (size_t)t * 3 * W::copies;
            if (present && Obstacle<L>::reaches(obstacle, Nodes<L>::load(x, node), margin))
                near[t] |= 1 << o;
            else
                for (int q = 0; q < QUADRATURE; ++q)
                    W::store(Obstacle<L>::anchor(obstacle, t, q) + 3 * W::width,
                        W::broadcast(0.0f));
        }
    }
}

}  // namespace codesign
