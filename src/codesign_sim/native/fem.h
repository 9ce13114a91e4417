// The substeps of the block: symplectic Euler with elastic forces at x + beta v.
#pragma once
#include "contact.h"
#include "elements.h"
#include "lanes.h"

namespace codesign {

// Per node: share of the block's mass, 1 / volume, 1 if free, share of gravity (lumped load over
// lumped mass); the last three are 0 where pinned.
constexpr int NODE_CONSTANTS = 4;
constexpr int MARK_EVERY = 8;  // substeps between two markings of what is near

// Mass centre, its velocity and the angular velocity, weighted by node volume (so the density
// cancels); the best rigid motion in the sense of momentum.
template <class F> struct RigidMotion {
    Vec3<F> centre, velocity, spin;
};

// Sums over the nodes about a fixed point: first and second moments, momentum.
template <class F> struct Moments {
    Vec3<F> first, momentum, angular;
    F xx, yy, zz, xy, yz, zx;

    CODESIGN_INLINE void add(Moments& m, F weight, Vec3<F> r, Vec3<F> v) {
        const Vec3<F> wr = weight * r;
        m.first = m.first + wr;
        m.momentum = m.momentum + weight * v;
        m.angular = m.angular + cross(wr, v);
        m.xx = m.xx + wr.x * r.x, m.yy = m.yy + wr.y * r.y, m.zz = m.zz + wr.z * r.z;
        m.xy = m.xy + wr.x * r.y, m.yz = m.yz + wr.y * r.z, m.zx = m.zx + wr.z * r.x;
    }
};

template <int L>
CODESIGN_INLINE RigidMotion<typename Lanes<L>::F> rigid_motion(
    const Moments<typename Lanes<L>::F>& m, Vec3<typename Lanes<L>::F> about) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    const Vec3<F> d = { W::total(m.first.x), W::total(m.first.y), W::total(m.first.z) };
    const Vec3<F> v = { W::total(m.momentum.x), W::total(m.momentum.y), W::total(m.momentum.z) };
    const Vec3<F> h = { W::total(m.angular.x), W::total(m.angular.y), W::total(m.angular.z) };
    const Vec3<F> l = h - cross(d, v);  // about the centre; the weights sum to one
    const F sxx = W::total(m.xx) - d.x * d.x, syy = W::total(m.yy) - d.y * d.y;
    const F szz = W::total(m.zz) - d.z * d.z, sxy = W::total(m.xy) - d.x * d.y;
    const F syz = W::total(m.yz) - d.y * d.z, szx = W::total(m.zx) - d.z * d.x;
    const Mat3<F> inertia = { { syy + szz, -sxy, -szx, -sxy, sxx + szz, -syz, -szx, -syz, sxx + syy } };
    const Vec3<F> a = row(inertia, 0), b = row(inertia, 1), c = row(inertia, 2);
    const Vec3<F> bc = cross(b, c);
    const F inverse = 1.0f / max(dot(a, bc), W::broadcast(1e-30f));
    const Vec3<F> spin = inverse * (l.x * bc + l.y * cross(c, a) + l.z * cross(a, b));
    return { about + d, v, spin };
}

// Elastic forces at the present positions, for looking at them alone.
template <int L, class Scene> CODESIGN_INLINE void elastic(const Scene& scene, int group) {
    const size_t size = (size_t)scene.node_rows * ROW * L;
    float* force = scene.forces.data + group * size;
    for (size_t k = 0; k < size; ++k)
        force[k] = 0.0f;
    add_elastic_forces<L>(scene, group, scene.positions.data + group * size, force);
}

