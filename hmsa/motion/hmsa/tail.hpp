// Constant levels that keep an elastomer at rest on its target while its branches relax. Levels
// are those of the amplifier. A lagging field delays the vibration that they leave in the same way,
// so that its bound remains valid.
#pragma once
#include "motion.hpp"

namespace hmsa {
struct Complex {
    double re, im;
};
inline Complex operator+(Complex a, Complex b) { return {a.re + b.re, a.im + b.im}; }
inline Complex operator-(Complex a, Complex b) { return {a.re - b.re, a.im - b.im}; }
inline Complex operator-(Complex a, double b) { return {a.re - b, a.im}; }
inline Complex operator+(Complex a, double b) { return {a.re + b, a.im}; }
inline Complex operator*(Complex a, Complex b) { return {a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re}; }
inline Complex operator*(Complex a, double b) { return {a.re * b, a.im * b}; }
inline Complex operator/(Complex a, Complex b)
{
    const double size = b.re * b.re + b.im * b.im;
    return {(a.re * b.re + a.im * b.im) / size, (a.im * b.re - a.re * b.im) / size};
}
inline double abs(Complex a) { return sqrt(a.re * a.re + a.im * a.im); }
inline Complex exp(Complex a)
{
    double sine, cosine;
    sine_cosine(a.im, sine, cosine);
    const double size = exp(a.re);
    return {size * cosine, size * sine};
}

// Columns of the tail: time, load over that of rest and, at the start, deviation of stretch, rate,
// and field over that of rest.
enum Row { time_column, excess_column, deviation_column, rate_column, field_column, columns };

struct Tail {
    // Vibration due to a pair of levels, in units of slope of the tail times duration^3/mass.
    static constexpr double pair_share = 0.05;
    // Maximum duration of a level of a pair, in half periods, and the phase of a grid period above
    // which there are no pairs.
    static constexpr double longest = 0.5, last_phase = 2.6;
    // Vibration about a single level relative to the drift during it: drift, the vibration after
    // a step of that height to both sides, and a margin.
    static constexpr double single = 3.5;
    static constexpr double forever = 1e15;  // maximum half periods of a single level
    // Half periods for which a branch with an endless decay is simulated.
    static constexpr double endless = 1e6;
    // Time constants after which a decaying term counts as zero.
    static constexpr double faded_phase = 50;
    // Growth of the vibration until its levels fit, and number of bisections on the way back.
    static constexpr double coarser = 3;
    static constexpr int halvings = 5;

    int count;  // number of branches
    const double *rows, *behind;  // (count, branch_columns), and psi' minus branch states (count,)
    double lag, period, until;
    double *out;  // (room, columns)
    int room;
    double stiffness, inertia, frequency, half;
    Complex modes[2];
    // The overstress as it decays on target, as exponentials.
    static constexpr int most_terms = most_branches * Fading::most;
    int terms;
    double held[most_terms], speed[most_terms], excess[most_terms];

    double &at(int row, int column) const { return out[row * columns + column]; }

