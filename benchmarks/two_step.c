/*
 * The two-step command (Eq. 13) from rest in plain C, to compare the package with.
 *
 *     two_step RTOL REPEATS < moves
 *
 * A move is a line "start target zeta j_lim c1". Prints beta_p, tau_p and the number of passes
 * for each, and last the time per plan in nanoseconds: minimum and median of REPEATS rounds
 * over all moves.
 *
 * As it stands this is the program one would write: DOP853 (Hairer, Norsett, Wanner, "Solving
 * Ordinary Differential Equations I", sec. II.5), Newton on the load with the derivative from
 * the variational equations, each iteration at full tolerance, the first guess from the energy
 * balance without damping. Choices, by -D:
 *
 *     SECANT    secant method instead of Newton, without variational equations
 *     GUESS=0   guess half way between the two holding loads
 *     GUESS=2   energy balance, reduced by the damping loss of a linear oscillator
 *     COARSE=x  first iteration at tolerance x, the next ones only as fine as useful
 *     CUBICS    land by a Taylor series of third order, and end by cubics through the last two
 *               turning points, without the iteration that would confirm them
 */
#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#ifndef GUESS
#define GUESS 1
#endif

/* Stretch and rate, and their derivatives by the load. */
#ifdef SECANT
typedef double vec __attribute__((vector_size(16)));
#else
typedef double vec __attribute__((vector_size(32)));
#endif

static double zeta, c1, i_j;

static double force(double l)
{
    return (l - 1 / (l * l)) / (1 - (2 / l + l * l - 3) * i_j);
}

static double stiffness(double l)
{
    const double g = 1 - (2 / l + l * l - 3) * i_j;
    const double f = l - 1 / (l * l);
    return (1 + 2 / (l * l * l)) / g + 2 * f * f * i_j / (g * g);
}

static double energy(double l)
{
    return -0.5 / i_j * log1p(-(2 / l + l * l - 3) * i_j);
}

static double frequency(double l)
{
    return sqrt(6 * stiffness(l) / (1 / (l * l * l) + c1));
}

static inline vec derivative(vec y, double beta)
{
    const double l = y[0], v = y[1];
    const double l2 = l * l, l3 = l2 * l;
    const double lg = l - (l - 1) * (l - 1) * (l + 2) * i_j;
    const double inertia = 1 / (1 + c1 * l3);
    const double elastic = l2 * (l3 - 1) / lg;
    const double damping = 3 * zeta * c1 * l2;
    const double a = (6 * (beta * l3 - elastic) - damping * l * v + 1.5 * v * v / l) * inertia;
#ifdef SECANT
    return (vec){v, a};
#else
    const double d_elastic = (5 * l3 * l - 2 * l - elastic * (1 - 3 * (l2 - 1) * i_j)) / lg;
    const double a_l = (6 * (3 * beta * l2 - d_elastic) - 3 * damping * v
        - 1.5 * v * v / l2 - 3 * a * c1 * l2) * inertia;
    const double a_v = (3 * v / l - damping * l) * inertia;
    return (vec){v, a, y[3], a_l * y[2] + a_v * y[3] + 6 * l3 * inertia};
#endif
}

