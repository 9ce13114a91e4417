// The substeps of the block: symplectic Euler with elastic forces at x + beta v.
#pragma once
#include "contact.h"
#include "elements.h"
#include "lanes.h"

namespace codesign {

// Per node: share of the block's mass, 1 / volume, 1 if free, share of gravity (lumped load over
// lumped mass); the last three are 0 where pinned.
constexpr int NODE_CONSTANTS = 4;

// Mass centre, its velocity and the angular velocity, weighted by node volume (so the density
// cancels); the best rigid motion in the sense of momentum.
template <class F> struct RigidMotion {
    Vec3<F> centre, velocity, spin;
};

// Sums over the nodes about a fixed point, weighted by their shares of the mass.
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
    F sums[15] = { m.first.x, m.first.y, m.first.z, m.momentum.x, m.momentum.y, m.momentum.z,
        m.angular.x, m.angular.y, m.angular.z, m.xx, m.yy, m.zz, m.xy, m.yz, m.zx };
    W::total(sums, 15);
    const Vec3<F> d = { sums[0], sums[1], sums[2] }, v = { sums[3], sums[4], sums[5] };
    const Vec3<F> h = { sums[6], sums[7], sums[8] };
    const Vec3<F> l = h - cross(d, v);  // about the centre; the weights sum to one
    const F sxx = sums[9] - d.x * d.x, syy = sums[10] - d.y * d.y, szz = sums[11] - d.z * d.z;
    const F sxy = sums[12] - d.x * d.y, syz = sums[13] - d.y * d.z, szx = sums[14] - d.z * d.x;
    const Vec3<F> a = { syy + szz, -sxy, -szx }, b = { -sxy, sxx + szz, -syz };
    const Vec3<F> c = { -szx, -syz, sxx + syy };  // rows of the inertia
    const Vec3<F> bc = cross(b, c);
    const F inverse = 1.0f / max(dot(a, bc), W::broadcast(1e-30f));
    const Vec3<F> spin = inverse * (l.x * bc + l.y * cross(c, a) + l.z * cross(a, b));
    return { about + d, v, spin };
}

// Where the forces of a group go, with none there yet.
template <int L, class Scene> CODESIGN_INLINE Forces no_forces(const Scene& scene, int group) {
    typedef Lanes<L> W;
    constexpr int C = W::copies, E = W::environments;
    const size_t rows = (size_t)scene.node_rows * ROW * E;
    const size_t tets = (size_t)scene.tet_items * 12 * C;
    const size_t triangles = (size_t)scene.triangle_items * 9 * C;
    float* corners = scene.corner_forces.data + group * (tets + triangles);
    const Forces forces = { scene.forces.data + group * rows, corners, corners + tets };
    for (size_t k = W::first(); k < rows; k += W::stride())
        forces.nodes[k] = 0.0f;
    for (int t = W::first(); t < W::count(scene.triangle_items); t += W::stride())
        for (int c = 0; c < 3; ++c)
            Nodes<L>::withdraw(W::corners(forces.triangles, t, 3) + c * 3 * C);
    return forces;
}

// Elastic forces at the present positions, for looking at them alone.
template <int L, class Scene> CODESIGN_INLINE void elastic(const Scene& scene, int group) {
    typedef Lanes<L> W;
    const Forces forces = no_forces<L>(scene, group);
    const size_t state = (size_t)group * scene.node_rows * ROW * W::environments;
    give_elastic_forces<L>(scene, group, scene.positions.data + state, forces);
    W::barrier();
    for (int n = W::first(); n < W::count(scene.node_items); n += W::stride()) {
        const int* node = W::constants(scene.node_order.data, n, 1);
        Nodes<L>::store(forces.nodes, node, Nodes<L>::collect(scene, forces, node));
    }
}

// The state of one group and what one step does to it.
template <int L> struct Motion {
    typedef Lanes<L> W;
    typedef typename W::F F;
    float *x, *v, *ahead;
    const float* load;
    F dt, beta, damping, dt_per_density, top_speed;
    Vec3<F> gravity_step, centre;
    bool about_rigid;
    // What is near an obstacle is marked anew when a point may have travelled by the margin.
    F fastest, travelled, margin;
};

template <int L, class Scene> CODESIGN_INLINE Motion<L> start(const Scene& scene, int group) {
    typedef Lanes<L> W;
    constexpr int E = W::environments;
    const size_t state = (size_t)group * scene.node_rows * ROW * E;
    const float* s = scene.settings.data;
    const float* centre = scene.centres.data + (size_t)group * 3 * E;
    Motion<L> m;
    m.x = scene.positions.data + state;
    m.v = scene.velocities.data + state;
    m.ahead = scene.ahead.data + state;
    m.load = scene.loads.data + state;
    m.dt = W::broadcast(s[TIME_STEP]);
    m.beta = W::broadcast(s[STIFFNESS_DAMPING]);
    m.damping = W::broadcast(s[MASS_DAMPING] * s[TIME_STEP]);
    m.dt_per_density
        = m.dt / W::environment(scene.materials.data + ((size_t)group * 4 + 2) * E);
    m.top_speed = W::broadcast(s[TOP_SPEED]);
    m.gravity_step = { m.dt * s[GRAVITY_X], m.dt * s[GRAVITY_Y], m.dt * s[GRAVITY_Z] };
    m.centre
        = { W::environment(centre), W::environment(centre + E), W::environment(centre + 2 * E) };
    m.about_rigid = s[DAMP_ABOUT_RIGID] > 0.5f;
    m.fastest = m.travelled = m.margin = W::broadcast(0.0f);
    return m;
}

