// The linear systems of subsets of the unknowns of one symmetric, positive matrix.
#pragma once
#include <cmath>

namespace hmsa {
constexpr int most_subset = 32;

// Solves for the unknowns that vary, whose right sides `values` contains; others keep theirs.
// Returns the logarithm of the determinant of their part of the matrix.
inline double solve_subset(int count, const double *matrix, const bool *varies, double *values)
{
    int places[most_subset], size = 0;
    // The matrix is lower diag(d) lower^T; `scaled` is lower diag(d).
    double lower[most_subset][most_subset], scaled[most_subset][most_subset], d[most_subset], log_det = 0;
    for (int i = 0; i < count; i++)
        if (varies[i])
            places[size++] = i;
    for (int i = 0; i < size; i++) {
        double left = values[places[i]];
        for (int j = 0; j <= i; j++) {
            double sum = matrix[places[i] * count + places[j]];
            for (int k = 0; k < j; k++)
                sum -= scaled[i][k] * lower[j][k];
            if (j < i)
                scaled[i][j] = sum, lower[i][j] = sum / d[j], left -= lower[i][j] * values[places[j]];
            else
                d[i] = sum;
        }
        values[places[i]] = left;
        log_det += std::log(std::fabs(d[i]));
    }
    for (int i = size - 1; i >= 0; i--) {
        double left = values[places[i]] / d[i];
        for (int k = i + 1; k < size; k++)
            left -= lower[k][i] * values[places[k]];
        values[places[i]] = left;
    }
    return log_det;
}
}  // namespace hmsa
