// The equation of motion, defined once for any scalar (Eq. 11 in energy form):
//     m(l) l'' + m'(l) l'^2 / 2 + d l' + psi'(l) = beta
// with stretch l, time in L sqrt(rho/G) and the load beta = Br B/(mu0 G).
#pragma once
#include "dop853.hpp"
#include "flow.hpp"
#include "law.hpp"

namespace hmsa {
// Indices in a packed material, and families of models (hmsa/model/law.py, laws/record.py).
enum Place { kind_at, zeta_at, c1_at, damping_at, lower_at, upper_at, constants_at };
enum Family {
    gent, neo_hookean, polynomial, ogden, table, beam, arruda_boyce, elastica, formula, condensed
};

// Functions of the stretch alone are differentiated by it, and then by the chain rule, unless the
// constants of the model have derivatives, too.
template <class S, class C> using Along = std::conditional_t<
    (count_of<C> > 0 || count_of<S> == 0), S, Dual<real<S>, 1>>;
template <class L, bool direct, class S> HMSA_INLINE decltype(auto) inner(const S &l)
{
    if constexpr (direct || count_of<S> == 0)
        return (l);
    else
        return seeded<L>(value(l));
}
template <bool direct, class L, class S> HMSA_INLINE decltype(auto) outer(const L &f, const S &l)
{
    if constexpr (direct || count_of<S> == 0)
        return (f);
    else
        return chained(f, l);
}

// A block: inertia m = (l^-3 + c1)/6, and a constant damping. C is the type of its constants.
template <class C, template <class> class Law> struct Block {
    static constexpr double rest = 1;
    static constexpr bool direct = count_of<C> > 0, may_bend = false;
    using Bare = Block<double, Law>;  // without derivatives
    real<C> c1;
    C drag;
    Law<C> law;

    void read(int lane, const double *m)
    {
        set(c1, lane, m[c1_at]);
        set(drag, lane, m[damping_at]);
        law.read(lane, m + constants_at);
    }
    void seed(int constant, int j) { law.seed(constant, j); }
    // The acceleration under net(psi'(l)), the load less all elastic forces; optionally also the
    // square of the natural frequency.
    template <class S, class D, class F> HMSA_INLINE S acceleration(
        const S &l, const S &v, const D &damping, const F &net, real<S> *squared = nullptr) const
    {
        using L = Along<S, C>;
        const L &x = inner<L, direct>(l);
        const L x2 = x * x, x4 = x2 * x2, q = inverse(x + x4 * c1);
        const L force = law.force(x), per_mass = 6.0 * x4 * q;
        if constexpr (count_of<S> > 0 && !direct)
            if (squared)
                *squared = force.d[0] * per_mass.v;
        const S &i_mass = outer<direct>(per_mass, l);
        return net(outer<direct>(force, l)) * i_mass
            - (i_mass * damping - outer<direct>(L(1.5 * q), l) * v) * v;
    }
    double energy(double l) const { return law.energy(l); }
    template <class S> S force(const S &l) const { return law.force(l); }
    Dual<double, 1> elastic(double l) const { return law.force(Dual<double, 1>{l, {1}}); }
    double mass(double l) const { return (1 / (l * l * l) + get(c1, 0)) / 6; }
    double shape(double) const { return 1; }  // the damping is this times drag
};

// A clamped beam by the deflection of its tip, odd in it, from tables of degree 7
// (hmsa/model/laws/bending.py, elastica.py): it has its own inertia, and a damping that grows with
// it. The tables of the elastica have functions of its second mode, too.
struct Beam {
    static constexpr int one_mode = 26, two_modes = 66;
    double drag;
    const double *c;
    int width;  // of a piece