/* One step; returns the error in units of the tolerance, NaN outside the stretch limits. */
static double step(vec y, double beta, double h, double rtol, vec *end, double *start_a)
{
    vec k[12];
    k[0] = derivative(y, beta);
    *start_a = k[0][1];
    k[1] = derivative(y + h * (0.05260015195876773 * k[0]), beta);
    k[2] = derivative(y + h * (0.0197250569845379 * k[0] + 0.0591751709536137 * k[1]), beta);
    k[3] = derivative(y + h * (0.02958758547680685 * k[0] + 0.08876275643042054 * k[2]), beta);
    k[4] = derivative(y + h * (0.2413651341592667 * k[0] - 0.8845494793282861 * k[2]
        + 0.924834003261792 * k[3]), beta);
    k[5] = derivative(y + h * (0.037037037037037035 * k[0] + 0.17082860872947386 * k[3]
        + 0.12546768756682242 * k[4]), beta);
    k[6] = derivative(y + h * (0.037109375 * k[0] + 0.17025221101954405 * k[3]
        + 0.06021653898045596 * k[4] - 0.017578125 * k[5]), beta);
    k[7] = derivative(y + h * (0.03709200011850479 * k[0] + 0.17038392571223998 * k[3]
        + 0.10726203044637328 * k[4] - 0.015319437748624402 * k[5] + 0.008273789163814023 * k[6]
        ), beta);
    k[8] = derivative(y + h * (0.6241109587160757 * k[0] - 3.3608926294469414 * k[3]
        - 0.868219346841726 * k[4] + 27.59209969944671 * k[5] + 20.154067550477894 * k[6]
        - 43.48988418106996 * k[7]), beta);
    k[9] = derivative(y + h * (0.47766253643826434 * k[0] - 2.4881146199716677 * k[3]
        - 0.590290826836843 * k[4] + 21.230051448181193 * k[5] + 15.279233632882423 * k[6]
        - 33.28821096898486 * k[7] - 0.020331201708508627 * k[8]), beta);
    k[10] = derivative(y + h * (-0.9371424300859873 * k[0] + 5.186372428844064 * k[3]
        + 1.0914373489967295 * k[4] - 8.149787010746927 * k[5] - 18.52006565999696 * k[6]
        + 22.739487099350505 * k[7] + 2.4936055526796523 * k[8] - 3.0467644718982196 * k[9]
        ), beta);
    k[11] = derivative(y + h * (2.273310147516538 * k[0] - 10.53449546673725 * k[3]
        - 2.0008720582248625 * k[4] - 17.9589318631188 * k[5] + 27.94888452941996 * k[6]
        - 2.8589982771350235 * k[7] - 8.87285693353063 * k[8] + 12.360567175794303 * k[9]
        + 0.6433927460157636 * k[10]), beta);
    *end = y + h * (0.054293734116568765 * k[0] + 4.450312892752409 * k[5]
        + 1.8915178993145003 * k[6] - 5.801203960010585 * k[7] + 0.3111643669578199 * k[8]
        - 0.1521609496625161 * k[9] + 0.20136540080403034 * k[10] + 0.04471061572777259 * k[11]);
    const vec e5 = 0.01312004499419488 * k[0] - 1.2251564463762044 * k[5]
        - 0.4957589496572502 * k[6] + 1.6643771824549864 * k[7] - 0.35032884874997366 * k[8]
        + 0.3341791187130175 * k[9] + 0.08192320648511571 * k[10] - 0.022355307863886294 * k[11];
    const vec e3 = -0.18980075407240762 * k[0] + 4.450312892752409 * k[5]
        + 1.8915178993145003 * k[6] - 5.801203960010585 * k[7] - 0.4226823213237919 * k[8]
        - 0.1521609496625161 * k[9] + 0.20136540080403034 * k[10] + 0.02265179219836082 * k[11];
    const double s0 = rtol * (1 + fabs((*end)[0])), s1 = rtol * (1 + fabs((*end)[1]));
    const double a5 = e5[0] / s0, b5 = e5[1] / s1, a3 = e3[0] / s0, b3 = e3[1] / s1;
    const double n5 = a5 * a5 + b5 * b5, n3 = a3 * a3 + b3 * b3;
    return n5 == 0 ? 0 : fabs(h) * n5 / sqrt(2 * (n5 + 0.01 * n3));
}

static double resize(double h, double error)
{
    if (!(error < INFINITY))
        return 0.2 * h;
    return h * fmin(6, fmax(0.2, 0.9 * pow(fmax(error, 1e-12), -0.125)));
}

/* First turning point in a direction: time and stretch, with their derivatives by the load.
   Returns 0 for none. */
