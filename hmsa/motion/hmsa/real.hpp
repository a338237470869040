// Scalars: a double, or a vector of doubles with one per lane. Only this file distinguishes them.
#pragma once
#include <cstdint>
#include <cstring>
#include <type_traits>

// GCC stops inlining as a unit grows, which doubles the time of a step.
#define HMSA_INLINE inline __attribute__((always_inline))
// For functions called once per integration, kept out of the code of every step.
#define HMSA_APART __attribute__((noinline))

namespace hmsa {
template <class R> constexpr int lanes = sizeof(R) / sizeof(double);
#if defined(__GNUC__) && !defined(HMSA_NO_LANES)
typedef double two __attribute__((vector_size(16)));
typedef double four __attribute__((vector_size(32)));
template <class R> using Pair = std::conditional_t<lanes<R> == 1, two, R>;
#else
template <class R> using Pair = R;
#endif

HMSA_INLINE double get(double x, int) { return x; }
HMSA_INLINE void set(double &x, int, double value) { x = value; }
template <class R> HMSA_INLINE double get(const R &x, int i) { return x[i]; }
template <class R> HMSA_INLINE void set(R &x, int i, double value) { x[i] = value; }

HMSA_INLINE double sqrt(double x) { return __builtin_sqrt(x); }
#ifdef __SSE2__
// GCC 12 compiles a loop over lanes to single square roots.
HMSA_INLINE two sqrt(two x) { return __builtin_ia32_sqrtpd(x); }
HMSA_INLINE four sqrt(four x)
{
    const two low = sqrt(two{x[0], x[1]}), high = sqrt(two{x[2], x[3]});
    return four{low[0], low[1], high[0], high[1]};
}
#else
template <class R> HMSA_INLINE R sqrt(R x)
{
    for (int i = 0; i < lanes<R>; i++)
        x[i] = __builtin_sqrt(x[i]);
    return x;
}
#endif
HMSA_INLINE double abs(double x) { return __builtin_fabs(x); }
HMSA_INLINE double max(double a, double b) { return a > b ? a : b; }
HMSA_INLINE double min(double a, double b) { return a < b ? a : b; }
// Bitwise: with lanes wider than those of the machine, ?: is split up.
template <class R> using bits_of = decltype(R{} < R{});
template <class R> HMSA_INLINE R abs(R x)
{
    return (R)((bits_of<R>)x & (bits_of<R>{} + 0x7fffffffffffffff));
}
HMSA_INLINE double select(bool is, double a, double b) { return is ? a : b; }
template <class R> HMSA_INLINE R select(const bits_of<R> &is, const R &a, const R &b)
{
    return (R)(((bits_of<R>)a & is) | ((bits_of<R>)b & ~is));
}

// NaN where x is not positive: the step control then rejects the step.
HMSA_INLINE double positive(double x) { return x > 0 ? x : __builtin_nan(""); }
// All bits set give NaN.
template <class R> HMSA_INLINE R positive(R x) { return (R)((bits_of<R>)x | ~(x > 0)); }

inline double infinity() { return __builtin_inf(); }
inline bool finite(double x) { return x - x == 0; }

// Own exp and log, accurate to 2 units in the last place: glibc selects versions with fused
// multiply-add at run time, whose results differ between machines.
inline double two_to(int64_t n)
{
    const int64_t bits = (n + 1023) << 52;
    double x;
    std::memcpy(&x, &bits, 8);
    return x;
}
inline double exp(double x)
{
    if (!(x > -700))
        return x - x == 0 || x < 0 ? 0 : x;
    if (!(x < 700))
        return infinity();
    const double n = (x * 1.4426950408889634 + 6755399441055744.0) - 6755399441055744.0;
    const double r = (x - n * 0.693147180369123816490) - n * 1.90821492927058770002e-10;
    const double r2 = r * r, r4 = r2 * r2;  // Taylor to r^13, with |r| <= 0.347
    const double low = (1 + r) + r2 * (1. / 2 + r * (1. / 6));
    const double mid = (1. / 24 + r * (1. / 120)) + r2 * (1. / 720 + r * (1. / 5040));
    const double top = (1. / 40320 + r * (1. / 362880))
        + r2 * (1. / 3628800 + r * (1. / 39916800))
        + r4 * (1. / 479001600 + r * (1. / 6227020800.));
    return (low + r4 * (mid + r4 * top)) * two_to(int64_t(n));
}
inline double log(double x)
{
    if (!(x > 0))
        return x == 0 ? -infinity() : __builtin_nan("");
    if (!(x < infinity()))
        return x;
    int64_t extra = 0;
    if (x < 2.2250738585072014e-308) {
        x *= 18014398509481984.0;
        extra = -54;
    }
    int64_t bits;
    std::memcpy(&bits, &x, 8);
    int64_t n = (bits >> 52) - 1023;
    bits = (bits & 0xfffffffffffffLL) | (1023LL << 52);
    double m;
    std::memcpy(&m, &bits, 8);
    if (m > 1.4142135623730951) {
        m *= 0.5;
        n++;
    }
    n += extra;
    const double s = (m - 1) / (m + 1), z = s * s;  // 2 atanh(s), with |s| <= 0.172
    double sum = 1. / 23;
#pragma GCC unroll 11  // divides while compiling
    for (int k = 21; k >= 1; k -= 2)
        sum = 1. / k + z * sum;
    return n * 0.693147180369123816490 + (2 * s * sum + n * 1.90821492927058770002e-10);
}
inline double log1p(double x)
{
    const double u = 1 + x;
    if (u == 1)
        return x;
    // Restores the part of x that rounding removed from u, after W. Kahan.
    return u < infinity() ? log(u) * (x / (u - 1)) : u;
}
inline double expm1(double x)
{
    if (abs(x) < 0.3) {
        double sum = 1;
        for (int k = 14; k > 1; k--)
            sum = 1 + x / k * sum;
        return x * sum;
    }
    return exp(x) - 1;
}
// Sine and cosine of an angle, reduced by pi/2 in three parts (W. J. Cody, W. Waite, 1980).
inline void sine_cosine(double x, double &sine, double &cosine)
{
    const double n = (x * 0.6366197723675814 + 6755399441055744.0) - 6755399441055744.0;
    const double r = ((x - n * 1.5707963267341256) - n * 6.0771005063039e-11) - n * 2.0222662487959506e-21;
    const double z = r * r;
    double s = 0, c = 0;
    for (int k = 19; k >= 3; k -= 2)
        s = z / (k * (k - 1)) * (1 - s);
    for (int k = 20; k >= 2; k -= 2)
        c = z / (k * (k - 1)) * (1 - c);
    s = r - r * s;
    c = 1 - c;
    const int64_t quarter = int64_t(n) & 3;
    sine = quarter & 1 ? c : s;
    cosine = quarter & 1 ? s : c;
    if (quarter & 2)
        sine = -sine;
    if (quarter == 1 || quarter == 2)
        cosine = -cosine;
}
// Computed once if lanes are equal.
template <class R> inline R exp(R x)
{
    const double at = x[0], first = exp(at);
    for (int i = 0; i < lanes<R>; i++)
        x[i] = x[i] == at ? first : exp(double(x[i]));
    return x;
}
template <class R> inline R log(R x)
{
    const double at = x[0], first = log(at);
    for (int i = 0; i < lanes<R>; i++)
        x[i] = x[i] == at ? first : log(double(x[i]));
    return x;
}
}  // namespace hmsa