    const double *piece(double a) const
    {
        const int i = int((1 - __builtin_sqrt(1 - a / c[1])) * c[3]), last = int(c[0]) - 1;
        return c + 8 + width * (i < 0 ? 0 : i > last ? last : i);
    }
    template <class S> S force(const S &l) const
    {
        const double x = value(l), a = abs(x), sign = x < 0 ? -1 : 1;
        if (!(a >= 0))
            return l;
        const S size = l * sign;
        if (a > c[2])
            return beyond(S(size - c[2]), c[1] - c[2], c[4], c[5]) * sign;
        const double *p = piece(a);
        return horner<7>(p + 2, S(size - *p)) * sign;
    }
    // 1/m, m'/(2 m), and the factor on the damping at rest, over m.
    template <class S> void inertia(const S &l, S &i_mass, S &falls, S &damps) const
    {
        const double x = value(l), a = abs(x), sign = x < 0 ? -1 : 1;
        if (!(a <= c[2])) {
            i_mass = inverse(S(0.0 * l + c[6]));
            falls = 0.0 * l;
            damps = i_mass * c[7];
            return;
        }
        const double *p = piece(a);
        const S u = l * sign - *p;
        i_mass = inverse(horner<7>(p + 10, u));
        falls = horner_slope<7>(p + 10, u) * (0.5 * sign) * i_mass;
        damps = horner<7>(p + 18, u) * i_mass;
    }
    // An even function of a deflection within the tables, and its slope.
    template <class S> struct Even { S value, slope; };
    template <class S> Even<S> even(int number, const S &l) const
    {
        const double x = value(l), a = min(abs(x), c[2]), sign = x < 0 ? -1 : 1;
        const double *p = piece(a), *factors = p + 2 + 8 * number, u = a - *p;
        double f = factors[7], once = 0, twice = 0;
        for (int k = 6; k >= 0; k--) {
            twice = twice * u + once;
            once = once * u + f;
            f = f * u + factors[k];
        }
        if (!(abs(x) <= c[2]))
            once = twice = 0;
        return {through(l, f, sign * once), through(l, sign * once, 2 * twice)};
    }
    // Adds to the acceleration of the first mode what the second does to it, and returns that of
    // the second: their Lagrangian is that of elastica.py, with the position y = l + a/h(0).
    template <class S> S second(const S &l, const S &v, const S &y, const S &rate, const S &net,
        double ratio, double share, double damping, S &acceleration) const
    {
        const double stiffness = c[8 + 3], mass = c[8 + 10];  // of a straight beam
        const double squared = ratio * ratio, drags = 2 * damping * ratio * sqrt(stiffness / mass);
        const Even<S> g = even(3, l), h = even(4, l), square = even(5, l);
        const S e = even(6, l).value, k = even(7, l).value;
        const S a = y - l, a_rate = rate - v;
        S i_mass, falls, damps;
        inertia(l, i_mass, falls, damps);
        const S part = g.value * h.value * share, first = inverse(1.0 - part);
        acceleration = acceleration + first * (
            (g.slope * h.value + g.value * h.slope) * (0.5 * share) * v * v
            + i_mass * share * ((net * g.slope - square.slope * a * (0.5 * stiffness)) * a
                - (e - h.value * k) * a_rate * (drags * mass / squared)));
        return acceleration * (1.0 - h.value)
            + (net * g.value - square.value * a * stiffness) * (squared / mass)
            - h.slope * v * v - (e * v + k * a_rate) * drags;
    }
    double energy(double l) const
    {
        const double a = abs(l), way = a - c[2], inside = min(a, c[2]);
        const double *p = piece(inside), within = energy_within<7>(p, inside - *p);
        return within + (way > 0 ? energy_beyond(way, c[1] - c[2], c[4], c[5]) : 0);
    }
};

// A compressible block whose transverse stretch is in equilibrium: pieces of the force and of six
// times the transverse inertia, about their middles (hmsa/model/compressible.py).
struct Condensed {
    static constexpr int degree = 9, width = 3 + 2 * (degree + 1);
    const double *c;

