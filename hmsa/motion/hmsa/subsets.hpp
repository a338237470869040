// The linear systems of subsets of the unknowns of one symmetric, positive matrix.
#pragma once
#include <cmath>

namespace hmsa {
constexpr int most_subset = 32;

// The part of a matrix of the unknowns that vary, as lower diag(d) lower^T.
struct Subset {
    int places[most_subset], size = 0;
    double lower[most_subset][most_subset], d[most_subset];

    Subset(int count, const double *matrix, const bool *varies)
    {
        double scaled[most_subset][most_subset];  // lower diag(d)
        for (int i = 0; i < count; i++)
            if (varies[i])
                places[size++] = i;
        for (int i = 0; i < size; i++)
            for (int j = 0; j <= i; j++) {
                double sum = matrix[places[i] * count + places[j]];
                for (int k = 0; k < j; k++)
                    sum -= scaled[i][k] * lower[j][k];
                if (j < i)
                    scaled[i][j] = sum, lower[i][j] = sum / d[j];
                else
                    d[i] = sum;
            }
    }

    double log_det() const
    {
        double found = 0;
        for (int i = 0; i < size; i++)
            found += std::log(std::fabs(d[i]));
        return found;
    }

    // Solves for the unknowns that vary, whose right sides `values` contains; others keep theirs.
    void solve(double *values) const
    {
        for (int i = 0; i < size; i++)
            for (int j = 0; j < i; j++)
                values[places[i]] -= lower[i][j] * values[places[j]];
        for (int i = size - 1; i >= 0; i--) {
            double left = values[places[i]] / d[i];
            for (int k = i + 1; k < size; k++)
                left -= lower[k][i] * values[places[k]];
            values[places[i]] = left;
        }
    }

    // Adds the inverse with a weight to a matrix, where unknowns vary.
    void add_inverse(double weight, int count, double *out) const
    {
        double inner[most_subset][most_subset];  // inverse of lower
        for (int i = 0; i < size; i++) {
            inner[i][i] = 1;
            for (int j = 0; j < i; j++) {
                double sum = 0;
                for (int k = j; k < i; k++)
                    sum -= lower[i][k] * inner[k][j];
                inner[i][j] = sum;
            }
            for (int j = 0; j <= i; j++)
                for (int k = 0; k <= i; k++)
                    out[places[j] * count + places[k]] += weight * inner[i][j] * inner[i][k] / d[i];
        }
    }
};
}  // namespace hmsa