static int turning_point(
    double l, int direction, double beta, double rtol, double *time, double *stretch,
    double *slope, double *time_slope)
{
    vec y = {l}, end;
    double t = 0, a;
    double h = 4 * pow(rtol, 0.125) / (frequency(l) + 3 * zeta);
    for (int n = 0;; n++) {
        if (n == 20000)
            return 0;
        const double error = step(y, beta, h, rtol, &end, &a);
        if (!(error <= 1)) {
            h = resize(h, error);
            continue;
        }
        if (direction * y[1] > 0 && direction * end[1] <= 0)
            break;
        y = end;
        t += h;
        h = resize(h, error);
    }
    /* Inside the last step: Newton on the time, from the parabola through rates and slope. */
    double dt = h * y[1] / (y[1] - end[1]);
    const double size = fmax(fabs(y[1]), fabs(end[1]));
    if (direction * a < 0) {
        const double c = (end[1] - y[1] - a * h) / (h * h);
        const double root = a * a - 4 * c * y[1];
        const double x = 2 * y[1] / (-a + direction * sqrt(fmax(root, 0)));
        if (root > 0 && x > 0 && x <= h)
            dt = x;
    }
#ifdef CUBICS
    const double enough = pow(rtol, 0.375);
#else
    const double enough = 1e-6;
#endif
    double jerk = 0;
    vec by;
    for (int n = 0; n < 12; n++) {
        step(y, beta, dt, rtol, &end, &a);
        y = end;
        t += dt;
        by = derivative(y, beta);
        a = by[1];
        if (direction * a >= 0) {
            dt = 0.25 * h;
            continue;
        }
        dt = -y[1] / a;
#ifdef CUBICS
        jerk = derivative((vec){y[0], y[1], y[1], a}, beta)[3]
            - derivative((vec){y[0], y[1], 0, 0}, beta)[3];
        dt -= 0.5 * jerk / a * dt * dt;
#endif
        if (fabs(y[1]) <= enough * size)
            break;
    }
    *time = t + dt;
    *stretch = y[0] + dt * (y[1] + dt * (0.5 * a + jerk / 6 * dt));
#ifdef SECANT
    *slope = *time_slope = 0;
#else
    *slope = y[2] + dt * (y[3] + 0.5 * by[3] * dt);
    *time_slope = -(y[3] + by[3] * dt) / (a + jerk * dt);
#endif
    return 1;
}

static double first_guess(double l, double target, double beta_1)
{
    if (GUESS == 0)
        return 0.5 * fabs(beta_1 - force(l));
    const double beta = (energy(target) - energy(l)) / (target - l);
    const double delta = fabs(beta_1 - beta);
    if (GUESS == 1)
        return delta;
    /* The damping ratio: damping force, at the rate half way, against that of the spring. */
    const double half = 0.5 * (l + target);
    const double kinetic = energy(l) + beta * (half - l) - energy(half);
    const double fastest = sqrt(fmax(12 * kinetic / (1 / (half * half * half) + c1), 0));
    const double xi = 0.25 * zeta * c1 * fastest / delta;
    const double decay = xi < 0.9 ? exp(-acos(-1) * xi / sqrt(1 - xi * xi)) : 1e-3;
    return delta * 2 * decay / (1 + decay);
}

#ifdef CUBICS
/* What the cubic through two points, with a slope at each, adds to the line through the first, at
   a fraction of the way from it to the second. */
static double beyond_line(double share, double rise, double way, double slope, double other)
{
    const double bend = way * (slope + other) - 2 * rise;
    return share * share * (rise - way * slope - bend + share * bend);
}
#endif