    const double *piece(double l) const  // null outside the table
    {
        const double *first = c + 2;
        if (!(*first <= l && l <= c[1]))
            return nullptr;
        int low = 0, high = int(c[0]);
        while (high - low > 1) {
            const int middle = (low + high) / 2;
            (l < first[width * middle] ? high : low) = middle;
        }
        return first + width * low;
    }
    template <class S> HMSA_INLINE S force(const S &l) const
    {
        const double *p = piece(value(l));
        return p ? horner<degree>(p + 3, S(l - p[1])) : S(l * __builtin_nan(""));
    }
    // 1/m and m'/(2 m).
    template <class S> void inertia(const S &l, double c1, S &i_mass, S &falls) const
    {
        const double *p = piece(value(l));
        if (!p) {
            i_mass = falls = l * __builtin_nan("");
            return;
        }
        const S u = l - p[1];
        i_mass = 6.0 * inverse(S(horner<degree>(p + 4 + degree, u) + c1));
        falls = horner_slope<degree>(p + 4 + degree, u) * i_mass * (1. / 12);
    }
    double energy(double l) const
    {
        const double *p = piece(l);
        return p ? energy_within<degree>(p + 1, l - p[1]) : __builtin_nan("");
    }
};

// An actuator of any model except Gent, chosen at run time: its steps make calls, those of Gent do
// not. C is the type of the constants.
template <class C> struct AnyOf {
    static constexpr bool direct = count_of<C> > 0, may_bend = true;
    using Bare = AnyOf<double>;
    int kind;
    double rest, c1, drag;
    ArrudaBoyce<C> polynomial_law;
    Ogden<C> ogden_law;
    Formula<C> formula_law;
    Table<double> table_law;
    Beam beam_law;
    Condensed condensed_law;

    void read(int, const double *m)
    {
        kind = int(m[kind_at]), c1 = m[c1_at], drag = m[damping_at];
        rest = kind == beam || kind == elastica ? 0 : 1;
        switch (kind) {
        case polynomial: return polynomial_law.Polynomial<C>::read(0, m + constants_at);
        case arruda_boyce: return polynomial_law.read(0, m + constants_at);
        case ogden: return ogden_law.read(0, m + constants_at);
        case formula: return formula_law.read(m + constants_at);
        case table: return table_law.read(0, m + constants_at);
        case condensed: condensed_law = {m + constants_at}; return;
        default:
            beam_law = {drag, m + constants_at, kind == beam ? Beam::one_mode : Beam::two_modes};
        }
    }
    void seed(int constant, int j)
    {
        switch (kind) {
        case polynomial: return polynomial_law.Polynomial<C>::seed(constant, j);
        case arruda_boyce: return polynomial_law.seed(constant, j);
        case ogden: return ogden_law.seed(constant, j);
        case formula: return formula_law.seed(constant, j);
        }
    }
    template <class F> auto with_law(const F &f) const
    {
        switch (kind) {
        case polynomial:
        case arruda_boyce: return f(polynomial_law);
        case ogden: return f(ogden_law);
        case formula: return f(formula_law);
        case table: return f(table_law);
        case condensed: return f(condensed_law);
        default: return f(beam_law);
        }
    }
    template <class L> HMSA_APART L force(const L &l) const
    {
        return with_law([&](const auto &law) { return L(law.force(l)); });
    }
    double energy(double l) const
    {
        return with_law([&](const auto &law) { return law.energy(l); });
    }
    // 1/m, m'/(2 m), and the factor on the damping at rest, over m.
    template <class L> HMSA_APART void inertia(const L &l, L &i_mass, L &falls, L &damps) const
    {
        if (rest == 0)
            return beam_law.inertia(l, i_mass, falls, damps);
        if (kind == condensed) {
            condensed_law.inertia(l, c1, i_mass, falls);
            damps = i_mass;
            return;
        }
        const L l2 = l * l, l4 = l2 * l2, q = inverse(l + l4 * c1);
        i_mass = 6.0 * l4 * q;
        falls = -1.5 * q;
        damps = i_mass;
    }
    template <class S, class D, class F> HMSA_INLINE S acceleration(
        const S &l, const S &v, const D &damping, const F &net, real<S> *squared = nullptr) const
    {
        using L = Along<S, C>;
        const L &x = inner<L, direct>(l);
        const L pull = force(x);
        L i_mass, falls, damps;
        inertia(x, i_mass, falls, damps);
        if constexpr (count_of<S> > 0 && !direct)
            if (squared)
                *squared = pull.d[0] * i_mass.v;
        return net(outer<direct>(pull, l)) * outer<direct>(i_mass, l)
            - (outer<direct>(damps, l) * damping + outer<direct>(falls, l) * v) * v;
    }
    Dual<double, 1> elastic(double l) const { return force(Dual<double, 1>{l, {1}}); }
    double mass(double l) const
    {
        double i_mass, falls, damps;
        inertia(l, i_mass, falls, damps);
        return 1 / i_mass;
    }
    double shape(double l) const
    {
        double i_mass, falls, damps;
        inertia(l, i_mass, falls, damps);
        return damps / i_mass;
    }
};

using Any = AnyOf<double>;

constexpr int most_branches = 3, most_modes = 3;
// Maximum number of values of a state besides stretch and rate.
constexpr int most_rows = most_branches + 2 * most_modes;
// Rows of a state. Columns of a branch: ratio, 1/time, number and constants of its flow rule, and
// the force that it has followed, from which it continues. After the branches, two rows for each
// secondary mode, which end with its position and its rate: share, frequency ratio, a negative
// number instead of a flow rule, the damping ratio, and the exponent of the stretch at rest with
// which the frequency ratio grows.
enum Column { ratio_at, speed_at, flow_at, follower_at = flow_at + 1 + flow_constants, branch_columns };

// Secondary modes: oscillators about the same rest as the first mode, whose frequencies are in
// proportion to that of small motion of the first mode about its present position, and to a power
// of this. The first of them is the second mode of the elastica, if the actuator is one.
struct Modes {
    int count = 0;
    bool grows = false;  // whether a frequency ratio does
    double share[most_modes] = {}, ratio[most_modes] = {}, damping[most_modes] = {},
        exponent[most_modes] = {};

