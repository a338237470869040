// Fits of samples for the judge: an offset with a drift or creep, and decaying sinusoids (fit.py).
#include "bind.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

namespace {

using Array = std::vector<double>;
// Four numbers at once: sums do not depend on the instructions of a machine.
using Four = double __attribute__((vector_size(32)));

constexpr double pi = 3.14159265358979323846;
constexpr double infinity = std::numeric_limits<double>::infinity();

// Fewer samples, or fewer periods, do not determine the vibration.
constexpr int fewest = 8;
constexpr double shortest = 1.4;
// Sampling interval, in periods, below which the vibration is resolved; otherwise it is aliased,
// and the search stays near the frequency of the model.
constexpr double dense_to = 0.4;
constexpr double near_from = 0.75, near_to = 1.3, middle_from = 0.6, middle_to = 1.6,
                 wide_from = 0.3, wide_to = 2.5;
// Periods above which a frequency far from the model's, and a drift at all, can be identified.
constexpr double far = 3.0, drifts_from = 3.0;
// Frequencies to try per 1/span of the range, and around the best one, and number of refinements.
constexpr int tried = 3, refined = 7, rounds = 3;
// Decays to try, relative to the largest one, which is a multiple of the model's, within limits
// given as a ratio to the frequency.
constexpr double decays[] = {0.0, 0.07, 0.15, 0.27, 0.4, 0.6, 1.0};
constexpr double faster = 2.0, least_decay = 0.1, most_decay = 0.7;
// Maximum decay of a vibration before the first sample, in time constants.
constexpr double longest = 20.0;
// Time constants of exponential creep, in spans, and fraction of the squares that it has to leave.
constexpr double creeps[] = {0.07, 0.12, 0.205, 0.35, 0.6, 1.025, 1.75, 3.0};
constexpr double explained = 0.5;
// Creep is preferred to a further mode unless it leaves this many times the squares.
constexpr double creep_first = 1.5;
// Range of further modes, relative to the frequency of the model; their fewest cycles in the span;
// decays to try relative to the frequency of the model, and the largest relative to their own.
constexpr double modes_from = 0.5, modes_to = 8.0, fewest_cycles = 3.0;
constexpr double mode_decays[] = {0.0, 0.1, 0.3};
constexpr double mode_damped = 0.12;
// Decay, relative to the frequency of the model, of what may be hidden in noise. What decays
// faster is gone after a few samples: so many, in energy.
constexpr double hidden_decay = 0.3, few_samples = 10.0;
// A further mode reduces the squares by this many variances of the residual, and by those of a
// search in noise.
constexpr double certain = 14.0;
// Part of a sinusoid that others do not explain, below which it is no further mode.
constexpr double own_part = 0.3;
constexpr int most_modes = 3;
// Steps to improve all frequencies and decays together.
constexpr int steps_of_newton = 8;
// Number of fitted values: offset, drift, two of the sinusoid, frequency and decay.
constexpr int fitted = 6, fitted_mode = 4;
// Phase between samples, at the highest frequency, below which they show the range of a motion, and
// the range of normal noise in a period in standard deviations.
constexpr double close_to = 1.5, peaks = 7.0;
// Maximum number of possible fits, of one sinusoid and of several.
constexpr size_t most_possible = 200, most_summed = 24;
// Ratio of standard deviation to median absolute deviation of normal noise.
constexpr double normal = 1.4826;
// Maximum correlation of neighbouring samples.
constexpr double most_alike = 0.98;

double square(double x) { return x * x; }

double dot(const double *a, const double *b, int count)
{
    Four sum{};
    int i = 0;
    for (; i + 4 <= count; i += 4) {
        Four x, y;
        __builtin_memcpy(&x, a + i, sizeof x);
        __builtin_memcpy(&y, b + i, sizeof y);
        sum += x * y;
    }
    double found = (sum[0] + sum[1]) + (sum[2] + sum[3]);
    for (; i < count; ++i) {
        found += a[i] * b[i];
    }
    return found;
}

// Products of a with b and c.
void dots(const double *a, const double *b, const double *c, int count, double &with_b,
          double &with_c)
{
    Four sums[2]{};
    int i = 0;
    for (; i + 4 <= count; i += 4) {
        Four x, y, z;
        __builtin_memcpy(&x, a + i, sizeof x);
        __builtin_memcpy(&y, b + i, sizeof y);
        __builtin_memcpy(&z, c + i, sizeof z);
        sums[0] += x * y;
        sums[1] += x * z;
    }
    with_b = (sums[0][0] + sums[0][1]) + (sums[0][2] + sums[0][3]);
    with_c = (sums[1][0] + sums[1][1]) + (sums[1][2] + sums[1][3]);
    for (; i < count; ++i) {
        with_b += a[i] * b[i];
        with_c += a[i] * c[i];
    }
}

double median(Array values)
{
    const size_t middle = values.size() / 2;
    std::nth_element(values.begin(), values.begin() + middle, values.end());
    if (values.size() % 2) {
        return values[middle];
    }
    const double lower = *std::max_element(values.begin(), values.begin() + middle);
    return 0.5 * (lower + values[middle]);
}

// Quantile of Student's t at a probability above 0.5, whose normal quantile is z. Degrees of
// freedom, at least 1, are rounded down below 3; the expansion is 26.7.5 of Abramowitz and Stegun.
double quantile(double freedom, double probability, double z)
{
    const double share = 2.0 * probability - 1.0, z2 = z * z;
    if (freedom < 2.0) {
        return std::tan(0.5 * pi * share);
    }
    if (freedom < 3.0) {
        return share * std::sqrt(2.0 / (1.0 - share * share));
    }
    const double terms[] = {
        z * (z2 + 1.0) / 4.0, z * ((5.0 * z2 + 16.0) * z2 + 3.0) / 96.0,
        z * (((3.0 * z2 + 19.0) * z2 + 17.0) * z2 - 15.0) / 384.0,
        z * ((((79.0 * z2 + 776.0) * z2 + 1482.0) * z2 - 1920.0) * z2 - 945.0) / 92160.0};
    double found = z, power = 1.0;
    for (double term : terms) {
        power *= freedom;
        found += term / power;
    }
    return found;
}

// Number of samples per independent one: 1 for white noise.
double together(const Array &left, int values)
{
    const int count = int(left.size());
    const double size = dot(left.data(), left.data(), count);
    if (size <= 0.0) {
        return 1.0;
    }
    const auto alike = [&](int lag) {
        return dot(left.data() + lag, left.data(), count - lag) / size;
    };
    double total = 1.0, summed = 1.0, next = alike(1);
    if (next > 2.0 / std::sqrt(double(count))) {
        // Compensate for the part that the fit has removed.
        next = std::min(next + (1.0 + values * next) / count, most_alike);
        total = (1.0 + next) / (1.0 - next);
    }
    for (int lag = 1; lag <= count / 4; ++lag) {
        const double share = alike(lag);
        if (share <= 0.0) {
            break;
        }
        summed += 2.0 * share;
    }
    return std::max(total, summed);
}

struct Wave {
    double omega, decay, cosine, sine;
    double at(double t) const
    {
        return std::exp(-decay * t) * (cosine * std::cos(omega * t) + sine * std::sin(omega * t));
    }
};

// A fit of a sinusoid; variances are those for unit noise.
struct Solved {
    double omega, decay, squares, cosine, sine, offset, offset_variance, pair_variance;
    int base;  // index of the columns that it is fitted beside
    double part;  // of the sinusoid that those do not explain
    Wave wave() const { return {omega, decay, cosine, sine}; }
};
using Fits = std::vector<Solved>;

const Solved &best_of(const Fits &fits)
{
    return *std::min_element(fits.begin(), fits.end(), [](const Solved &a, const Solved &b) {
        return a.squares < b.squares;
    });
}

// Samples, and orthonormal columns that are fitted beside a sinusoid: an offset first.
struct Base {
    const Array *time, *values;
    std::vector<Array> columns;
    std::vector<Array> triangle;  // of each column, its parts along the columns up to itself
    Array middle;  // the offset in the middle as a function of the coordinates
    Array left;  // what remains of the values
    Array along;  // coordinates of the values
    double squares;