/* Load and time of the two-step command. Returns the number of iterations, 0 on failure. */
static int two_step(double l, double target, double rtol, double *beta_p, double *tau_p)
{
    const int direction = target > l ? 1 : -1;
    const double beta_1 = force(target);
    double low = 0, high = fabs(beta_1 - force(l));
    double d = first_guess(l, target, beta_1);
#ifdef SECANT
    double old_d = 0, old_excess = 0;
#endif
#ifdef CUBICS
    double old_d = 0, old_excess = 0, old_slope = 0, old_time = 0, old_time_slope = 0;
    double went = INFINITY, exact = INFINITY;
#endif
#ifdef COARSE
    double tolerance = fmax(rtol, COARSE);
#else
    double tolerance = rtol;
#endif
    for (int pass = 1; pass <= 80; pass++) {
        double time = 0, end = 0, slope = 1, time_slope = 0;
        const double beta = beta_1 - direction * d;
        double change = INFINITY;
        if (turning_point(l, direction, beta, tolerance, &time, &end, &slope,
                &time_slope)) {
            const double excess = direction * (end - target);
            if (fabs(excess) > 1e3 * tolerance) {
                if (excess > 0)
                    low = d;
                else
                    high = d;
            }
#ifdef SECANT
            change = pass == 1 ? 0.1 * (excess > 0 ? high - d : low - d)
                : -excess * (d - old_d) / (excess - old_excess);
            old_d = d;
            old_excess = excess;
#else
            change = excess / slope;
#endif
        } else
            high = d;
        double next = d + change;
        if (!(low < next && next < high))
            next = 0.5 * (low + high);
        const double relative = fabs(next - d) / d;
#ifdef CUBICS
        const double excess = direction * (end - target), move = fabs(target - l);
        const double squared = relative / went * (relative / went);
        const int bent = tolerance <= rtol && next == d + change && relative * went <= 0.1 * sqrt(rtol)
            && squared * exact <= rtol && squared * squared * relative <= 0.1 * rtol
            && fabs(excess) <= 1e-4 * move;
        if (bent) {
            /* The slope of d by the excess, and of the time by d. */
            const double back = old_d - d, rise = old_excess - excess;
            next += beyond_line(-excess / rise, back, rise, -1 / slope, -1 / old_slope);
            const double moved = next - d;
            *beta_p = beta_1 - direction * next;
            *tau_p = time - direction * time_slope * moved + beyond_line(
                moved / back, old_time - time, back, -direction * time_slope,
                -direction * old_time_slope);
            return pass;
        }
        old_d = d, old_excess = excess, old_slope = slope;
        old_time = time, old_time_slope = time_slope, went = relative;
        exact = tolerance * (1 + target) / move;
#endif
        d = next;
#ifdef SECANT
        const int enough = relative * relative <= 0.01 * rtol || relative <= 0.1 * rtol;
#else
        const int enough = relative * relative <= 0.01 * rtol;
#endif
        if (tolerance <= rtol && enough && pass > 1) {
            *beta_p = beta_1 - direction * d;
            *tau_p = time;
            return pass;
        }
        if (relative < 0.1) {
            tolerance = fmax(rtol, fmin(tolerance, 1e-2 * relative * relative));
            if (tolerance < 1e3 * rtol)
                tolerance = rtol;
        }
    }
    return 0;
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e9 * t.tv_sec + t.tv_nsec;
}

static int ascending(const void *a, const void *b)
{
    const double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

int main(int argc, char **argv)
{
    enum { MOST = 1000 };
    static double moves[MOST][5], beta_p[MOST], tau_p[MOST];
    static int passes[MOST];
    int count = 0;
    if (argc != 3 || atoi(argv[2]) < 1) {
        fprintf(stderr, "usage: %s RTOL REPEATS < moves\n", argv[0]);
        return 2;
    }
    const double rtol = atof(argv[1]);
    const int repeats = atoi(argv[2]);
    double *rounds = malloc(repeats * sizeof *rounds);
    if (!rounds)
        return 1;
    while (count < MOST && scanf("%lf %lf %lf %lf %lf", &moves[count][0], &moves[count][1],
            &moves[count][2], &moves[count][3], &moves[count][4]) == 5)
        count++;
    for (int n = 0; n < repeats; n++) {
        const double begin = now();
        for (int i = 0; i < count; i++) {
            zeta = moves[i][2];
            i_j = 1 / moves[i][3];
            c1 = moves[i][4];
            passes[i] = two_step(moves[i][0], moves[i][1], rtol, &beta_p[i], &tau_p[i]);
        }
        rounds[n] = (now() - begin) / count;
    }
    for (int i = 0; i < count; i++)
        printf("%.17g %.17g %d\n", beta_p[i], tau_p[i], passes[i]);
    qsort(rounds, repeats, sizeof *rounds, ascending);
    printf("%.1f %.1f\n", rounds[0], rounds[repeats / 2]);
    return 0;
}
