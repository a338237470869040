// Hyperelastic models in units of the shear modulus at small strain. A model contains its force
// over any scalar, and its energy. Dual provides derivatives, including those by its constants, of
// type R; seed makes one of them the parameter j. Constants are read from a packed material
// (hmsa/model/law.py). Where there is no energy, the force is NaN.
#pragma once
#include "dual.hpp"

namespace hmsa {
template <class R> struct Gent {
    // psi = -(J/2) ln(1 - (I1 - 3)/J), A. N. Gent, Rubber Chem. Technol. 69, 59 (1996).
    R i_j;  // 1/J_lim; 0 is neo-Hookean
    void read(int lane, const double *c) { set(i_j, lane, c[0]); }
    void seed(int, int j) { incline(i_j, j, 1); }
    template <class S> HMSA_INLINE S force(const S &l) const
    {
        const S e = l - 1.0, lg = l - e * e * (l + 2.0) * i_j;
        return e * (l * l + l + 1.0) * inverse(positive(l) * positive(lg));
    }
    double energy(double l) const
    {
        const double strain = (l - 1) * (l - 1) * (l + 2) / positive(l);
        return get(i_j, 0) > 0 ? -0.5 / get(i_j, 0) * log1p(-strain * get(i_j, 0)) : 0.5 * strain;
    }
};

template <class R> struct Polynomial {
    // b (I2 - 3) + sum a_k (I1 - 3)^k: Mooney-Rivlin, Yeoh.
    R c[6];
    void read(int lane, const double *from)
    {
        for (int i = 0; i < 6; i++)
            set(c[i], lane, from[i]);
    }
    void seed(int constant, int j) { incline(c[constant], j, 1); }
    template <class S> HMSA_INLINE S force(const S &l) const
    {
        // Avoids cancellation near l = 1.
        const S i_l = inverse(positive(l)), e = l - 1.0;
        const S half = e * (l * l + l + 1.0) * i_l * i_l, x = e * e * (l + 2.0) * i_l;
        S sum = x * (5.0 * c[5]) + 4.0 * c[4];
        sum = sum * x + 3.0 * c[3];
        sum = sum * x + 2.0 * c[2];
        sum = sum * x + c[1];
        return 2.0 * half * (sum + c[0] * i_l);
    }
    double energy(double l) const
    {
        const double e = (l - 1) * (l - 1), x = e * (l + 2) / positive(l);
        double sum = 0;
        for (int i = 5; i > 0; i--)
            sum = x * (get(c[i], 0) + sum);
        return sum + get(c[0], 0) * e * (2 * l + 1) / (l * l);
    }
};

template <class R> struct ArrudaBoyce : Polynomial<R> {
    // mu sum C_i lambda_m^(2 - 2 i) (I1^i - 3^i), E. M. Arruda and M. C. Boyce, J. Mech. Phys.
    // Solids 41, 389 (1993), expanded as a polynomial in I1 - 3.
    R mu, lambda_m;
    void read(int lane, const double *from)
    {
        set(mu, lane, from[0]);
        set(lambda_m, lane, from[1]);
        expand();
    }
    void seed(int constant, int j)
    {
        incline(constant == 0 ? mu : lambda_m, j, 1);
        expand();
    }
    void expand()
    {
        constexpr double terms[5] = {1. / 2, 1. / 20, 11. / 1050, 19. / 7000, 519. / 673750};
        const R shrinks = inverse(lambda_m * lambda_m);
        R factor = mu;
        for (R &x : this->c)
            x = 0.0 * mu;
        for (int i = 1; i <= 5; i++) {
            double binomial = terms[i - 1];  // times 3^(i - k) and the binomial (i, k)
            for (int k = i; k > 0; k--) {
                this->c[k] = this->c[k] + factor * binomial;
                binomial *= 3.0 * k / (i - k + 1);
            }
            factor = factor * shrinks;
        }
    }
};

template <class R> struct Ogden {
    // sum mu/a (l^a + 2 l^(-a/2) - 3), R. W. Ogden, Proc. R. Soc. Lond. A 326, 565 (1972).
    int count;
    R terms[6];  // mu and a of each term
    void read(int lane, const double *c)
    {
        count = int(c[0]);
        for (int i = 0; i < 2 * count; i++)
            set(terms[i], lane, c[1 + i]);
    }
    void seed(int constant, int j) { incline(terms[constant - 1], j, 1); }
    template <class S> HMSA_INLINE S force(const S &l) const
    {
        S sum = 0.0 * positive(l);
        for (int i = 0; i < count; i++) {
            const S low = power(l, R(-0.5 * terms[2 * i + 1])), squared = low * low;
            sum = sum + (inverse(squared) - low) * terms[2 * i];
        }
        return sum * inverse(l);
    }
    double energy(double l) const
    {
        const double logarithm = log(l);
        double total = 0;
        for (int i = 0; i < count; i++) {
            const double mu = get(terms[2 * i], 0), a = get(terms[2 * i + 1], 0);
            total += mu / a * (expm1(a * logarithm) + 2 * expm1(-0.5 * a * logarithm));
        }
        return total;
    }
};

template <class R> struct Formula {
    // An energy that is written in Python, as programs for itself and its force: steps of an
    // operation and two registers (hmsa/model/laws/formula.py).
    enum Operation { sum = 1, product, inverted, defined, logarithm, of_1_more, exponential, less_1, powered };
    static constexpr int most = 96;
    int known, fixed;  // numbers, and registers of these alone
    const double *force_steps, *energy_steps, *end;
    R constant[most];
    void read(const double *from)
    {
        known = int(from[0]), fixed = known + int(from[1]);
        for (int i = 0; i < known; i++)
            set(constant[i], 0, from[4 + i]);
        const double *steps = from + 4 + known;
        force_steps = steps + 3 * int(from[1]);
        energy_steps = force_steps + 3 * int(from[2]);
        end = energy_steps + 3 * int(from[3]);
        run(steps, force_steps, constant, known);
    }
    void seed(int number, int j)
    {
        incline(constant[number], j, 1);
        run(force_steps - 3 * (fixed - known), force_steps, constant, known);
    }
    // Puts the results of steps into registers from a place on; returns the last.
    template <class S> static S run(const double *step, const double *end, S *x, int place)
    {
        for (; step < end; step += 3, place++) {
            const S &a = x[int(step[1])], &b = x[int(step[2])];
            const real<S> &at = value(a);
            switch (int(step[0])) {
            case sum: x[place] = a + b; break;
            case product: x[place] = a * b; break;
            case inverted: x[place] = inverse(a); break;
            case defined: x[place] = positive(a); break;
            case logarithm: x[place] = through(a, real<S>(log(at)), real<S>(1.0 / at)); break;
            case of_1_more: x[place] = through(a, real<S>(log1p(at)), real<S>(1.0 / (1.0 + at))); break;
            case exponential: x[place] = through(a, real<S>(exp(at)), real<S>(exp(at))); break;
            case less_1: x[place] = through(a, real<S>(expm1(at)), real<S>(exp(at))); break;
            default: x[place] = power(a, b);
            }
        }
        return x[place - 1];
    }
    template <class S> S ran(const double *first, const double *last, const S &l) const
    {
        S x[most];
        for (int i = 0; i < fixed; i++) {
            if constexpr (std::is_same_v<S, R>)
                x[i] = constant[i];
            else
                x[i] = 0.0 * l + get(constant[i], 0);
        }
        // Without cancellation near l = 1.
        const S e = l - 1.0, i_l = inverse(positive(l)), cubic = 2.0 * e * (l * l + l + 1.0) * i_l * i_l;
        const real<S> across = sqrt(value(i_l));
        x[fixed] = l, x[fixed + 1] = through(l, across, real<S>(-0.5 * across * value(i_l)));
        x[fixed + 2] = e * e * (l + 2.0) * i_l, x[fixed + 3] = e * e * (2.0 * l + 1.0) * i_l * i_l;
        x[fixed + 4] = cubic, x[fixed + 5] = cubic * i_l;
        return run(first, last, x, fixed + 6);
    }
    template <class S> S force(const S &l) const { return ran(force_steps, energy_steps, l); }
    double energy(double l) const { return ran(energy_steps, end, l); }
};

// sum c_k u^k, and its derivative by u.
template <int N, class S> HMSA_INLINE S horner(const double *c, const S &u)
{
    S sum = 0.0 * u + c[N];
    for (int k = N - 1; k >= 0; k--)
        sum = sum * u + c[k];
    return sum;
}
template <int N, class S> HMSA_INLINE S horner_slope(const double *c, const S &u)
{
    S sum = 0.0 * u + N * c[N];
    for (int k = N - 1; k >= 1; k--)
        sum = sum * u + k * c[k];
    return sum;
}
// Beyond the end of a table the force continues with the slope there, and increases without bound
// towards a stop at a given depth.
template <class S> HMSA_INLINE S beyond(const S &way, double depth, double force, double stiffness)
{
    return force + stiffness * way * inverse(positive(1.0 - way * (1.0 / depth)));
}
inline double energy_beyond(double way, double depth, double force, double stiffness)
{
    const double share = way / depth;
    if (!(share < 1))
        return __builtin_nan("");
    return force * way - stiffness * depth * depth * (log1p(-share) + share);
}

// Energy within a piece of the force of degree N, from its start, initial energy and coefficients.
template <int N> double energy_within(const double *piece, double way)
{
    double total = 0;
    for (int k = N + 1; k > 0; k--)
        total = way * (piece[1 + k] / k + total);
    return piece[1] + total;
}

template <class R> struct Table {
    // Measured at rest: pieces of the force, of degree 5 in the stretch.
    const double *c;
    void read(int, const double *from) { c = from; }
    const double *first() const { return c + 3; }
    const double *last() const { return c + 3 + 8 * int(c[0]); }
    const double *piece(double l) const
    {
        int low = 0, high = int(c[0]);
        while (high - low > 1) {
            const int middle = (low + high) / 2;
            (l < first()[8 * middle] ? high : low) = middle;
        }
        return first() + 8 * low;
    }
    template <class S> HMSA_INLINE S force(const S &l) const
    {
        const double x = value(l);
        if (!(x > 0))
            return positive(l);
        const double *end = x < *first() ? first() : x > *last() ? last() : nullptr;
        if (end)
            return beyond(l - *end, end == first() ? c[1] : c[2], end[2], end[3]);
        const double *p = piece(x);
        return horner<5>(p + 2, S(l - *p));
    }
    double energy(double l) const
    {
        const double *end = l < *first() ? first() : l > *last() ? last() : nullptr;
        if (end)
            return end[1] + energy_beyond(l - *end, end == first() ? c[1] : c[2], end[2], end[3]);
        const double *p = piece(l);
        return energy_within<5>(p, l - *p);
    }
};
}  // namespace hmsa