    Base(const Array &t, const Array &y) : time(&t), values(&y)
    {
        const double level = 1.0 / std::sqrt(double(t.size()));
        columns.push_back(Array(t.size(), level));
        triangle.push_back({1.0 / level});
        middle.push_back(level);
        left = y;
        take(0);
    }
    int count() const { return int(time->size()); }
    // Add a column; one that the others explain is left out.
    bool add(Array column)
    {
        const double before = std::sqrt(dot(column.data(), column.data(), count()));
        Array parts(columns.size() + 1, 0.0);
        for (int round = 0; round < 2; ++round) {
            for (size_t c = 0; c < columns.size(); ++c) {
                const double part = dot(column.data(), columns[c].data(), count());
                parts[c] += part;
                for (int i = 0; i < count(); ++i) {
                    column[i] -= part * columns[c][i];
                }
            }
        }
        const double size = std::sqrt(dot(column.data(), column.data(), count()));
        if (!(size > 1e-7 * before)) {
            return false;
        }
        double shift = 0.0;
        for (size_t c = 0; c < columns.size(); ++c) {
            shift -= middle[c] * parts[c] / size;
        }
        for (double &x : column) {
            x /= size;
        }
        parts.back() = size;
        columns.push_back(std::move(column));
        triangle.push_back(std::move(parts));
        middle.push_back(shift);
        take(columns.size() - 1);
        return true;
    }
    // Add a drift without its mean over time, which belongs to the offset.
    void add_drift(Array drift)
    {
        const Array &t = *time;
        double mean = 0.0;
        for (int i = 1; i < count(); ++i) {
            mean += 0.5 * (drift[i] + drift[i - 1]) * (t[i] - t[i - 1]);
        }
        mean /= t.back() - t.front();
        for (double &x : drift) {
            x -= mean;
        }
        add(std::move(drift));
    }
    void add_wave(double omega, double decay, bool steep = false)
    {
        const Array &t = *time;
        Array cosine(count()), sine(count());
        for (int i = 0; i < count(); ++i) {
            const double size = (steep ? t[i] : 1.0) * std::exp(-decay * t[i]);
            cosine[i] = size * std::cos(omega * t[i]);
            sine[i] = size * std::sin(omega * t[i]);
        }
        add(std::move(cosine));
        add(std::move(sine));
    }
    // Coefficients of all columns as they were added, from coordinates.
    Array coefficients(Array coordinates) const
    {
        for (size_t c = columns.size(); c-- > 0;) {
            coordinates[c] /= triangle[c][c];
            for (size_t b = 0; b < c; ++b) {
                coordinates[b] -= triangle[c][b] * coordinates[c];
            }
        }
        return coordinates;
    }
    // Variance of a linear function of the coefficients, for unit noise.
    double variance(const Array &of) const
    {
        Array found(columns.size());
        double sum = 0.0;
        for (size_t c = 0; c < columns.size(); ++c) {
            double rest = of[c];
            for (size_t b = 0; b < c; ++b) {
                rest -= triangle[c][b] * found[b];
            }
            found[c] = rest / triangle[c][c];
            sum += square(found[c]);
        }
        return sum;
    }
    // Coordinates of the values without a wave.
    Array without(const Wave &wave) const
    {
        const Array &t = *time;
        Array rest(count()), found(columns.size());
        for (int i = 0; i < count(); ++i) {
            rest[i] = (*values)[i] - wave.at(t[i]);
        }
        for (size_t c = 0; c < columns.size(); ++c) {
            found[c] = dot(rest.data(), columns[c].data(), count());
        }
        return found;
    }
    // Residuals of a wave with the best values of the columns.
    Array residuals(const Wave &wave) const
    {
        const Array &t = *time;
        Array rest(count());
        for (int i = 0; i < count(); ++i) {
            rest[i] = (*values)[i] - wave.at(t[i]);
        }
        for (const Array &column : columns) {
            const double part = dot(rest.data(), column.data(), count());
            for (int i = 0; i < count(); ++i) {
                rest[i] -= part * column[i];
            }
        }
        return rest;
    }

private:
    void take(size_t c)
    {
        const double part = dot(left.data(), columns[c].data(), count());
        along.push_back(part);
        for (int i = 0; i < count(); ++i) {
            left[i] -= part * columns[c][i];
        }
        squares = dot(left.data(), left.data(), count());
    }
};

// Fit sinusoids of a grid of frequencies, with the same spacing, and decays.
void solve(const Base &base, int number, double first, double spacing, int omegas,
           const double *fadings, int faded, double damped, Fits &found)
{
    const int n = base.count(), most = int(base.columns.size()) + 1;
    const Array &t = *base.time;
    // Columns, then what is left of the values, each times each decay, and the decay squared.
    Array weighted(size_t(faded) * (most + 1) * n);
    Array plain(faded);
    for (int j = 0; j < faded; ++j) {
        double *at = &weighted[size_t(j) * (most + 1) * n];
        for (int i = 0; i < n; ++i) {
            at[size_t(most) * n + i] = std::exp(-fadings[j] * t[i]);
        }
        for (int c = 0; c < most; ++c) {
            const Array &column = c + 1 < most ? base.columns[c] : base.left;
            for (int i = 0; i < n; ++i) {
                at[size_t(c) * n + i] = column[i] * at[size_t(most) * n + i];
            }
        }
        plain[j] = 0.0;
        for (int i = 0; i < n; ++i) {
            double &fade = at[size_t(most) * n + i];
            fade *= fade;
            plain[j] += fade;
        }
    }
    Array real(n), imaginary(n), turn_real(n), turn_imaginary(n), double_real(n),
        double_imaginary(n), u(most), v(most);
    for (int i = 0; i < n; ++i) {
        real[i] = std::cos(first * t[i]);
        imaginary[i] = std::sin(first * t[i]);
        turn_real[i] = std::cos(spacing * t[i]);
        turn_imaginary[i] = std::sin(spacing * t[i]);
    }
    for (int k = 0; k < omegas; ++k) {
        const double omega = first + k * spacing;
        for (int i = 0; i < n; ++i) {
            double_real[i] = real[i] * real[i] - imaginary[i] * imaginary[i];
            double_imaginary[i] = 2.0 * real[i] * imaginary[i];
        }
        for (int j = 0; j < faded; ++j) {
            if (fadings[j] > damped * omega) {
                continue;
            }
            const double *at = &weighted[size_t(j) * (most + 1) * n];
            for (int c = 0; c < most; ++c) {
                dots(at + size_t(c) * n, real.data(), imaginary.data(), n, u[c], v[c]);
            }
            double twice_real, twice_imaginary;
            dots(at + size_t(most) * n, double_real.data(), double_imaginary.data(), n,
                 twice_real, twice_imaginary);
            double one = 0.5 * (plain[j] + twice_real), two = 0.5 * (plain[j] - twice_real),
                   cross = 0.5 * twice_imaginary, by_cosine = 0.0, by_sine = 0.0, offset = 0.0,
                   variance = 0.0;
            for (int c = 0; c + 1 < most; ++c) {
                one -= u[c] * u[c];
                two -= v[c] * v[c];
                cross -= u[c] * v[c];
                by_cosine += base.middle[c] * u[c];
                by_sine += base.middle[c] * v[c];
                offset += base.middle[c] * base.along[c];
                variance += square(base.middle[c]);
            }
            const double determinant = std::max(
                one * two - cross * cross, 1e-12 * square(plain[j]));
            const double a = (two * u[most - 1] - cross * v[most - 1]) / determinant,
                         b = (one * v[most - 1] - cross * u[most - 1]) / determinant;
            const double half = 0.5 * (one + two),
                         apart = std::sqrt(0.25 * square(one - two) + square(cross));
            found.push_back({
                omega, fadings[j],
                std::max(base.squares - (a * u[most - 1] + b * v[most - 1]), 0.0), a, b,
                offset - by_cosine * a - by_sine * b,
                variance + (two * square(by_cosine) - 2.0 * cross * by_cosine * by_sine
                            + one * square(by_sine)) / determinant,
                (half + apart) / determinant, number,
                plain[j] > 0.0 ? 2.0 * (half - apart) / plain[j] : 0.0});
        }
        for (int i = 0; i < n; ++i) {
            const double x = real[i] * turn_real[i] - imaginary[i] * turn_imaginary[i];
            imaginary[i] = real[i] * turn_imaginary[i] + imaginary[i] * turn_real[i];
            real[i] = x;
        }
    }
}

struct Range {
    double low, high, width, decay, spread;
};

// Add fits around the best one to those of a grid.
void refine(const Base &base, int number, const Range &range, Fits &found,
            const Solved *from = nullptr)
{
    double width = range.width, spread = range.spread;
    Solved best = from ? *from : best_of(found);
    for (int round = 0; round < rounds; ++round) {
        const double low = std::clamp(best.omega - width, range.low, range.high),
                     high = std::clamp(best.omega + width, range.low, range.high);
        double near[5];
        int count = 0;
        for (int j = -2; j <= 2; ++j) {
            const double decay = std::clamp(best.decay + j * spread, 0.0, range.decay);
            if (!count || decay != near[count - 1]) {
                near[count++] = decay;
            }
        }
        Fits more;
        solve(base, number, low, (high - low) / (refined - 1), refined, near, count, infinity,
              more);
        const Solved &now = best_of(more);
        if (now.squares < best.squares) {
            best = now;
        }
        found.insert(found.end(), more.begin(), more.end());
        width *= 2.0 / (refined - 1);
        spread *= 0.5;
    }
}

// Largest peak-to-peak value within a period, of values at increasing times.
double largest(const double *time, const double *values, int count, double begin, double period)
{
    double most = 0.0;
    // A motion within half a period lies in one period of the first or the shifted division.
    for (double from : {begin, begin - 0.5 * period}) {
        double low = infinity, high = -infinity, cell = -1.0;
        for (int i = 0; i < count; ++i) {
            const double now = std::floor((time[i] - from) / period);
            if (now != cell) {
                cell = now;
                low = infinity;
                high = -infinity;
            }
            low = std::min(low, values[i]);
            high = std::max(high, values[i]);
            most = std::max(most, high - low);
        }
    }
    return most;
}

struct Bounded {
    double value, deviation, low, high;
};

struct Settings {
    double frequency, decay, beyond, z, nothing;
    bool creep;
};

struct Found {
    Bounded offset, vibration;
    double noise, usual, independent, resolved;
    std::vector<Wave> waves;  // largest first
    Array swings;
};

// A problem: samples with the modes found so far.
struct Problem {
    const Array &time, &values;
    const Settings &settings;
    double span, periods, interval, period;
    bool dense;
    Range range;
    int omegas;
    Array faded;
    double searched;
    std::vector<Wave> modes;  // besides the sinusoid that is searched
    double creep = 0.0;  // time constant in spans; 0 for a drift

