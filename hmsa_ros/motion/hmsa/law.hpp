// Hyperelastic laws in units of the shear modulus at small strain. A law is its force over any
// scalar, and its energy; derivatives come from Dual. It reads its constants from those of a packed
// material (hmsa_ros/model/law.py). Where there is no energy, the force is not a number.
#pragma once
#include "dual.hpp"

namespace hmsa {
template <class R> struct Gent {
    // psi = -(J/2) ln(1 - (I1 - 3)/J), A. N. Gent, Rubber Chem. Technol. 69, 59 (1996).
    R i_j;  // 1/J_lim; 0 is neo-Hookean
    void read(int lane, const double *c) { set(i_j, lane, c[0]); }
    void seed(int constant, int j)  // as the parameter j
    {
        if (constant == 0)
            i_j.d[j] = 1;
    }
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
    // b (I2 - 3) + sum a_k (I1 - 3)^k: Mooney-Rivlin, Yeoh, Arruda-Boyce.
    R c[6];
    void read(int lane, const double *from)
    {
        for (int i = 0; i < 6; i++)
            set(c[i], lane, from[i]);
    }
    template <class S> HMSA_INLINE S force(const S &l) const
    {
        // Free of cancellation near l = 1.
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

template <class R> struct Ogden {
    // sum mu/a (l^a + 2 l^(-a/2) - 3), R. W. Ogden, Proc. R. Soc. Lond. A 326, 565 (1972).
    const double *terms;
    void read(int, const double *c) { terms = c; }
    int count() const { return int(terms[0]); }
    template <class S> HMSA_INLINE S force(const S &l) const
    {
        S sum = 0.0 * positive(l);
        for (int i = 0; i < count(); i++) {
            const double mu = terms[1 + 2 * i], a = terms[2 + 2 * i];
            const S low = power(l, -0.5 * a), squared = low * low;
            sum = sum + (inverse(squared) - low) * mu;
        }
        return sum * inverse(l);
    }
    double energy(double l) const
    {
        const double logarithm = log(l);
        double total = 0;
        for (int i = 0; i < count(); i++) {
            const double a = terms[2 + 2 * i];
            total += terms[1 + 2 * i] / a * (expm1(a * logarithm) + 2 * expm1(-0.5 * a * logarithm));
        }
        return total;
    }
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
// Beyond the end of a table the force goes on with the slope there, and rises without bound at a
// stop that lies a depth away.
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
        const double u = l - *p;
        double total = 0;
        for (int k = 6; k > 0; k--)
            total = u * (p[1 + k] / k + total);
        return p[1] + total;
    }
};
}  // namespace hmsa