// All substeps of one advance for one group of environments.
template <int L, class Scene>
CODESIGN_INLINE void advance(const Scene& scene, int group) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies, V = W::width;
    const size_t state = (size_t)group * scene.node_rows * ROW * L;
    float* x = scene.positions.data + state;
    float* v = scene.velocities.data + state;
    float* ahead = scene.ahead.data + state;
    float* force = scene.forces.data + state;
    const float* load = scene.loads.data + state;
    const float* s = scene.settings.data;
    const int substeps = int(s[SUBSTEPS]), groups = scene.groups;
    const F dt = W::broadcast(s[TIME_STEP]), beta = W::broadcast(s[STIFFNESS_DAMPING]);
    const Vec3<F> gravity_step
        = dt * Vec3<F> { W::broadcast(s[GRAVITY_X]), W::broadcast(s[GRAVITY_Y]), W::broadcast(s[GRAVITY_Z]) };
    const F damping = W::broadcast(s[MASS_DAMPING] * s[TIME_STEP]);
    const bool about_rigid = s[DAMP_ABOUT_RIGID] > 0.5f;
    const F top_speed = W::broadcast(s[TOP_SPEED]);
    const F zero = W::broadcast(0.0f), one = W::broadcast(1.0f);
    const F per_density
        = dt / W::environment(scene.materials.data + ((size_t)group * 4 + 2) * L);
    float* centre_row = scene.centres.data + (size_t)group * 3 * L;
    Vec3<F> centre = { W::environment(centre_row), W::environment(centre_row + L),
        W::environment(centre_row + 2 * L) };

    float impulse[OBSTACLES * 3 * V], deepest[OBSTACLES * V];
    for (int k = 0; k < OBSTACLES * 3 * V; ++k)
        impulse[k] = 0.0f;

    F fastest2 = zero;
    // Step -1 only looks ahead from the given state; every other step kicks, damps and moves it.
    for (int step = -1; step < substeps; ++step) {
        const bool kick = step >= 0;
        if (kick) {
            const float* poses = scene.poses.data + ((size_t)step * groups + group) * 2 * POSE * L;
            if (step % MARK_EVERY == 0) {
                const F travel = root(W::largest(fastest2)) + s[FINGER_SPEED];
                mark_near<L>(scene, group, x, poses,
                    s[NEAR_MARGIN] + (1.5f * MARK_EVERY) * dt * travel);
            }
            for (size_t k = 0; k < (size_t)scene.node_rows * ROW * L; ++k)
                force[k] = load[k];
            add_elastic_forces<L>(scene, group, ahead, force);
            add_contact_forces<L>(scene, group, x, v, poses, force, impulse, deepest);
        }

        Moments<F> m = { { zero, zero, zero }, { zero, zero, zero }, { zero, zero, zero }, zero,
            zero, zero, zero, zero, zero };
        for (int n = 0; n < scene.node_items; ++n) {
            const int* node = scene.node_order.data + n * C;
            const float* constants = scene.node_constants.data + (size_t)n * NODE_CONSTANTS * C;
            Vec3<F> speed = Nodes<L>::load(v, node);
            if (kick) {
                const F per_volume = W::item(constants + C), falls = W::item(constants + 3 * C);
                speed = speed + (per_density * per_volume) * Nodes<L>::load(force, node)
                    + falls * gravity_step;
                Nodes<L>::store(v, node, speed);
            }
            Moments<F>::add(m, W::item(constants), Nodes<L>::load(x, node) - centre, speed);
        }
        const RigidMotion<F> rigid = rigid_motion<L>(m, centre);

        fastest2 = zero;
        const F drift = kick ? dt : zero, damp = kick ? damping : zero;
        for (int n = 0; n < scene.node_items; ++n) {
            const int* node = scene.node_order.data + n * C;
            const F moves = W::item(scene.node_constants.data + ((size_t)n * NODE_CONSTANTS + 2) * C);
            const Vec3<F> at = Nodes<L>::load(x, node);
            Vec3<F> speed = Nodes<L>::load(v, node);
            // Both dampings act on the flexing only, so that a block flying or spinning as a
            // whole keeps its momenta.
            Vec3<F> flexing = speed;
            if (about_rigid)
                flexing = speed - rigid.velocity - cross(rigid.spin, at - rigid.centre);
            speed = speed - (damp * moves) * flexing;
            const F speed2 = dot(speed, speed);
            const F slow = speed2 > top_speed * top_speed ? top_speed / root(speed2) : one;
            speed = slow * speed;
            fastest2 = max(fastest2, slow * slow * speed2);
            const Vec3<F> next = at + drift * speed;
            Nodes<L>::store(v, node, speed);
            Nodes<L>::store(x, node, next);
            Nodes<L>::store(ahead, node, next + (slow * beta) * flexing);
        }
        centre = rigid.centre + drift * rigid.velocity;
    }

    W::store_environment(centre_row, centre.x);
    W::store_environment(centre_row + L, centre.y);
    W::store_environment(centre_row + 2 * L, centre.z);
    float* report = scene.reports.data + (size_t)group * OBSTACLES * REPORT * L;
    const F share = W::broadcast(1.0f / substeps);
    for (int o = 0; o < OBSTACLES; ++o) {
        for (int k = 0; k < 3; ++k)
            W::store_environment(report + (o * REPORT + k) * L,
                share * W::total(W::load(impulse + (o * 3 + k) * V)));
        W::store_environment(
            report + (o * REPORT + 3) * L, W::largest(W::load(deepest + o * V)));
    }
}

}  // namespace codesign