    Problem(const Array &t, const Array &y, const Settings &s) : time(t), values(y), settings(s)
    {
        span = t.back() - t.front();
        period = 2.0 * pi / s.frequency;
        periods = span / period;
        Array gaps(t.size() - 1);
        for (size_t i = 0; i < gaps.size(); ++i) {
            gaps[i] = t[i + 1] - t[i];
        }
        interval = median(std::move(gaps));
        dense = interval < dense_to * period;
        const bool wide = periods >= far;
        range.low = s.frequency * (!dense ? near_from : wide ? wide_from : middle_from);
        range.high = s.frequency * (!dense ? near_to : wide ? wide_to : middle_to);
        // Other frequencies are indistinguishable in the samples.
        range.high = std::min(
            range.high, dense ? 0.9 * pi / interval : range.low + 2.0 * pi / interval);
        omegas = std::max(int((range.high - range.low) * span * tried / (2.0 * pi)), refined);
        fade(std::min({
            std::max(faster * s.decay, least_decay * s.frequency), most_decay * s.frequency,
            longest / std::max(t.front(), interval)}));
        range.width = (range.high - range.low) / (omegas - 1);
        searched = 2.0 * std::log(std::max((range.high - range.low) * span / (2.0 * pi), 1.0));
    }

    Base base() const { return base(creep); }
    // Offset, drift or creep with a time constant, and the modes found.
    Base base(double creep) const
    {
        Base found = bare(creep);
        for (const Wave &mode : modes) {
            found.add_wave(mode.omega, mode.decay);
        }
        return found;
    }
    // The same without the modes.
    Base bare(double creep) const
    {
        Base found(time, values);
        if (creep > 0.0 || periods >= drifts_from) {
            Array drift(time);
            if (creep > 0.0) {
                for (double &x : drift) {
                    x = std::exp(-x / (creep * span));
                }
            }
            found.add_drift(std::move(drift));
        }
        return found;
    }
    // Try decays up to the largest one.
    void fade(double most)
    {
        range.decay = most;
        faded.clear();
        for (double x : decays) {
            faded.push_back(x * most);
        }
        range.spread = faded[1];
    }
    // Search near a mode, found as one of several, in place of the frequency of the model.
    void look_near(size_t number)
    {
        const double omega = modes[number].omega, line = 2.0 * pi / span;
        modes.erase(modes.begin() + long(number));
        range.low = std::max(omega - line, 0.5 * omega);
        range.high = omega + line;
        omegas = 4 * tried + 1;
        range.width = (range.high - range.low) / (omegas - 1);
        fade(std::min(2.0 * mode_damped * omega, longest / std::max(time.front(), interval)));
        searched = 2.0 * std::log(std::max((top() - range.low) * span / (2.0 * pi), 1.0));
    }
    void coarse(const Base &from, int number, Fits &fits) const
    {
        solve(from, number, range.low, range.width, omegas, faded.data(), int(faded.size()),
              infinity, fits);
    }
    // Highest frequency at which vibration is looked for, in rad/s.
    double top() const
    {
        return dense ? std::max(std::min(modes_to * settings.frequency, 0.9 * pi / interval),
                                range.high) : range.high;
    }
};

// The modes with their coefficients, beside a sinusoid.
std::vector<Wave> waves_of(const Problem &problem, const Base &base, const Wave &own)
{
    std::vector<Wave> found = problem.modes;
    const Array values = base.coefficients(base.without(own));
    size_t place = values.size() - 2 * found.size();
    for (Wave &x : found) {
        x.cosine = values[place++];
        x.sine = values[place++];
    }
    found.push_back(own);
    return found;
}

// Times at which the sum of several waves is evaluated: from 0 on.
Array times_of(const Problem &problem)
{
    const double step = 2.0 * pi / problem.top() / 12.0;
    Array found;
    for (double t = 0.0; t <= problem.time.back() && found.size() < 2000; t += step) {
        found.push_back(t);
    }
    return found;
}

// Peak to peak of a sum of waves: the peak and the trough of two modes may be periods apart.
double swing_of(const std::vector<Wave> &waves, const Array &times, double *contrast = nullptr)
{
    Array sum(times.size(), 0.0);
    const double step = times.size() > 1 ? times[1] : 1.0;
    for (const Wave &x : waves) {
        const double size = std::exp(-x.decay * step), turn_real = size * std::cos(x.omega * step),
                     turn_imaginary = size * std::sin(x.omega * step);
        double real = 1.0, imaginary = 0.0;
        for (double &y : sum) {
            y += x.cosine * real + x.sine * imaginary;
            const double next = real * turn_real - imaginary * turn_imaginary;
            imaginary = real * turn_imaginary + imaginary * turn_real;
            real = next;
        }
    }
    const auto [low, high] = std::minmax_element(sum.begin(), sum.end());
    if (contrast) {
        // Times of the two values.
        contrast[0] = times[size_t(low - sum.begin())];
        contrast[1] = times[size_t(high - sum.begin())];
    }
    // Extrema of the parabolas through these and their neighbours.
    const auto extremum = [&](Array::const_iterator x) {
        if (x == sum.begin() || x + 1 == sum.end()) {
            return *x;
        }
        const double bend = x[-1] - 2.0 * x[0] + x[1];
        return bend == 0.0 ? *x : *x - 0.125 * square(x[1] - x[-1]) / bend;
    };
    return extremum(high) - extremum(low);
}

// Peak to peak of a wave in its first period: from its begin or its second extremum to the first.
double swing_of(const Wave &wave)
{
    const double ratio = wave.decay / wave.omega, lag = std::atan(ratio),
                 from = std::atan2(wave.sine, wave.cosine), number = std::ceil((lag - from) / pi),
                 first = std::hypot(wave.cosine, wave.sine) * std::cos(lag)
                     * std::exp(-ratio * (number * pi - lag + from));
    return first + std::max(first * std::exp(-pi * ratio),
                            std::fmod(number, 2.0) == 0.0 ? -wave.cosine : wave.cosine);
}

// Deviation of a swing for unit deviation of the coefficients: the maximum over all phases.
double factor_of(const Wave &wave) { return 1.0 + std::exp(-pi * wave.decay / wave.omega); }

double deviation_of_sum(const Problem &problem, double creep, const std::vector<Wave> &waves,
                        const double *contrast)
{
    Base base = problem.bare(creep);
    Array of(base.columns.size(), 0.0);
    for (size_t k = 0; k < waves.size(); ++k) {
        const Wave &x = waves[k];
        // Frequency and decay of the modes are fitted too; the last wave is searched.
        for (bool steep : {false, true}) {
            if (steep && k + 1 == waves.size()) {
                continue;
            }
            const size_t before = base.columns.size();
            base.add_wave(x.omega, x.decay, steep);
            if (base.columns.size() != before + 2) {
                of.resize(base.columns.size(), 0.0);
                continue;
            }
            double parts[2] = {0.0, 0.0};
            for (int side = 0; side < 2; ++side) {
                const double t = contrast[side], sign = side ? 1.0 : -1.0,
                             size = sign * (steep ? t : 1.0) * std::exp(-x.decay * t);
                parts[0] += size * std::cos(x.omega * t);
                parts[1] += size * std::sin(x.omega * t);
            }
            of.push_back(parts[0]);
            of.push_back(parts[1]);
        }
    }
    return std::sqrt(base.variance(of));
}

// The best fit with bounds over all possible fits, each beside one of the bases.
Found bounds(const Problem &problem, const std::vector<Base> &bases, const Array &creep_of,
             const Fits &fits)
{
    const Solved &best = best_of(fits);
    const Settings &settings = problem.settings;
    const int count = int(problem.time.size());
    const int extra = fitted_mode * int(problem.modes.size());
    const Array left = bases[best.base].residuals(best.wave());
    const double alike = together(left, fitted + extra),
                 freedom = std::max(count - fitted - extra, 1),
                 variance = best.squares / freedom;
    // Correlated samples count as fewer.
    const double of_few = std::max(freedom / alike, 1.0),
                 sure = quantile(of_few, 1.0 - settings.beyond, settings.z),
                 scale = variance * alike, searched = problem.searched;
    std::vector<std::pair<double, const Solved *>> possible;
    for (const Solved &x : fits) {
        const double slack = square(sure) + searched - (x.squares - best.squares)
            / std::max(scale, 1e-300);
        if (slack >= 0.0 && (problem.modes.empty() || x.part > 0.1 * own_part || &x == &best)) {
            possible.emplace_back(slack, &x);
        }
    }
    const size_t most = problem.modes.empty() ? most_possible : most_summed;
    if (possible.size() > most) {
        // Without noise many fits equal the best one, which has to stay.
        std::nth_element(possible.begin(), possible.begin() + most, possible.end(),
                         [](const auto &a, const auto &b) { return a.first > b.first; });
        possible.resize(most);
        if (std::none_of(possible.begin(), possible.end(),
                         [&](const auto &x) { return x.second == &best; })) {
            possible.emplace_back(square(sure) + searched, &best);
        }
    }
    Found found;
    found.waves = {best.wave()};
    const double unit = std::sqrt(scale);
    Array times;
    double deviation_of_all = 0.0;
    if (!problem.modes.empty()) {
        times = times_of(problem);
        double contrast[2] = {0.0, 0.0};
        found.waves = waves_of(problem, bases[best.base], best.wave());
        swing_of(found.waves, times, contrast);
        deviation_of_all = deviation_of_sum(
            problem, creep_of[best.base], found.waves, contrast);
    }
    found.offset = {best.offset, unit * std::sqrt(best.offset_variance), infinity, -infinity};
    found.vibration = {0.0, 0.0, infinity, -infinity};
    // A vibration found only by the search is not significant, but possible. The more certain it
    // is, the fewer frequencies compete with its own.
    const double shown = (bases[best.base].squares - best.squares) / std::max(scale, 1e-300),
                 rivals = searched * std::min((certain + searched) / std::max(shown, 1e-300), 1.0);
    for (const auto &[slack, x] : possible) {
        const double reach = std::sqrt(std::max(slack - searched + rivals, 0.0) * scale),
                     near = std::sqrt(std::max(slack - searched, 0.0) * scale);
        double swing, deviation = std::sqrt(x->pair_variance) * factor_of(x->wave());
        if (problem.modes.empty()) {
            swing = swing_of(x->wave());
        } else {
            swing = swing_of(waves_of(problem, bases[x->base], x->wave()), times);
            deviation = deviation_of_all;
        }
        const double shift = std::sqrt(x->offset_variance);
        if (x == &best) {
            found.vibration.value = swing;
            found.vibration.deviation = unit * deviation;
        }
        if (slack >= searched - rivals) {
            found.vibration.low = std::min(found.vibration.low, swing - reach * deviation);
        }
        if (slack >= searched) {
            found.offset.low = std::min(found.offset.low, x->offset - near * shift);
            found.offset.high = std::max(found.offset.high, x->offset + near * shift);
            found.vibration.high = std::max(found.vibration.high, swing + near * deviation);
        }
    }
    found.vibration.low = std::max(found.vibration.low, 0.0);
    found.noise = std::sqrt(variance);
    Array sizes(left);
    for (double &x : sizes) {
        x = std::fabs(x);
    }
    found.usual = normal * median(std::move(sizes)) * std::sqrt(count / freedom);
    found.independent = 1.0 / alike;
    std::vector<std::pair<double, Wave>> order;
    for (const Wave &x : found.waves) {
        order.emplace_back(swing_of(x), x);
    }
    std::sort(order.begin(), order.end(), [](const auto &a, const auto &b) {
        return a.first > b.first;
    });
    found.waves.clear();
    for (const auto &[swing, wave] : order) {
        found.waves.push_back(wave);
        found.swings.push_back(swing);
    }
    found.resolved = problem.top();
    return found;
}

// Improve all waves together by the steps of Gauss and Newton, within a range for the last one, and
// return what is fitted then.
Base polish(const Problem &problem, std::vector<Wave> &waves)
{
    std::vector<Wave> now = waves;
    const auto fitted_to = [&]() {
        Base base = problem.bare(problem.creep);
        for (const Wave &x : now) {
            base.add_wave(x.omega, x.decay);
        }
        return base;
    };
    Base best = fitted_to();
    for (int round = 0; round < steps_of_newton; ++round) {
        Base base = fitted_to();
        const size_t straight = base.columns.size() - 2 * now.size();
        if (straight > 2 || base.squares > best.squares) {
            break;
        }
        best = base;
        const Array own = base.coefficients(base.along);
        for (size_t k = 0; k < now.size(); ++k) {
            now[k].cosine = own[straight + 2 * k];
            now[k].sine = own[straight + 2 * k + 1];
        }
        waves = now;
        for (const Wave &x : now) {
            base.add_wave(x.omega, x.decay, true);
        }
        if (base.columns.size() != straight + 4 * now.size()) {
            break;
        }
        const Array all = base.coefficients(base.along);
        for (size_t k = 0; k < now.size(); ++k) {
            // A change of the complex rate: (p - iq) / (c - is).
            const double c = now[k].cosine, s = now[k].sine,
                         p = all[straight + 2 * (now.size() + k)],
                         q = all[straight + 2 * (now.size() + k) + 1],
                         size = std::max(c * c + s * s, 1e-300), line = 2.0 * pi / problem.span,
                         most = 0.5 * line;
            const bool last = k + 1 == now.size();
            now[k].decay = std::clamp(
                now[k].decay - std::clamp((p * c + q * s) / size, -most, most), 0.0,
                last ? problem.range.decay : mode_damped * 2.0 * now[k].omega);
            now[k].omega = std::clamp(
                now[k].omega + std::clamp((p * s - q * c) / size, -most, most),
                last ? problem.range.low : fewest_cycles * line,
                last ? problem.range.high : problem.top());
        }
    }
    return best;
}

// Fit the primary sinusoid beside the modes of a problem.
Fits primary(const Problem &problem, const Base &base)
{
    Fits fits;
    problem.coarse(base, 0, fits);
    refine(base, 0, problem.range, fits);
    return fits;
}

// Fits with each time constant of creep, all of them coarse and those near the best one refined.
struct Creeping {
    std::vector<Base> bases;
    Fits fits;

