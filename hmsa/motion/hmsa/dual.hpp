// A value with its derivatives by N parameters (forward mode). R is a double or lanes.
#pragma once
#include <type_traits>
#include "real.hpp"

namespace hmsa {
template <class R, int N> struct Dual {
    R v;
    R d[N];
    // Copied value by value: after a bytewise copy in halves, a vector cannot be read back at
    // once.
    HMSA_INLINE Dual &operator=(const Dual &x)
    {
        v = x.v;
        for (int i = 0; i < N; i++)
            d[i] = x.d[i];
        return *this;
    }
};
template <class S> struct real_of { using type = S; };
template <class R, int N> struct real_of<Dual<R, N>> { using type = R; };
template <class S> using real = typename real_of<S>::type;
template <class S> constexpr int count_of = 0;
template <class R, int N> constexpr int count_of<Dual<R, N>> = N;

template <class R> HMSA_INLINE const R &value(const R &x) { return x; }
template <class R, int N> HMSA_INLINE const R &value(const Dual<R, N> &x) { return x.v; }

#define HMSA_OP template <class R, int N> HMSA_INLINE Dual<R, N> operator
// Unrolled, since a loop over two would keep them in memory.
#define HMSA_ONE(n, expression) { constexpr int i = n; c.d[i] = expression; }
#define HMSA_EACH(expression) \
    if constexpr (N <= 2) { HMSA_ONE(0, expression) HMSA_ONE(N - 1, expression) } \
    else for (int i = 0; i < N; i++) c.d[i] = expression; \
    return c
HMSA_OP +(const Dual<R, N> &a, const Dual<R, N> &b) { Dual<R, N> c{a.v + b.v, {}}; HMSA_EACH(a.d[i] + b.d[i]); }
HMSA_OP -(const Dual<R, N> &a, const Dual<R, N> &b) { Dual<R, N> c{a.v - b.v, {}}; HMSA_EACH(a.d[i] - b.d[i]); }
HMSA_OP *(const Dual<R, N> &a, const Dual<R, N> &b) { Dual<R, N> c{a.v * b.v, {}}; HMSA_EACH(a.d[i] * b.v + a.v * b.d[i]); }
HMSA_OP -(const Dual<R, N> &a) { Dual<R, N> c{-a.v, {}}; HMSA_EACH(-a.d[i]); }
#undef HMSA_OP
// Operations with a constant of type R, or a literal.
#define HMSA_OP template <class R, int N, class B, class = std::enable_if_t<count_of<B> == 0>> HMSA_INLINE Dual<R, N> operator
HMSA_OP +(const Dual<R, N> &a, const B &b) { Dual<R, N> c{a.v + b, {}}; HMSA_EACH(a.d[i]); }
HMSA_OP +(const B &a, const Dual<R, N> &b) { return b + a; }
HMSA_OP -(const Dual<R, N> &a, const B &b) { Dual<R, N> c{a.v - b, {}}; HMSA_EACH(a.d[i]); }
HMSA_OP -(const B &a, const Dual<R, N> &b) { Dual<R, N> c{a - b.v, {}}; HMSA_EACH(-b.d[i]); }
HMSA_OP *(const Dual<R, N> &a, const B &b) { Dual<R, N> c{a.v * b, {}}; HMSA_EACH(a.d[i] * b); }
HMSA_OP *(const B &a, const Dual<R, N> &b) { return b * a; }
#undef HMSA_OP

// f(x) from its value and slope at x.
template <class R> HMSA_INLINE R through(const R &, const R &f, const R &) { return f; }
template <class R, int N> HMSA_INLINE Dual<R, N> through(const Dual<R, N> &x, const R &f, const R &slope)
{
    Dual<R, N> c{f, {}};
    HMSA_EACH(slope * x.d[i]);
}
#undef HMSA_EACH
template <class R, int N> HMSA_INLINE double get(const Dual<R, N> &x, int i) { return get(x.v, i); }
template <class R, int N> HMSA_INLINE void set(Dual<R, N> &x, int i, double value)
{
    set(x.v, i, value);
    for (R &d : x.d)
        set(d, i, 0);
}
// The derivative by parameter j. For lanes, all share a value, and each has its own parameters.
template <class R, int N> HMSA_INLINE double slope(const Dual<R, N> &x, int j)
{
    return get(x.d[j / lanes<R>], j % lanes<R>);
}
template <class R, int N> HMSA_INLINE void incline(Dual<R, N> &x, int j, double slope)
{
    set(x.d[j / lanes<R>], j % lanes<R>, slope);
}
// A value as its own parameter; and the chain rule for a function of it.
template <class S> HMSA_INLINE S seeded(const real<S> &x)
{
    if constexpr (count_of<S> > 0)
        return S{x, {real<S>{} + 1.0}};
    else
        return x;
}
template <class S, class F> HMSA_INLINE S chained(const F &f, const S &x)
{
    if constexpr (count_of<S> > 0)
        return through(x, f.v, f.d[0]);
    else
        return f;
}
template <class S> HMSA_INLINE S inverse(const S &x)
{
    const real<S> r = 1.0 / value(x);
    if constexpr (count_of<S> > 0)
        return through(x, r, real<S>(-(r * r)));
    else
        return r;
}
template <class R, int N> HMSA_INLINE Dual<R, N> positive(Dual<R, N> x)
{
    x.v = positive(x.v);
    return x;
}
template <class R, int N> HMSA_INLINE Dual<R, N> exp(const Dual<R, N> &x)
{
    const R e = exp(x.v);
    return through(x, e, e);
}
template <class S, class N> HMSA_INLINE S power(const S &x, const N &n)  // x^n, x > 0
{
    if constexpr (count_of<N> > 0)
        return exp(n * through(x, log(x.v), real<S>(1.0 / x.v)));
    else {
        const real<S> y = exp(real<S>(n * log(value(x))));
        if constexpr (count_of<S> > 0)
            return through(x, y, real<S>(n * y / value(x)));
        else
            return y;
    }
}
}  // namespace hmsa