    template <class System> void set_up(const System &system, double stretch)
    {
        stiffness = system.elastic(stretch).d[0];
        inertia = system.mass(stretch);
        frequency = hmsa::frequency(system, stretch);
        Branches<most_branches> branches;
        branches.read(rows, count);
        // For fast motion branches are springs, for slow motion dampers.
        const double own = system.drag * system.shape(stretch);
        double drag = own;
        for (int i = 0; i < 3; i++) {
            double stiff = stiffness;
            drag = own;
            for (int b = 0; b < count; b++) {
                const double phase = frequency / max(branches.tangent(b, behind[b]), 1e-9 * frequency);
                const double part = branches.ratio[b] * stiffness * phase / (1 + phase * phase);
                stiff += part * phase;
                drag += part / frequency;
            }
            frequency = sqrt(stiff / inertia);
        }
        const double decay = 0.5 * drag / inertia, square = decay * decay - frequency * frequency;
        Complex root = square < 0 ? Complex{0, sqrt(-square)} : Complex{sqrt(square), 0};
        if (abs(root) < 1e-6 * frequency)
            root = {1e-6 * frequency, 0};
        half = 3.141592653589793 / (decay < frequency ? abs(root) : frequency);
        modes[0] = root - decay, modes[1] = Complex{-root.re, -root.im} - decay;
        terms = 0;
        for (int b = 0; b < count; b++) {
            if (branches.flow[b].kind != maxwell)
                until = min(until, endless * half);
            const Fading fading = branches.flow[b].fading(behind[b], branches.speed[b], until);
            for (int i = 0; i < fading.count; i++, terms++) {
                held[terms] = branches.ratio[b] * behind[b] * fading.share[i];
                speed[terms] = fading.speed[i];
                // The amplifier leads, so that the lagging field equals the overstress.
                excess[terms] = held[terms] * (1 - lag * speed[terms]);
            }
        }
    }
    // The remaining tail at a time: its value, and bounds of value and slope.
    void left(double time, double &sum, double &bound, double &steepest) const
    {
        sum = bound = steepest = 0;
        for (int b = 0; b < terms; b++) {
            if (speed[b] * time > faded_phase)
                continue;
            const double part = excess[b] * exp(-speed[b] * time);
            sum += part;
            bound += abs(part);
            steepest += speed[b] * abs(part);
        }
    }
    double bound(double time) const
    {
        double sum, found, steepest;
        left(time, sum, found, steepest);
        return found;
    }
    // Response of a mode, exp(mode t) and ``turned`` after a span, to exp(-speed t).
    static Complex taken(Complex mode, Complex turned, double speed, double span)
    {
        const Complex gap = mode + speed;
        if (abs(gap) * span > 1e-7)
            return (turned - exp(-speed * span)) / gap;
        return turned * span;
    }
    Complex passed(const double *of, Complex mode, Complex turned, double time, double span) const
    {
        Complex sum{0, 0};
        for (int b = 0; b < terms; b++)
            sum = sum + taken(mode, turned, speed[b], span) * (of[b] * exp(-speed[b] * time));
        return sum;
    }
    // Response of a mode to the tail in two spans, in units of a level in one.
    Complex both(Complex mode, Complex turned, double time, double span) const
    {
        const Complex sum = passed(excess, mode, turned, time, span) * turned
            + passed(excess, mode, turned, time + span, span);
        return sum * mode / (turned - 1);
    }
    // Two levels of equal duration between which the oscillator goes from rest to rest: both modes
    // are at rest at the end if a turned once + b once equals their response until then.
    void pair(double time, double span, double &a, double &b) const
    {
        const Complex one = exp(modes[0] * span), other = exp(modes[1] * span);
        const Complex first = both(modes[0], one, time, span);
        const Complex second = both(modes[1], other, time, span);
        const Complex level = (first - second) / (one - other);
        a = level.re, b = (first - level * one).re;
    }
    // Duration in which the tail decreases by a drift: an odd multiple of a half period, so that
    // the ringing of equal steps cancels. The whole remaining tail may be left.
    double single_span(double time, double drift, double rest) const
    {
        const double here = bound(time);
        double low = 0, high = 1, less = -drift, more = -drift;  // differences from the drift
        for (; high < forever; high *= 2) {
            const double later = bound(time + high * half);
            more = here - later - drift;
            if (more > 0)
                break;
            low = high, less = more;
            if (later < rest)
                break;
        }
        for (bool secant = true; high - low > 1; secant = !secant) {
            const double share = secant ? max(0.01, min(0.99, less / (less - more))) : 0.5;
            const double guess = __builtin_floor(low + share * (high - low));
            const double middle = max(low + 1, min(high - 1, guess));
            const double off = here - bound(time + middle * half) - drift;
            (off > 0 ? high : low) = middle;
            (off > 0 ? more : less) = off;
        }
        const double whole = max(low, 1.0);
        const double even = whole - 2 * __builtin_floor(0.5 * whole) == 0;
        double span = half * (whole - even);
        if (period > 0)
            span = max(__builtin_floor(span / period + 0.5), 1.0) * period;
        return span;
    }
    // Number of levels for a ripple, -1 if they do not fit, and their vibration.
    int levels(double ripple, bool counting, double &most) const
    {
        double time = 0;
        int found = 0;
        bool drifting = false;
        most = ripple;
        for (;;) {
            double sum, here, steepest;
            left(time, sum, here, steepest);
            if (found + 2 > room)
                return -1;
            if (time >= until)
                return found;
            if (here <= 0.25 * ripple * stiffness)
                break;
            if (single * steepest * half <= ripple * stiffness || frequency * period > last_phase) {
                const double drift = ripple * stiffness / single;
                // Half of it when starting from rest on target, later about the target.
                const double span = single_span(
                    time, drifting ? drift : 0.5 * drift, 0.25 * ripple * stiffness);
                double later, rest, unused;
                left(time + span, later, rest, unused);
                at(found, time_column) = time;
                at(found, excess_column) = drifting ? 0.5 * (sum + later) : sum;
                most = max(most, single * (here - rest) / stiffness);
                time += span;
                found++;
                drifting = true;
                continue;
            }
            double span = min(cube_root(ripple * inertia / (pair_share * steepest)), longest * half);
            if (period > 0)
                span = max(__builtin_floor(span / period + 1e-9), 1.0) * period;
            if (!counting) {
                at(found, time_column) = time, at(found + 1, time_column) = time + span;
                pair(time, span, at(found, excess_column), at(found + 1, excess_column));
            }
            most = max(most, pair_share * steepest * span * span * span / inertia);
            time += 2 * span;
            found += 2;
        }
        at(found, time_column) = time, at(found, excess_column) = 0;
        return found + 1;
    }
    static double cube_root(double x) { return exp(log(x) / 3); }
    // Deviation, rate and field at the start of the levels, from rest on target.
    void predict(int found) const
    {
        const Complex gap = (modes[0] - modes[1]) * inertia;
        Complex up[2] = {{0, 0}, {0, 0}};
        double field = 0;
        for (int b = 0; b < terms; b++)
            field += held[b];
        for (int i = 0; i < found; i++) {
            at(i, deviation_column) = ((up[0] - up[1]) / gap).re;
            at(i, rate_column) = ((modes[0] * up[0] - modes[1] * up[1]) / gap).re;
            at(i, field_column) = field;
            if (i + 1 == found)
                break;
            const double time = at(i, time_column), level = at(i, excess_column);
            const double span = at(i + 1, time_column) - time, over = field - level;
            for (int j = 0; j < 2; j++) {
                const Complex turned = exp(modes[j] * span);
                up[j] = up[j] * turned + taken(modes[j], turned, 0, span) * level
                    - passed(held, modes[j], turned, time, span);
                if (lag > 0)
                    up[j] = up[j] + taken(modes[j], turned, 1 / lag, span) * over;
            }
            field = level;
            if (lag > 0)
                field += over * exp(-span / lag);
        }
    }
    // While the tail is steep, use pairs of levels, from rest to rest; later single levels as long
    // as the ripple (a peak-to-peak vibration of the stretch) allows, or one as little above it as
    // the room allows. Returns the number of levels, and an upper bound of the vibration.
    int staircase(double ripple, double &most) const
    {
        double fine = ripple, rough = ripple;
        while (levels(rough, true, most) < 0)
            fine = rough, rough *= coarser;
        for (int i = 0; rough > fine && i < halvings; i++) {
            const double middle = sqrt(fine * rough);
            (levels(middle, true, most) < 0 ? fine : rough) = middle;
        }
        const int found = levels(rough, false, most);
        predict(found);
        return found;
    }
};
}  // namespace hmsa
