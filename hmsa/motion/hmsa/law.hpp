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
    // An energy that is written in Python, as tapes for itself and its force: steps of an
    // operation and two registers (hmsa/model/laws/formula.py), as one number.
    enum Operation {
        sum = 1, sum_fixed, product, product_fixed, inverted, defined, logarithm, of_1_more,
        exponential, less_1
    };
    struct Step {
        uint8_t operation, a, b;
    };
    static constexpr int most = 96, part = 128;
    int known;  // numbers that are no results
    int force_at, energy_at, end;
    Step steps[3 * most];
    R constant[most];
    void read(const double *from)
    {
        known = int(from[0]);
        force_at = int(from[1]);
        energy_at = force_at + int(from[2]);
        end = energy_at + int(from[3]);
        from += 4;
        for (int i = 0; i < known; i++)
            set(constant[i], 0, *from++);
        for (int i = 0; i < end; i++) {
            const unsigned code = unsigned(*from++);
            steps[i] = {uint8_t(code / (part * part)), uint8_t(code % part), uint8_t(code / part % part)};
        }
        run(0, force_at, constant, known);
    }
    void seed(int number, int j)
    {
        incline(constant[number], j, 1);
        run(0, force_at, constant, known);
    }
    // A constant for results of type S.
    template <class S> HMSA_INLINE decltype(auto) fixed(int i) const
    {
        if constexpr (std::is_same_v<S, R>)
            return (constant[i]);
        else
            return get(constant[i], 0);
    }
    // Puts the results of steps into registers from a place on; returns the last.
    template <class S> S run(int first, int last, S *x, int place) const
    {
        S *to = x + place;
        for (const Step *step = steps + first; step < steps + last; step++, to++) {
            const S &a = x[step->a], &b = x[step->b];
            const real<S> &at = value(a);
            switch (step->operation) {
            case sum: *to = a + b; break;
            case sum_fixed: *to = a + fixed<S>(step->b); break;
            case product: *to = a * b; break;
            case product_fixed: *to = a * fixed<S>(step->b); break;
            case inverted: *to = inverse(a); break;
            case defined: *to = value(b) > 0 ? a : S(a * __builtin_nan("")); break;
            case logarithm: *to = through(a, log(at), 1.0 / at); break;
            case of_1_more: *to = through(a, log1p(at), 1.0 / (1.0 + at)); break;
            case exponential: *to = exp(a); break;
            default: *to = through(a, expm1(at), exp(at));
            }
        }
        return to[-1];
    }
    template <class S> S ran(int first, int last, const S &l) const
    {
        // Without cancellation near l = 1.
        const S e = l - 1.0, i_l = inverse(positive(l)), cubic = 2.0 * e * (l * l + l + 1.0) * i_l * i_l;
        const real<S> across = sqrt(value(i_l));
        S x[most];
        x[0] = l, x[1] = through(l, across, real<S>(-0.5 * across * value(i_l))), x[2] = i_l;
        x[3] = e * e * (l + 2.0) * i_l, x[4] = e * e * (2.0 * l + 1.0) * i_l * i_l;
        x[5] = cubic, x[6] = cubic * i_l;
        return run(first, last, x, 7);
    }
    template <class S> S force(const S &l) const { return ran(force_at, energy_at, l); }
    double energy(double l) const { return ran(energy_at, end, l); }
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