    explicit Creeping(const Problem &problem)
    {
        Fits coarse;
        for (double x : creeps) {
            bases.push_back(problem.base(x));
            problem.coarse(bases.back(), int(bases.size()) - 1, coarse);
        }
        fits = coarse;
        const int place = best_of(coarse).base, count = int(bases.size());
        for (int k = std::max(place - 1, 0); k < std::min(place + 2, count); ++k) {
            const Solved *from = nullptr;
            for (const Solved &x : coarse) {
                if (x.base == k && !(from && from->squares <= x.squares)) {
                    from = &x;
                }
            }
            refine(bases[k], k, problem.range, fits, from);
        }
    }
};

// Further sinusoids in what remains beside a fit.
struct Remainder {
    Base base;  // with the sinusoid of that fit
    Fits fits;
    double variance, alike, looked;
    int freedom;
    Range range;

    Remainder(const Problem &problem, const Base &beside, const Solved &best) : base(beside)
    {
        const Settings &settings = problem.settings;
        const int modes = int(problem.modes.size()) + 1, values = fitted + fitted_mode * modes;
        freedom = base.count() - values;
        const double low = std::max(modes_from * settings.frequency,
                                    fewest_cycles * 2.0 * pi / problem.span),
                     high = problem.top();
        if (!problem.dense || freedom < fewest || !(high > low)
            || best.squares <= base.count() * square(settings.nothing)) {
            return;
        }
        base.add_wave(best.omega, best.decay);
        double steps[3];
        int many = 0;
        for (double x : mode_decays) {
            const double decay = std::min(x * settings.frequency, problem.range.decay);
            if (!many || decay > steps[many - 1]) {
                steps[many++] = decay;
            }
        }
        const double cycles = (high - low) * problem.span / (2.0 * pi);
        const int omegas = std::max(int(cycles * tried), refined);
        looked = 2.0 * std::log(std::max(cycles, 1.0));
        range = {low, high, (high - low) / (omegas - 1), mode_damped * high,
                 0.05 * settings.frequency};
        solve(base, best.base, low, range.width, omegas, steps, many, mode_damped, fits);
        drop_explained();
        if (fits.empty()) {
            return;
        }
        const Solved start = best_of(fits);
        refine(base, best.base, range, fits, &start);
        drop_explained();
        const Solved &mode = best_of(fits);
        variance = mode.squares / freedom;
        alike = together(base.residuals(mode.wave()), values);
    }
    // Whether one would be certain if the noise were white.
    bool may_show() const
    {
        return !fits.empty()
            && base.squares - best_of(fits).squares > (certain + looked) * variance;
    }
    // Whether one is certain, by what remains beside all waves.
    bool shown_by(const Base &all) const
    {
        return base.squares - all.squares > (certain + looked) * all.squares / freedom * together(
            all.left, all.count() - freedom);
    }
    // How large one may be that is not.
    double hidden(const Settings &settings, double decay) const
    {
        double most = 0.0;
        if (fits.empty()) {
            return most;
        }
        const double least = best_of(fits).squares, scale = variance * alike,
                     sure = quantile(std::max(freedom / alike, 1.0), 1.0 - settings.beyond,
                                     settings.z);
        for (const Solved &x : fits) {
            const double slack = square(sure) - (x.squares - least) / std::max(scale, 1e-300);
            if (slack < 0.0 || x.decay > decay * settings.frequency) {
                continue;
            }
            const double unit = std::sqrt(scale * x.pair_variance) * factor_of(x.wave()),
                         swing = swing_of(x.wave());
            // The largest of a search is that large by noise alone.
            most = std::max(most, std::sqrt(std::max(square(swing) - looked * square(unit), 0.0))
                                      + std::sqrt(slack) * unit);
        }
        return most;
    }

private:
    void drop_explained()
    {
        fits.erase(std::remove_if(fits.begin(), fits.end(), [](const Solved &x) {
            return x.part < own_part; }), fits.end());
    }
};

// Look for further modes, add them to a problem, and return what remains.
Remainder add_modes(Problem &problem, Base &base, Fits &fits)
{
    while (true) {
        const Solved best = best_of(fits);
        Remainder rest(problem, base, best);
        if (int(problem.modes.size()) == most_modes || !rest.may_show()) {
            return rest;
        }
        const Solved mode = best_of(rest.fits);
        // They change each other.
        std::vector<Wave> waves = problem.modes;
        waves.push_back(mode.wave());
        waves.push_back(best.wave());
        const Base with = polish(problem, waves);
        if (!rest.shown_by(with)) {
            return rest;
        }
        if (!(problem.creep > 0.0)) {
            // Creep that is no straight line looks like a slow mode.
            const Creeping creeping(problem);
            const Solved &slow = best_of(creeping.fits);
            if (slow.squares < creep_first * with.squares) {
                problem.creep = creeps[slow.base];
                base = problem.base();
                fits = primary(problem, base);
                continue;
            }
        }
        waves.pop_back();
        problem.modes = waves;
        base = problem.base();
        fits = primary(problem, base);
    }
}

Found fit(const Array &time, const Array &values, const Settings &settings)
{
    Problem problem(time, values, settings);
    Base base = problem.base();
    Fits fits = primary(problem, base);
    Remainder rest = add_modes(problem, base, fits);
    bool changed = false;
    if (!problem.modes.empty()) {
        const Solved &best = best_of(fits);
        const double variance = best.squares / std::max(base.count() - fitted, 1);
        if (base.squares - best.squares < (certain + problem.searched) * variance) {
            // It does not ring at the frequency of the model at all.
            changed = true;
            problem.look_near(0);
            base = problem.base();
            fits = primary(problem, base);
        }
    }
    std::vector<Base> bases{base};
    Array slow{problem.creep};
    if (settings.creep || problem.creep > 0.0) {
        Creeping creeping(problem);
        if (problem.creep > 0.0
            || best_of(creeping.fits).squares <= explained * best_of(fits).squares) {
            changed = true;
            bases = std::move(creeping.bases);
            fits = std::move(creeping.fits);
            slow.assign(std::begin(creeps), std::end(creeps));
        }
    }
    Found found = bounds(problem, bases, slow, fits);
    if (changed) {
        const Solved &best = best_of(fits);
        rest = Remainder(problem, bases[best.base], best);
    }
    Bounded &vibration = found.vibration, &offset = found.offset;
    const double gone = 0.5 / (few_samples * problem.interval * settings.frequency);
    // Two modes may hide, in noise that is not the same, nor that of several modes that are shown.
    const double shown = vibration.low > 0.0 ? vibration.value : 0.0,
                 error = vibration.high - shown,
                 hidden = std::sqrt(2.0) * rest.hidden(settings, std::min(hidden_decay, gone));
    vibration.high = shown + (problem.modes.empty() ? std::max(error, hidden)
                                                    : std::hypot(error, hidden));
    // What samples show themselves, whatever rings: frequencies may change with the amplitude.
    const double between = problem.interval * found.resolved,
                 seen = largest(time.data(), values.data(), base.count(), 0.0, problem.period);
    if (between < close_to) {
        const auto [low, high] = std::minmax_element(values.begin(), values.end());
        const double error = settings.z * found.noise;
        vibration.high = std::min(
            vibration.high, (*high - *low) / std::cos(0.5 * between) + std::sqrt(2.0) * error);
        vibration.low = std::max(
            vibration.low, std::min(seen, vibration.value) - peaks * found.noise);
        offset.high = std::min(offset.high, std::max(*high + error, offset.value));
        offset.low = std::max(offset.low, std::min(*low - error, offset.value));
    }
    return found;
}

// -- bindings ------------------------------------------------------------------------------------

using hmsa::Numbers;
using Four_of = std::tuple<double, double, double, double>;

Array array_of(Numbers from) { return Array(from.data, from.data + from.count); }
Four_of numbers_of(const Bounded &x) { return {x.value, x.deviation, x.low, x.high}; }

// Returns nothing if the samples do not determine the vibration.
std::optional<std::tuple<Four_of, Four_of, std::vector<std::tuple<double, double>>, double, double,
                         double, double>>
fit_samples(Numbers time, Numbers values, double frequency, double decay, double beyond, double z,
            double nothing, int creep)
{
    if (!hmsa::fit(time.count == values.count) || time.count < fewest
        || !((time[time.count - 1] - time[0]) * frequency / (2.0 * pi) >= shortest)) {
        return {};
    }
    const Found found = fit(array_of(time), array_of(values), {
        frequency, decay, beyond, z, nothing, creep != 0});
    std::vector<std::tuple<double, double>> waves;
    for (size_t i = 0; i < found.waves.size(); ++i) {
        waves.emplace_back(found.waves[i].omega, found.swings[i]);
    }
    return std::tuple{numbers_of(found.offset), numbers_of(found.vibration), waves, found.noise,
                      found.usual, found.independent, found.resolved};
}

double largest_motion(hmsa::Places stamps, Numbers values, int64_t begin, int64_t period)
{
    Array since;
    for (int i = 0; i < stamps.count; ++i) {
        since.push_back(double(stamps[i] - begin));
    }
    return largest(since.data(), values.data, std::min(stamps.count, values.count), 0.0,
                   double(std::max(period, int64_t(1))));
}

PyMethodDef methods[] = {
    hmsa::method<fit_samples>("fit"), hmsa::method<largest_motion>("largest"),
    hmsa::method<quantile>("quantile"), {nullptr, nullptr, 0, nullptr}};

PyModuleDef definition{
    PyModuleDef_HEAD_INIT, "_ringing", nullptr, -1, methods, nullptr, nullptr, nullptr, nullptr};

}  // namespace

PyMODINIT_FUNC PyInit__ringing() { return PyModule_Create(&definition); }
