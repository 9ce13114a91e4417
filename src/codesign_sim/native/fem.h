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
    const Vec3<F> a = { syy + szz, -sxy, -szx }, b = { -sxy, sxx + szz, -syz };
    const Vec3<F> c = { -szx, -syz, sxx + syy };  // rows of the inertia
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

// The state of one group and what one step does to it.
template <int L> struct Motion {
    typedef Lanes<L> W;
    typedef typename W::F F;
    float *x, *v, *ahead, *force;
    const float* load;
    F dt, beta, damping, dt_per_density, top_speed;
    Vec3<F> gravity_step, centre;
    F fastest2;  // squared speed of the fastest node
    bool about_rigid;
};

template <int L, class Scene> CODESIGN_INLINE Motion<L> start(const Scene& scene, int group) {
    typedef Lanes<L> W;
    const size_t state = (size_t)group * scene.node_rows * ROW * L;
    const float* s = scene.settings.data;
    const float* centre = scene.centres.data + (size_t)group * 3 * L;
    Motion<L> m;
    m.x = scene.positions.data + state;
    m.v = scene.velocities.data + state;
    m.ahead = scene.ahead.data + state;
    m.force = scene.forces.data + state;
    m.load = scene.loads.data + state;
    m.dt = W::broadcast(s[TIME_STEP]);
    m.beta = W::broadcast(s[STIFFNESS_DAMPING]);
    m.damping = W::broadcast(s[MASS_DAMPING] * s[TIME_STEP]);
    m.dt_per_density
        = m.dt / W::environment(scene.materials.data + ((size_t)group * 4 + 2) * L);
    m.top_speed = W::broadcast(s[TOP_SPEED]);
    m.gravity_step = { m.dt * s[GRAVITY_X], m.dt * s[GRAVITY_Y], m.dt * s[GRAVITY_Z] };
    m.centre = { W::environment(centre), W::environment(centre + L),
        W::environment(centre + 2 * L) };
    m.fastest2 = W::broadcast(0.0f);
    m.about_rigid = s[DAMP_ABOUT_RIGID] > 0.5f;
    return m;
}

// Gives every node the velocity that its force adds in a step (not if only `looking`), and
// returns the rigid part of the motion.
template <int L, class Scene>
CODESIGN_INLINE RigidMotion<typename Lanes<L>::F> kick(
    const Scene& scene, const Motion<L>& m, bool looking) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies;
    const F zero = W::broadcast(0.0f);
    const Vec3<F> none = { zero, zero, zero };
    Moments<F> sums = { none, none, none, zero, zero, zero, zero, zero, zero };
    for (int n = 0; n < scene.node_items; ++n) {
        const int* node = scene.node_order.data + n * C;
        const float* constants = scene.node_constants.data + (size_t)n * NODE_CONSTANTS * C;
        Vec3<F> speed = Nodes<L>::load(m.v, node);
        if (!looking) {
            const F per_volume = W::item(constants + C), falls = W::item(constants + 3 * C);
            speed = speed + (m.dt_per_density * per_volume) * Nodes<L>::load(m.force, node)
                + falls * m.gravity_step;
            Nodes<L>::store(m.v, node, speed);
        }
        const Vec3<F> from_centre = Nodes<L>::load(m.x, node) - m.centre;
        Moments<F>::add(sums, W::item(constants), from_centre, speed);
    }
    return rigid_motion<L>(sums, m.centre);
}