    void read(const double *rows, int rows_left)
    {
        for (; rows_left > 1; rows_left -= 2, rows += 2 * branch_columns) {
            share[count] = rows[ratio_at];
            ratio[count] = rows[speed_at];
            damping[count] = rows[flow_at + 1];
            exponent[count] = rows[flow_at + 2];
            grows |= exponent[count++] != 0;
        }
    }
    // Changes of positions and rates, in turns, under the load beyond the elastic force. The first
    // two of a state are those of the first mode, those of others start at a place.
    template <class System, class S> HMSA_INLINE void change(
        const System &system, const S &net, const S *state, S *changes, int place) const
    {
        const S *at = state + place;
        S *by = changes + place;
        int k = 0;
        if constexpr (System::may_bend)
            if (system.kind == elastica) {
                by[0] = at[1];
                by[1] = system.beam_law.second(state[0], state[1], at[0], at[1], net, ratio[0],
                    share[0], damping[0], changes[1]);
                if (++k == count)
                    return;
                at += 2, by += 2;
            }
        // z'' = g^2 (f/m + w^2 (l - z)) - 2 d w g z', with the ratio g of the frequency to w.
        constexpr double aside = 1e-5;  // of a central difference
        const double l = value(state[0]), pull = value(net);
        const auto squared = [&](double y) { return abs(system.elastic(y).d[0] / system.mass(y)); };
        const double square = squared(l), light = 1 / system.mass(l), root = sqrt(square);
        double square_slope = 0, light_slope = 0;
        if constexpr (count_of<S> > 0) {
            square_slope = (squared(l + aside) - squared(l - aside)) / (2 * aside);
            light_slope = (1 / system.mass(l + aside) - 1 / system.mass(l - aside)) / (2 * aside);
        }
        const double logarithm = grows ? log(l) : 0;
        for (; k < count; k++, at += 2, by += 2) {
            const double g = exponent[k] != 0 ? ratio[k] * exp(exponent[k] * logarithm) : ratio[k];
            const double beside = l - value(at[0]), rate = value(at[1]);
            const double drag = 2 * damping[k] * root * g, drive = pull * light + square * beside;
            by[0] = at[1];
            by[1] = S{} + (g * g * drive - drag * rate);
            if constexpr (count_of<S> > 0) {
                const double grown = exponent[k] != 0 ? exponent[k] / l : 0;  // of ln g
                const double by_l = g * g * (2 * grown * drive + pull * light_slope + square_slope * beside + square)
                    - drag * rate * (0.5 * square_slope / square + grown);
                for (int c = 0; c < count_of<S>; c++)
                    by[1].d[c] = by_l * state[0].d[c] + g * g * (light * net.d[c] - square * at[0].d[c])
                        - drag * at[1].d[c];
            }
        }
    }
};

// Viscoelastic branches: branch i adds the force ratio (psi'(l) - w), where w follows the elastic
// force, w' = speed flow(psi'(l) - w). C is the type of their constants. The maximum number of
// branches may have any flow rule, fewer are linear.
template <int NB, class C = double> struct Branches {
    static constexpr bool flows = NB == most_branches;
    C ratio[NB + 1] = {}, speed[NB + 1] = {};
    AnyFlow<C> flow[flows ? NB : 1];
    double total = 1, fastest = 0;
    int in_use = NB;
    std::conditional_t<flows, Modes, const char *> modes{};
    HMSA_INLINE int count() const { return flows ? in_use : NB; }
    // Values of a state besides stretch and rate: branches, then modes.
    HMSA_INLINE int rows() const
    {
        if constexpr (flows)
            return in_use + 2 * modes.count;
        else
            return NB;
    }
    void read(const double *from, int rows)
    {
        int count = 0;
        while (count < rows && from[branch_columns * count + flow_at] >= 0)
            count++;
        in_use = count;
        if constexpr (flows)
            modes.read(from + branch_columns * count, rows - count);
        for (int b = 0; b < count; b++, from += branch_columns) {
            ratio[b] = from[ratio_at];
            speed[b] = from[speed_at];
            if constexpr (flows)
                flow[b].read(from + flow_at);
            total += ratio[b];
            fastest = max(fastest, speed[b]);
        }
    }
    template <class S> HMSA_INLINE auto rate(int b, const S &above) const
    {
        if constexpr (flows)
            if (flow[b].kind != maxwell)
                return flow[b].other(above) * speed[b];
        return above * speed[b];
    }
    // Relaxation rate of a branch under a stress over its ratio.
    double pace(int b, double above) const
    {
        above = abs(above) > 1e-12 ? above : 1e-12;
        return rate(b, above) / above;
    }
    // Derivative of the flow rate by the stress over its ratio.
    double tangent(int b, double above) const { return rate(b, Dual<double, 1>{above, {1}}).d[0]; }
    // Stresses of the branches under an elastic force, and the derivatives of their states.
    template <class S, class F> HMSA_INLINE void hold(const S &force, const S *followed, S *by, const F &held) const
    {
        for (int b = 0; b < count(); b++) {
            const S above = force - followed[b];
            held(above * ratio[b]);
            by[b] = rate(b, above);
        }
    }
};
// Number of scalars in a state with branches; an even number if a step loops over them in pairs.
template <int NB> constexpr int rows_of = NB == most_branches ? most_rows : NB;
template <class S, int NB> constexpr int room_of = (count_of<S> <= 1 || lanes<real<S>> > 1) && NB <= 1 ? 2 + NB : (3 + rows_of<NB>) / 2 * 2;
// Blocks have their own code; other models share as much as possible.
template <class System> constexpr bool has_own_code = false;
template <class C, template <class> class Law> constexpr bool has_own_code<Block<C, Law>> = true;
// Calls f with the branches and modes of rows. No branch and one linear branch have their own code,
// unless it would be compiled again for each of many derivatives.
template <class S, class System, class F> auto with_branches(const double *rows, int count, const F &f)
{
    const auto call = [&](auto branches) {
        branches.read(rows, count);
        return f(branches);
    };
    if constexpr (count_of<S> <= 1) {
        if (count == 0)
            return call(Branches<0>{});
        if constexpr (has_own_code<System>)
            if (count == 1 && rows[flow_at] == maxwell)
                return call(Branches<1>{});
    }
    return call(Branches<most_branches>{});
}
// The time derivative of a state: stretch, rate, branch states.
template <int NB, class System, class S, class L> HMSA_INLINE void change(const System &system,
    const Branches<NB> &branches, const S *x, const L &load, S *by, real<S> *squared = nullptr)
{
    by[0] = x[1];
    [[maybe_unused]] S beyond{};  // the elastic force
    by[1] = system.acceleration(x[0], x[1], system.drag, [&](const S &force)
        __attribute__((always_inline)) {
            S net = load - force;
            branches.hold(force, x + 2, by + 2, [&](const S &held)
                __attribute__((always_inline)) { net = net - held; });
            if constexpr (NB == most_branches && lanes<real<S>> == 1)
                if (branches.modes.count)
                    beyond = net;
            return net;
        }, squared);
    if constexpr (NB == most_branches && lanes<real<S>> == 1)
        if (branches.modes.count)
            branches.modes.change(system, beyond, x, by, 2 + branches.count());
}

// Frequency of small undamped motion about a stretch; the growth rate where the force falls.
template <class System> double frequency(const System &system, double l)
{
    return sqrt(abs(system.elastic(l).d[0]) / system.mass(l));
}
template <class System> double critical_zeta(const System &system, const double *m, double l)
{
    return 4 / m[c1_at] * sqrt(system.mass(l) * system.elastic(l).d[0]) / system.shape(l);
}
// Beyond the loads that can be held, the limit on that side. psi' increases between the limits.
template <class System> double equilibrium(const System &system, const double *m, double beta)
{
    double lower = m[lower_at], upper = m[upper_at];
    const double rest = system.rest;
    if (beta > 0) {
        lower = rest;
        if (upper == infinity())
            for (upper = 2; system.elastic(upper).v < beta; upper *= 2) {}
    } else if (beta < 0)
        upper = rest;
    else
        return beta == 0 ? rest : beta;
    double l = 0.5 * (lower + upper);
    for (int i = 0; i < 200; i++) {
        const auto force = system.elastic(l);
        double off = force.v - beta;
        if (off != off)  // rounded onto a limit
            off = beta * infinity();
        if (off > 0)
            upper = l;
        else if (off < 0)
            lower = l;
        else
            return l;
        // Newton's method on ln(force/beta), which a pole at a limit makes nearly linear; on the
        // force itself if it has the other sign or is small.
        const double ratio = force.v / beta;
        const double step = ratio > 1 ? log(ratio) * force.v / force.d[0] : off / force.d[0];
        double next = l - step;
        if (!(lower < next && next < upper))
            next = 0.5 * (lower + upper);
        if (abs(next - l) <= 2e-16 * abs(l))
            return next;
        l = next;
    }
    return l;
}
}  // namespace hmsa
