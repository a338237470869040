// Levels of equal duration that rise smoothly from 0 to 1, after which all modes rest.
#pragma once
#include "real.hpp"

namespace hmsa {
constexpr int most_equal = 160, most_rings = 8;

// Of all such levels in linear motion, these have the least sum of squares of their bends, of the
// vibration of ringing modes with an error of their frequencies, and of a band of weak modes.
struct Smooth {
    int levels, rings, band;
    double phase;  // of the first mode in a level
    const double *modes;  // (rings + band, 3): frequency ratio, damping ratio, weight
    double bent;
    double *out;  // (1 + 2 rings, levels): the levels, and changes by unit conditions

    // Effects of the changes of load at the starts of all levels on a mode at the end.
    void effects(const double *mode, double *real, double *imaginary) const
    {
        const double damping = min(mode[1], 1), damped = sqrt(1 - damping * damping);
        double sine, cosine;
        sine_cosine(-phase * mode[0] * damped, sine, cosine);
        const double fades = exp(-phase * mode[0] * damping);
        const double a = fades * cosine, b = fades * sine;
        real[levels] = 1, imaginary[levels] = 0;
        for (int i = levels - 1; i >= 0; i--) {
            real[i] = a * real[i + 1] - b * imaginary[i + 1];
            imaginary[i] = a * imaginary[i + 1] + b * real[i + 1];
        }
    }
    bool operator()() const
    {
        const int n = levels, m = 2 * rings;
        double square[most_equal][most_equal] = {};  // of the free levels, its lower half
        double conditions[2 * most_rings][most_equal + 1], pull[most_equal] = {}, row[2][most_equal + 1];
        const auto penalise = [&](const double *x, double weight) {  // x: changes, the last is 1
            double level[most_equal];
            for (int i = 0; i < n; i++)
                level[i] = weight * (x[i] - x[i + 1]);
            for (int i = 0; i < n; i++) {
                pull[i] -= level[i] * weight * x[n];
                for (int j = 0; j <= i; j++)
                    square[i][j] += level[i] * level[j];
            }
        };
        for (int k = 0; k < rings + band; k++) {
            const double *mode = modes + 3 * k;
            effects(mode, row[0], row[1]);
            for (int part = 0; part < 2; part++) {
                if (k < rings) {
                    for (int i = 0; i <= n; i++) {
                        conditions[2 * k + part][i] = i < n ? row[part][i] - row[part][i + 1] : row[part][n];
                        row[part][i] *= (n - i) * phase;
                    }
                }
                penalise(row[part], mode[2]);
            }
        }
        // Levels before the first are 0, those after the last 1.
        for (int i = -2; i < n; i++)
            for (int j = 0; j < 3; j++) {
                constexpr double bend[3] = {1, -2, 1};
                if (i + j < 0 || i + j >= n)
                    continue;
                for (int l = 0; l < 3; l++) {
                    const double both = bent * bent * bend[j] * bend[l];
                    if (i + l >= n)
                        pull[i + j] -= both;
                    else if (i + l >= 0 && l <= j)
                        square[i + j][i + l] += both;
                }
            }
        if (!factor(&square[0][0], most_equal, n))
            return false;
        // Least squares with Lagrange multipliers.
        double along[2 * most_rings][most_equal], whole[2 * most_rings][2 * most_rings];
        solve(&square[0][0], most_equal, n, pull);
        double largest = 0;
        for (int k = 0; k < m; k++) {
            std::memcpy(along[k], conditions[k], n * sizeof(double));
            solve(&square[0][0], most_equal, n, along[k]);
            for (int j = 0; j <= k; j++)
                whole[k][j] = product(along[k], conditions[j]);
            largest = max(largest, whole[k][k]);
        }
        for (int k = 0; k < m; k++)
            whole[k][k] += alike * largest;
        if (!factor(&whole[0][0], 2 * most_rings, m))
            return false;
        for (int c = 0; c <= m; c++) {
            double multiplier[2 * most_rings];
            for (int k = 0; k < m; k++)
                multiplier[k] = c ? c - 1 == k : -conditions[k][n] - product(pull, conditions[k]);
            solve(&whole[0][0], 2 * most_rings, m, multiplier);
            for (int i = 0; i < n; i++) {
                double x = c ? 0 : pull[i];
                for (int k = 0; k < m; k++)
                    x += multiplier[k] * along[k][i];
                out[c * n + i] = x;
            }
        }
        return true;
    }
    // Frequencies that coincide give equal conditions: what is added to the diagonal, relative.
    static constexpr double alike = 1e-11;
    double product(const double *a, const double *b) const
    {
        double sum = 0;
        for (int i = 0; i < levels; i++)
            sum += a[i] * b[i];
        return sum;
    }
    // Cholesky's decomposition of a symmetric matrix, in its lower half.
    static bool factor(double *a, int width, int n)
    {
        for (int i = 0; i < n; i++)
            for (int j = 0; j <= i; j++) {
                double sum = a[i * width + j];
                for (int k = 0; k < j; k++)
                    sum -= a[i * width + k] * a[j * width + k];
                if (i != j)
                    a[i * width + j] = sum / a[j * width + j];
                else if (sum > 0)
                    a[i * width + i] = sqrt(sum);
                else
                    return false;
            }
        return true;
    }
    static void solve(const double *a, int width, int n, double *x)
    {
        for (int i = 0; i < n; i++) {
            for (int k = 0; k < i; k++)
                x[i] -= a[i * width + k] * x[k];
            x[i] /= a[i * width + i];
        }
        for (int i = n - 1; i >= 0; i--) {
            for (int k = i + 1; k < n; k++)
                x[i] -= a[k * width + i] * x[k];
            x[i] /= a[i * width + i];
        }
    }
};
}  // namespace hmsa