// Damps the flexing, moves every node (not if only `looking`) and looks ahead from there. Both
// dampings act on the flexing alone, so that a block flying or spinning as a whole keeps its
// momenta.
template <int L, class Scene>
CODESIGN_INLINE void move(const Scene& scene, Motion<L>& m,
    const RigidMotion<typename Lanes<L>::F>& rigid, bool looking) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies;
    const F zero = W::broadcast(0.0f), one = W::broadcast(1.0f);
    const F dt = looking ? zero : m.dt, damping = looking ? zero : m.damping;
    m.fastest2 = zero;
    for (int n = 0; n < scene.node_items; ++n) {
        const int* node = scene.node_order.data + n * C;
        const float* constants = scene.node_constants.data + (size_t)n * NODE_CONSTANTS * C;
        const F free = W::item(constants + 2 * C);
        const Vec3<F> at = Nodes<L>::load(m.x, node);
        Vec3<F> speed = Nodes<L>::load(m.v, node);
        Vec3<F> flexing = speed;
        if (m.about_rigid)
            flexing = speed - rigid.velocity - cross(rigid.spin, at - rigid.centre);
        speed = speed - (damping * free) * flexing;
        const F speed2 = dot(speed, speed);
        const F slow = speed2 > m.top_speed * m.top_speed ? m.top_speed / root(speed2) : one;
        speed = slow * speed;
        m.fastest2 = max(m.fastest2, slow * slow * speed2);
        const Vec3<F> next = at + dt * speed;
        Nodes<L>::store(m.v, node, speed);
        Nodes<L>::store(m.x, node, next);
        Nodes<L>::store(m.ahead, node, next + (slow * m.beta) * flexing);
    }
    m.centre = rigid.centre + dt * rigid.velocity;
}

// Contact forces summed over the steps, and the present depths: [obstacle][3 and 1][width].
template <int L> struct Ledger {
    static constexpr int width = Lanes<L>::width;
    float impulse[OBSTACLES * 3 * width], deepest[OBSTACLES * width];
};

template <int L, class Scene>
CODESIGN_INLINE void add_forces(
    const Scene& scene, int group, int step, const Motion<L>& m, Ledger<L>& ledger) {
    typedef Lanes<L> W;
    const float* s = scene.settings.data;
    const float* poses
        = scene.poses.data + ((size_t)step * scene.groups + group) * 2 * POSE * L;
    if (step % MARK_EVERY == 0) {
        const typename W::F speed = root(W::largest(m.fastest2)) + s[FINGER_SPEED];
        mark_near<L>(
            scene, group, m.x, poses, s[NEAR_MARGIN] + (1.5f * MARK_EVERY) * m.dt * speed);
    }
    const size_t size = (size_t)scene.node_rows * ROW * L;
    for (size_t k = 0; k < size; ++k)
        m.force[k] = m.load[k];
    add_elastic_forces<L>(scene, group, m.ahead, m.force);
    add_contact_forces<L>(
        scene, group, m.x, m.v, poses, m.force, ledger.impulse, ledger.deepest);
}

// Mean contact force over the steps and final depth, per environment.
template <int L, class Scene>
CODESIGN_INLINE void write_report(
    const Scene& scene, int group, const Ledger<L>& ledger, int steps) {
    typedef Lanes<L> W;
    float* report = scene.reports.data + (size_t)group * OBSTACLES * REPORT * L;
    for (int o = 0; o < OBSTACLES; ++o, report += REPORT * L) {
        for (int k = 0; k < 3; ++k) {
            const auto sum = W::total(W::load(ledger.impulse + (o * 3 + k) * W::width));
            W::store_environment(report + k * L, (1.0f / steps) * sum);
        }
        const auto depth = W::largest(W::load(ledger.deepest + o * W::width));
        W::store_environment(report + 3 * L, depth);
    }
}

// All substeps of one advance for one group of environments.
template <int L, class Scene> CODESIGN_INLINE void advance(const Scene& scene, int group) {
    typedef Lanes<L> W;
    const int steps = int(scene.settings.data[SUBSTEPS]);
    Motion<L> motion = start<L>(scene, group);
    Ledger<L> ledger = {};
    // Positions or velocities may have been set since the last advance: look ahead first.
    for (int step = -1; step < steps; ++step) {
        const bool looking = step < 0;
        if (!looking)
            add_forces<L>(scene, group, step, motion, ledger);
        const auto rigid = kick<L>(scene, motion, looking);
        move<L>(scene, motion, rigid, looking);
    }
    float* centre = scene.centres.data + (size_t)group * 3 * L;
    W::store_environment(centre, motion.centre.x);
    W::store_environment(centre + L, motion.centre.y);
    W::store_environment(centre + 2 * L, motion.centre.z);
    write_report<L>(scene, group, ledger, steps);
}

}  // namespace codesign
