// Flow rules of viscoelastic branches: the branch state follows w' = speed flow(x), where
// x = psi'(l) - w is the stress over its ratio. A rule contains this function over any scalar, and
// the decay of x at constant stretch as a sum of exponentials. Dual provides derivatives,
// including those by its constants, of type C. Constants are read from those of a branch
// (hmsa/model/creep.py).
#pragma once
#include "dual.hpp"

namespace hmsa {
// Numbers as in hmsa/model/creep.py; and the maximum number of constants of a rule.
enum Flow { maxwell, power_law };
constexpr int flow_constants = 2;

// A sum of exponentials: fractions of the initial value, and decay rates.
struct Fading {
    static constexpr int most = 96;
    int count = 0;
    double share[most], speed[most];
    void add(double a, double b) { share[count] = a, speed[count++] = b; }
};

template <class C> struct PowerLaw {
    // x |x/s|^(m - 1): the flow of J. S. Bergstroem and M. C. Boyce, J. Mech. Phys. Solids 46, 931
    // (1998), without its dependence on the strain of the branch.
    C m, s;
    void read(const double *c)
    {
        for (int i = 0; i < lanes<real<C>>; i++)
            set(m, i, c[0]), set(s, i, c[1]);
    }
    void seed(int constant, int j) { incline(constant == 0 ? m : s, j, 1); }
    template <class S> S operator()(const S &x) const
    {
        constexpr double nothing = 1e-200;  // avoids the logarithm of 0
        const S size = x * inverse(s);
        return x * power(S(size * size + nothing), C(0.5 * (m - 1.0)));
    }
    // Remainder of x after a span of constant force; at most twice x for a negative span.
    double relaxed(double x, double speed, double span) const
    {
        const double p = value(m) - 1, way = x != 0 ? speed * (*this)(x) / x * span : 0;
        return x * min(exp(p > 0 ? -log1p(max(p * way, -0.9)) / p : -way), 2.0);
    }
    // x = x0 (1 + a t)^(-n) is the mean of exponentials whose rates have a Gamma distribution: a
    // sum over their logarithms, accurate to 1e-8. Slow ones count as constant up to a time.
    Fading fading(double x, double speed, double until) const
    {
        constexpr double nothing = 1e-9, deep = 21;
        Fading found;
        const double pace = x != 0 ? speed * (*this)(x) / x : 0;
        const double p = value(m) - 1, a = p * pace, n = 1 / p;
        if (!(p > nothing && a * until > nothing)) {
            found.add(1, pace);
            return found;
        }
        const double step = 6.283185307179586 / (11.4 + 6 * sqrt(n)), middle = log(n);
        const auto depth = [&](double y) { return n * (y - middle) - exp(y) + n; };
        double y = middle, sum = 0;
        while (depth(y) > -deep)
            y += step;
        for (bool last = false; !last && depth(y) > -2 * deep; y -= step) {
            double share = exp(depth(y)), fast = exp(y);
            const double slow = fast * a * until;
            last = found.count + 1 == Fading::most || (y < middle && share * slow * slow < nothing);
            if (last) {
                const double all = 1 - exp(-n * step);
                share /= all, fast *= all / (1 - exp(-(n + 1) * step));
            }
            found.add(share, a * fast);
            sum += share;
        }
        for (int i = 0; i < found.count; i++)
            found.share[i] /= sum;
        return found;
    }
};

// A flow rule, chosen at run time.
template <class C> struct AnyFlow {
    int kind = maxwell;
    PowerLaw<C> power_law_flow{};
    void read(const double *from)
    {
        kind = int(from[0]);
        power_law_flow.read(from + 1);
    }
    void seed(int constant, int j) { power_law_flow.seed(constant, j); }
    // The flow of a nonlinear rule, and the remainder of x after a span of constant force.
    template <class S> HMSA_APART S other(const S &x) const { return power_law_flow(x); }
    double relaxed(double x, double speed, double span) const
    {
        return power_law_flow.relaxed(x, speed, span);
    }
    Fading fading(double x, double speed, double until) const
    {
        if (kind != maxwell)
            return power_law_flow.fading(x, speed, until);
        Fading one;
        one.add(1, speed);
        return one;
    }
};
}  // namespace hmsa