// Gives every node the velocity that its force adds in a step (not if only `looking`), and
// returns the rigid part of the motion.
template <int L, class Scene>
CODESIGN_INLINE RigidMotion<typename Lanes<L>::F> kick(
    const Scene& scene, const Motion<L>& m, const Forces& forces, bool looking) {
    typedef Lanes<L> W;
    typedef typename W::F F;
    constexpr int C = W::copies;
    const F zero = W::broadcast(0.0f);
    const Vec3<F> none = { zero, zero, zero };
    Moments<F> sums = { none, none, none, zero, zero, zero, zero, zero, zero };
    for (int n = W::first(); n < W::count(scene.node_items); n += W::stride()) {
        const int* node = W::constants(scene.node_order.data, n, 1);
        const float* constants = W::constants(scene.node_constants.data, n, NODE_CONSTANTS);
        Vec3<F> speed = Nodes<L>::load(m.v, node);
        if (!looking) {
            const F per_volume = W::item(constants + C), falls = W::item(constants + 3 * C);
            const Vec3<F> force
                = Nodes<L>::collect(scene, forces, node) + Nodes<L>::load(m.load, node);
            speed = speed + (m.dt_per_density * per_volume) * force + falls * m.gravity_step;
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
    F fastest2 = zero;
    for (int n = W::first(); n < W::count(scene.node_items); n += W::stride()) {
        const int* node = W::constants(scene.node_order.data, n, 1);
        const F free
            = W::item(W::constants(scene.node_constants.data, n, NODE_CONSTANTS) + 2 * C);
        const Vec3<F> at = Nodes<L>::load(m.x, node);
        Vec3<F> speed = Nodes<L>::load(m.v, node);
        Vec3<F> flexing = speed;
        if (m.about_rigid)
            flexing = speed - rigid.velocity - cross(rigid.spin, at - rigid.centre);
        speed = speed - (damping * free) * flexing;
        const F speed2 = dot(speed, speed);
        F slow = one;
        const auto fast = speed2 > m.top_speed * m.top_speed;
        if (any(fast))
            slow = fast ? m.top_speed / root(speed2) : one;
        speed = slow * speed;
        fastest2 = max(fastest2, slow * slow * speed2);
        const Vec3<F> next = at + dt * speed;
        Nodes<L>::store(m.v, node, speed);
        Nodes<L>::store(m.x, node, next);
        Nodes<L>::store(m.ahead, node, next + (slow * m.beta) * flexing);
    }
    m.centre = rigid.centre + dt * rigid.velocity;
    m.fastest = root(fastest2);
    m.travelled = m.travelled + dt * (m.fastest + scene.settings.data[FINGER_SPEED]);
}

template <int L, class Scene>
CODESIGN_INLINE void give_forces(const Scene& scene, int group, int step, Motion<L>& m,
    const Forces& forces, Ledger<L>& ledger) {
    typedef Lanes<L> W;
    const float* s = scene.settings.data;
    Rigid<typename W::F> poses[2];
    place_fingers<L>(scene.motions.data + (size_t)group * MOTION * W::environments,
        s[FRACTION] + step * s[FRACTION_STEP], poses);
    // Contact looks at x + beta v.
    const bool far = any(m.travelled + m.beta * m.fastest > m.margin);
    if (W::somewhere(step == 0 || far)) {
        m.margin = s[CONTACT_SKIN] + 2.0f * m.beta * W::largest(m.fastest);
        m.travelled = W::broadcast(0.0f);
        mark_near<L>(scene, group, m.x, poses, forces, m.margin);
    }
    give_elastic_forces<L>(scene, group, m.ahead, forces);
    give_contact_forces<L>(scene, group, m.x, m.v, poses, forces, ledger);
    W::barrier();
}

// Mean contact force over the steps and final depth, per environment.
template <int L, class Scene>
CODESIGN_INLINE void write_report(const Scene& scene, int group, Ledger<L>& ledger, int steps) {
    typedef Lanes<L> W;
    constexpr int E = W::environments;
    float* report = scene.reports.data + (size_t)group * OBSTACLES * REPORT * E;
    for (int o = 0; o < OBSTACLES; ++o, report += REPORT * E) {
        typename W::F sum[3] = { ledger.impulse[o].x, ledger.impulse[o].y, ledger.impulse[o].z };
        W::total(sum, 3);
        for (int k = 0; k < 3; ++k)
            W::store_environment(report + k * E, (1.0f / steps) * sum[k]);
        W::store_environment(report + 3 * E, W::largest(ledger.deepest[o]));
    }
}

// All substeps of one advance for one group of environments.
template <int L, class Scene> CODESIGN_INLINE void advance(const Scene& scene, int group) {
    typedef Lanes<L> W;
    constexpr int E = W::environments;
    const int steps = int(scene.settings.data[SUBSTEPS]);
    const Forces forces = no_forces<L>(scene, group);
    Motion<L> motion = start<L>(scene, group);
    Ledger<L> ledger = {};
    // Positions or velocities may have been set since the last advance: look ahead first.
    for (int step = -1; step < steps; ++step) {
        const bool looking = step < 0;
        if (!looking)
            give_forces<L>(scene, group, step, motion, forces, ledger);
        const auto rigid = kick<L>(scene, motion, forces, looking);
        move<L>(scene, motion, rigid, looking);
    }
    float* centre = scene.centres.data + (size_t)group * 3 * E;
    W::store_environment(centre, motion.centre.x);
    W::store_environment(centre + E, motion.centre.y);
    W::store_environment(centre + 2 * E, motion.centre.z);
    write_report<L>(scene, group, ledger, steps);
}

}  // namespace codesign
