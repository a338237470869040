// A dielectric elastomer between compliant electrodes, by its capacitance over that at rest, q:
// the work of the charge along q is that of a constant force. The elastomer is a Gent block of
// thickness l = q^-1/2; with dl/dq = -l^3/2 its force is psi'(l) dl/dq, its inertia m(l)
// (dl/dq)^2.
#pragma once
#include "law.hpp"

namespace hmsa {
struct Dielectric {
    double c1;
    Gent<double> law;

    template <class S> static HMSA_INLINE S thickness(const S &q)
    {
        const real<S> l = 1.0 / sqrt(value(positive(q)));
        return through(q, l, real<S>(-0.5 * l * l * l));
    }
    template <class S> S force(const S &q) const
    {
        const S l = thickness(q);
        return law.force(l) * (l * l * l) * -0.5;
    }
    double energy(double q) const { return law.energy(thickness(q)); }
    // 1/M, M'/(2 M), and the factor on the damping at rest, over M.
    template <class S> void inertia(const S &q, S &i_mass, S &falls, S &damps) const
    {
        const S l = thickness(q), q3 = q * q * q, i = inverse(inverse(l * l * l) + c1);
        i_mass = 24.0 * q3 * i;
        falls = (-0.75 - 0.75 * c1 * i) * inverse(q);
        damps = 6.0 * i;
    }
};
}  // namespace hmsa
